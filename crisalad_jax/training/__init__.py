"""Training: the compiled step, the optimiser, what is frozen, the loop and its files."""
