"""Conforming tetrahedra of several tissues, their surfaces, spaces and voxels."""
