"""Plan lift targets: the magnet's contact, checks with vetoes, ranking, set-down places."""
