"""The inversion of a case, whose reference state may bear loads: the state without stress is then found with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.errors import NotConverged
from palpate.inversion import REPORTED, InverseProblem, Inversion, InversionSettings, StopRule, invert
from palpate.mechanics.rest_state import unloaded_displacement
from palpate.progress import Line, Progress, details, during
from palpate.study.body import Body, joint_problem, strained_body
from palpate.study.case import Case
from palpate.study.case_loads import case_loads

PASSES = 10
SETTLED = 1e-3  # of ln E: change at which the passes stop; the next one would change less, by the reference's strain


def inverted(
    bodies: Sequence[Body],
    problem: InverseProblem,
    case: Case,
    settings: InversionSettings,
    *,
    progress: Progress,
    rule: StopRule = REPORTED,
) -> Inversion:
    """The estimate of a problem, that of the bodies of a case; where their reference states bear loads, as these do.

    The linear law begins then, under which only what is added to the loads matters. In turn the state without stress is
    found at the moduli, and the moduli from there; each pass leaves of the last one's change a share of about the
    reference's strain. Starts are those of the last pass. Raises `NotConverged` where this does not settle, or no such
    state is found.
    """
    linear = during("search", progress)
    if not case.strained_reference:
        return invert(problem, settings, progress=linear, rule=rule)
    found = invert(problem.linear(), settings, progress=linear, rule=rule)
    there, change = during("check the law", details(progress)), np.inf
    progress(Line("the reference state without its loads, and the moduli, in turn", "check the law"))
    for number in range(1, PASSES + 1):
        if not found.minimum.converged:
            return found
        there(f"the reference state without its loads, pass {number}")
        theta, strained = _theta(found), list[Body]()
        parameters, unknowns = found.objective.parameters, found.minimum.unknowns
        for reference, body in enumerate(bodies):
            first = next(i for i, state in enumerate(problem.states) if state.reference == reference)
            model, seen = problem.states[first].finite_strain, found.objective.states[first].model
            assert model is not None
            own, borne = replace(model, material=seen.material), case_loads(case, body.space, 0)
            coefficients = parameters.coefficients(unknowns)[first][seen.constraint.n_modes :]
            moved = unloaded_displacement(own, parameters.moduli(unknowns), coefficients, borne)
            strained.append(strained_body(body, moved, case))
        problem = joint_problem(strained, case, progress=there)
        found = invert(problem, replace(settings, starts=(theta,), further=()), progress=there, rule=rule)
        change = float(np.abs(_theta(found) - theta).max())
        if change < SETTLED:
            return found
    raise NotConverged(
        f"the moduli and the stress-free reference state do not converge: after {PASSES} passes moduli still change by"
        f" {100.0 * change:.2g} %; check the loads of state 0, or state only the change of the loads"
    )


def _theta(found: Inversion) -> NDArray[np.float64]:
    """The log-moduli (n_parameters,) of the best minimum."""
    return np.asarray(found.minimum.unknowns[: found.objective.n_parameters])
