"""Commands of a run beside the crane."""
