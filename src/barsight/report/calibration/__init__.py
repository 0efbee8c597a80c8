"""Report pages of calibrations and checks."""
