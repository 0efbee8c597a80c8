"""Serve one state by every link that plant.toml names, and check each from the other side."""
