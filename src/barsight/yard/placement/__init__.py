"""Check one placement of the magnet: bundles under it, clearance, labels, thin bars, faces and pull."""
