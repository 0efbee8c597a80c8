"""Register maps and passes by matched points: rigid motions, ties, the yard frame."""
