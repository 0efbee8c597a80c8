"""Speak the plant's own language: the state and the next lift, for PLCs, brokers and OPC UA clients."""
