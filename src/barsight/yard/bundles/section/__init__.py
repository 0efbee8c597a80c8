"""Read a bundle's cross-section: its heights and flanks, its gray levels, and the straps that hold it."""
