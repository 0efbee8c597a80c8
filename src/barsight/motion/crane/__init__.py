"""Turn the crane's encoders and the body's sway into a trajectory and a prediction."""
