"""Read the labels of bundles: codes in pictures, placed on the map, compared with the stock list."""
