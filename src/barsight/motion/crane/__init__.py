"""The crane's encoders and the body's sway as a trajectory and as a prediction."""
