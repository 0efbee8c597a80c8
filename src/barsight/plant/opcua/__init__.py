"""Serve the plant state over OPC UA: plain variables, and OPC 40100-1 for machine vision on top of them."""
