"""Find bars and bundles in the map, choose lift targets, judge stability, and say why not to lift."""
