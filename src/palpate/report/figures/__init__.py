"""Figures of a result for a paper or a talk: a file here is a kind of figure."""
