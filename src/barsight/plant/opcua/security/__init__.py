"""Connect asyncua: its settings, certificates, users and roles."""
