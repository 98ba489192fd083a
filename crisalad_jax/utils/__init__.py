"""Errors, files, devices, signals and progress, for all subpackages; imports none of them."""
