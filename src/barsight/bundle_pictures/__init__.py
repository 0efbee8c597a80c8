"""Pictures tell of bundles what the map's cells blur: the bars' pitch, and where straps end."""
