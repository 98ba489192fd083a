"""Retrieval: descriptors of folders, search, re-ranking, maps."""
