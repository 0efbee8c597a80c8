"""Bundle detection: headings, layers, crossings, and the best set of fitted outlines."""
