"""Fits of one bundle: outline templates, Gauss-Newton on heights, ends, bars."""
