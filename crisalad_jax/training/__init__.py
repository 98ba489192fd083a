"""Training: the compiled step, the optimiser, frozen parameters, the loop and its files."""
