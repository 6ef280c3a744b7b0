"""The state in which a body is free of stress, of one that was seen under loads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import NotConverged
from palpate.mechanics.boundary import Conditions
from palpate.mechanics.equilibrium import from_start
from palpate.mechanics.finite_strain import FiniteStrainModel
from palpate.mechanics.loads import DeadLoad, Load
from palpate.mesh.space import Constraint

TOLERANCE = 1e-8  # of the body's size: largest distance of the loaded body from the observed one
FORCES = 1e-10  # relative residual of each equilibrium on the way
MOST = 60


def unloaded_displacement(
    model: FiniteStrainModel,
    moduli: NDArray[np.float64],
    material: NDArray[np.float64],
    loads: tuple[Load, ...],
) -> NDArray[np.float64]:
    """Displacement w (n_points, 3) mm from the body free of stress, at x - w, to where it was seen under loads.

    At moduli (n_regions,) kPa and coefficients (n_material,) of the material, beginning where the model was strained
    before; what the model prescribes stays where it is, what slides does so. With u(X) the displacement of X under the
    loads: w <- u(x - w), which is X <- X - (X + u(X) - x) (Sellier, Mechanics Research Communications 38 (2011),
    46-48). Forces are those on the body as it was seen. Raises `NotConverged` where this leads nowhere.
    """
    free = model.constraint.free
    still = Constraint(free, np.zeros((free.shape[0], 0)), np.zeros(free.shape[0]))
    points = model.space.points
    dead = DeadLoad(Conditions(still, loads).forces(model.space))
    seen = replace(model.to_tolerance(FORCES), conditions=Conditions(still, (dead,)))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    strained = np.zeros_like(points) if model.elements.strained is None else model.elements.strained
    step, reason = np.inf, f"{MOST} steps were not enough"
    for _ in range(MOST):
        try:
            body = replace(seen, elements=replace(seen.elements.unloaded(strained), strained=None))
            found = from_start(body, moduli, material, start=strained, nearby=None).displacement
        except NotConverged as error:
            reason = str(error)
            break
        before, step = step, float(np.abs(found - strained).max())
        strained = found
        if step <= TOLERANCE * size:
            return strained
        if step > 2.0 * before:
            reason = f"its steps grow, the last one to {step:.3g} mm"
            break
    raise NotConverged(
        f"the state without the loads of the reference was not found at moduli of {np.round(moduli, 3).tolist()} kPa:"
        f" {reason}; check loads, densities and units, or state the increment of loads instead"
    )
