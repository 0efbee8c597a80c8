"""Floor 2: stereo methods behind one Protocol, their noise, triangulation and files."""
