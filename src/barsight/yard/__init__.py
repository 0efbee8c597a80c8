"""Floor 5: bars and bundles found in the map, lift targets, stability, and reasons not to lift."""
