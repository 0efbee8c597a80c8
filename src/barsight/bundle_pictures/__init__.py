"""Measure in the pictures what the map's cells blur: the pitch of a bundle's bars and the ends of its
straps.
"""
