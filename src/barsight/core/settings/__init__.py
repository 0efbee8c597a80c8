"""Settings: numbers checked, TOML files read, old names refused with the new one."""
