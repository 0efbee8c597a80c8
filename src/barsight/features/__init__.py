"""Detect feature points and match them."""
