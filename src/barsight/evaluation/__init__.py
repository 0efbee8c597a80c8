"""Floor 6: agreement with references, scores against truth, benchmarks."""
