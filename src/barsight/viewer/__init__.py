"""Show the measured yard in 3D, in the browser, offline."""
