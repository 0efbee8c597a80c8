"""The election of a whole surface, tile by tile, again and again while views come."""
