"""Keep the inventory: bundle files, the stock list and changes between measurements."""
