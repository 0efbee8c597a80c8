"""Draw calibration boards, to print and as the simulated cameras see them."""
