"""Maps: descriptors of images that are kept, appended to and searched."""
