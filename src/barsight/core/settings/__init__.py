"""Build settings, check them by their types, read them from TOML files, and refuse old names with the new
one.
"""
