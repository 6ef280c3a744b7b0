"""The known loads of a case in one of its later states, on the mesh that they act on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.case.case import Case
from palpate.case.data import CaseLoad
from palpate.errors import ConfigurationError
from palpate.findings import Finding
from palpate.images.tissue import Role
from palpate.mechanics.loads import Load, boundary_named, gravity, pressure, traction
from palpate.mesh.space import LagrangeSpace


def case_loads(case: Case, space: LagrangeSpace, state: int, *, share: float = 1.0) -> tuple[Load, ...]:
    """The loads that `case` adds in a later state, numbered from 1, to those of the reference, or a `share` of them.

    Those of the reference itself for the number 0.

    Raises `ConfigurationError` for a surface that the mesh has not, or whose motion is prescribed.
    """
    density = {tissue.name: tissue.density_kg_m3 for tissue in case.tissues}
    heavy = np.array([density.get(tissue.name, 1000.0) for tissue in space.mesh.tissues])
    return loads_on(space, case.loads_in(state), densities=heavy, share=share)


def loads_on(
    space: LagrangeSpace, loads: Sequence[CaseLoad], *, densities: NDArray[np.float64], share: float = 1.0
) -> tuple[Load, ...]:
    """The same of `loads` alone; densities (n_tissues,) kg/m^3, one each of the mesh's tissues."""
    prescribed = [t.name for t in space.mesh.tissues if t.role in (Role.DRIVER, Role.RIGID)]
    sliding = [t.name for t in space.mesh.tissues if t.role is Role.SLIDING]
    found: list[Load] = []
    for load in loads:
        if load.acceleration_m_s2 is not None:
            found.append(gravity(space, densities, share * np.array(load.acceleration_m_s2)))
            continue
        surface = load.surface or ""
        if surface in prescribed:
            raise ConfigurationError(
                f"[[loads]]: the motion of '{surface}' is prescribed, so a {load.kind} on it has no effect; give it the"
                " role void (a surface of a mesh: the boundary free) if the load is to move it"
            )
        if surface in sliding and load.pressure_kpa is not None:
            raise ConfigurationError(
                f"[[loads]]: '{surface}' is sliding and does not move along its normal, so a pressure on it has no"
                " effect; give it the boundary free if the pressure is to move it"
            )
        triangles = boundary_named(space.mesh, surface)
        if load.traction_kpa is not None:
            found.append(traction(space, triangles, share * np.array(load.traction_kpa)))
        else:
            found.append(pressure(space, triangles, share * (load.pressure_kpa or 0.0), following=load.following))
    return tuple(found)


def load_warnings(case: Case) -> tuple[Finding, ...]:
    """A warning when a body has weight in a later state, and at finite strain none in the reference.

    Nothing on earth loses its weight between two images: what is stated is then what is added to it, and an increment
    from a reference that is free of stress is right to first order alone. A phantom's reference is free of it.
    """
    heavy = [load for load in case.loads if load.acceleration_m_s2 is not None]
    if case.phantom is not None or not case.mechanics.material_law.finite or case.strained_reference or not heavy:
        return ()
    text = (
        "Gravity acts in a later state, but [[loads]] states none in 'before', which is then taken as free of stress;"
        " moduli at finite strain can be wrong by some per cent. State all loads of 'before' with state = 0, and in"
        " each later state all loads, not the change."
    )
    return (Finding("weightless-reference", text),)
