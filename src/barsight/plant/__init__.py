"""Serve the plant state and the next lift in the plant's protocols, for PLCs, brokers and OPC UA clients."""
