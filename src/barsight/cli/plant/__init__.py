"""Provide the commands on the plant's side: serve the telegram to a PLC, and check what is served."""
