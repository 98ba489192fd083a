"""Configurations: checks, swappable parts, plug-ins, and conversion to and from JSON."""
