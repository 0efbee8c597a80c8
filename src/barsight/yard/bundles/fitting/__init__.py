"""Fit one bundle: outline templates, Gauss-Newton on heights, ends, single bars."""
