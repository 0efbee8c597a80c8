"""Serve the plant's state by OPC UA: plain variables, and OPC 40100-1 for machine vision above them."""
