"""Read a bundle's cross-section: its heights and flanks, its shades, and the straps that hold it."""
