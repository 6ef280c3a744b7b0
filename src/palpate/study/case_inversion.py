"""The inversion of a case: its models made again at the Poisson's ratios that it seeks, and without stress at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate.body.body import Body, body_with_ratios, joint_problem, strained_body
from palpate.body.loads import case_loads
from palpate.body.poisson_ratios import sought_ratios
from palpate.case.case import Case
from palpate.errors import NotConverged
from palpate.inversion import REPORTED, InverseProblem, Inversion, InversionSettings, StopRule, invert
from palpate.mechanics.rest_state import unloaded_displacement
from palpate.progress import Line, Progress, details, during

ROUNDS = 6  # largest number of times that models are made at other Poisson's ratios
PASSES = 10
SETTLED = 1e-3  # of ln E: change at which the passes stop; the next one would change less, by the reference's strain


def invert_case(
    bodies: Sequence[Body],
    problem: InverseProblem,
    case: Case,
    settings: InversionSettings,
    *,
    progress: Progress,
    rule: StopRule = REPORTED,
) -> Inversion:
    """The estimate of a problem, that of the bodies of a case; Poisson's ratios that it seeks are those of its models.

    Responses to a ratio are those at that of the model. From where an estimate ends, models at the found ratios lead
    on, until these move by less than a tenth of their standard deviations; under the linear law first, which is quick
    and to which no ratio is impossible. Raises as `_at_ratios` does.
    """
    every, linear = settings.every_start, case.estimate.seeks_poisson_ratios and problem.finite_strain
    rounds = iter(range(ROUNDS))
    while True:
        found = _at_ratios(bodies, problem, case, settings, progress=progress, rule=rule, linear=linear)
        ratios = sought_ratios(found) if found.minimum.converged else ()
        settings = replace(settings, starts=(_theta(found),), further=every)
        if all(ratio.settled for ratio in ratios) or next(rounds, None) is None:
            if not linear:
                return found
            linear, rounds = False, iter(range(ROUNDS))
            continue
        there = {ratio.tissue: ratio.next_model for ratio in ratios}
        words = ", ".join(f"{tissue} {ratio:.3f}" for tissue, ratio in there.items())
        progress(Line(f"again with models at the Poisson's ratios found: {words}", "search"))
        bodies = [body_with_ratios(body, there, case) for body in bodies]
        problem = joint_problem(bodies, case, progress=during("search", details(progress)))


def _at_ratios(
    bodies: Sequence[Body],
    problem: InverseProblem,
    case: Case,
    settings: InversionSettings,
    *,
    progress: Progress,
    rule: StopRule,
    linear: bool,
) -> Inversion:
    """The same with models at the Poisson's ratios of the bodies; where their reference states bear loads, as these do.

    The linear law begins then, under which only what is added to the loads matters. In turn the state without stress is
    found at the moduli, and the moduli from there; each pass leaves of the last one's change a share of about the
    reference's strain. Starts are those of the last pass. Raises `NotConverged` where this does not settle, or no such
    state is found.
    """
    searching = during("search", progress)
    if linear or not case.strained_reference:
        return invert(problem.linear() if linear else problem, settings, progress=searching, rule=rule)
    found = invert(problem.linear(), settings, progress=searching, rule=rule)
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
