"""What pictures show of bundles finer than the map's cells do: the bars' pitch, and where straps end."""
