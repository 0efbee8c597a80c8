"""Stability of the pile: its sides, supports and overhangs."""
