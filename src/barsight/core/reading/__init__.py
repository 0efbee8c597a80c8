"""Read maps, clouds and documents that others made, within bounds and against schemas and digests."""
