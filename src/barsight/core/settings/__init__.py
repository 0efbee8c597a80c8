"""Settings: built and checked by their types, read from TOML files, old names refused with the new one."""
