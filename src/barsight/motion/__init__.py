"""Floor 3: from sensors to the trajectory of the body."""
