"""Diameters of bars by their pitch in the pictures, which show it finer than the map's cells do."""
