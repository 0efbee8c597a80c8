"""Model the magnet: its description, its faces on the map, and what they hold."""
