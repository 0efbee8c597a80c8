"""Budget the uncertainty of lifts: error sources, touch-downs of the magnet, and their propagation."""
