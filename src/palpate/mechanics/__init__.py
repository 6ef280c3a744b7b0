"""Elastic equilibrium: stiffness, boundary conditions, linear solvers, forward models and their derivatives."""
