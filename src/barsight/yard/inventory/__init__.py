"""Inventory: bundle files, the stock list and changes between measurements."""
