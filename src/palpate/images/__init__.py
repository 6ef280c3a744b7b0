"""Label images: reading, tissues, distance maps, alignment, checks."""
