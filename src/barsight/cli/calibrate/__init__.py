"""`barsight calibrate KIND ...`: one module per kind."""
