"""From misfit to moduli: parameters, objective, optimisers, starts, posterior."""
