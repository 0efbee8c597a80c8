"""Read files that others made: bounded, held against schemas and digests; maps, clouds and documents."""
