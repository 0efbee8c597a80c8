"""Draw calibration boards, for printing and as the simulated cameras see them."""
