"""Provide the commands of the fleet, which measure an archive again, compare versions and promote one."""
