"""Multifrontal Cholesky factorisation on dense kernels of LAPACK."""
