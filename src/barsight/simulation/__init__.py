"""Floor 7: renders a bar yard with exact truth, as a recording in the EuRoC layout."""
