"""Maps: stored image descriptors that you can append to and search."""
