"""Elastic laws, one file each."""
