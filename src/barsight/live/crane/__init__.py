"""Run at a crane: check its sensors, measure with them, check the machine."""
