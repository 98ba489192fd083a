"""Model files: weights, resumable training states, public checkpoints and exported programs."""
