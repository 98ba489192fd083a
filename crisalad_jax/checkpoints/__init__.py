"""Model files: weights, states of a run, public checkpoints and exported programs."""
