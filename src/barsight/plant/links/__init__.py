"""Serve one state on every link configured in plant.toml, and check each link from its other end."""
