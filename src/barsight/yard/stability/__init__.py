"""Assess the stability of the pile: its sides, supports and overhangs."""
