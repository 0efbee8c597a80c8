"""Run `barsight calibrate KIND ...`, with one module per kind."""
