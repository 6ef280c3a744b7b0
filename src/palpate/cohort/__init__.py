"""Many cases: a table of rows, whoever computes them, files that are the truth, statistics with a unit of analysis."""
