"""Linear solvers for symmetric positive definite systems, one file each."""
