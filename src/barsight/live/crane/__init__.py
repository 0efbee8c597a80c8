"""Run at a crane: prove its sensors, measure from them, check the machine."""
