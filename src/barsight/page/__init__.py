"""Serve the operator's page and its API on a store: `barsight serve`."""
