"""Scenes with a known truth: concentric spheres, pelves, and the noise of their images."""
