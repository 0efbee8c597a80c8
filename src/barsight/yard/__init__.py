"""Find bars and bundles in the map, choose lift targets, assess stability, and explain why not to lift."""
