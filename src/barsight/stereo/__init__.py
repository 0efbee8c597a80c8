"""Match pairs by methods behind one Protocol: noise, triangulation and files."""
