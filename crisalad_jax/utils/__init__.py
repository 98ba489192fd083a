"""Errors, files, devices, signals and progress, for all packages; imports none of them."""
