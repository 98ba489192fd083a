"""Attacks on the command line and its files: kills, signals, full disks, damage and bad input."""
