"""Where interval profiles end, on the estimate's reduced basis and on models that are exact at the ends.

    python benchmarks/interval_ends.py [--seeds 401,402,403] [--edge MM] [--law NAME] [--json]

Simulated data: the row `clean` of accuracy.py with the program's defaults. Both are compared with a basis that also has
all responses at the ends: the error in ln E of each of the four ends, `open` where there is none. At finite strain
this is the linear law's basis.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from typing import Any

import numpy as np
from accuracy_rows import ROWS, posed
from numpy.typing import NDArray

from palpate.approximation import ReducedBasis
from palpate.inversion import Bounds, Objective, frozen_posterior, invert
from palpate.statement import StatedPosterior, as_stated
from palpate.uncertainty import Profile, covariance_of, modulus_interval

NO_GRID = 3  # draws of a voxel grid, in which nothing is off


def main() -> int:
    """Measure every seed and print how far the ends are off."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="401,402,403")
    parser.add_argument("--edge", type=float, default=ROWS["clean"].edge_mm, help="edge length, mm")
    parser.add_argument("--law", default="linear", help="of the truth and of the estimate")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    found = []
    for seed in map(int, arguments.seeds.split(",")):
        found.append(measured(seed, arguments.edge, arguments.law))
        if not arguments.json:
            for basis in ("as the estimate left it", "exact at the ends"):
                off = ", ".join("open" if np.isnan(end) else f"{end:.3f}" for end in found[-1][basis])
                print(f"{seed}, basis {basis}: off by {off} of ln E", flush=True)
    if arguments.json:
        print(json.dumps(found, indent=1))
    return 0


def measured(seed: int, edge_mm: float, law: str) -> dict[str, Any]:
    """By how much of ln E the ends of one body's profiles are off on either basis, lower and upper of each modulus."""
    case = posed(replace(ROWS["clean"], held=False, edge_mm=edge_mm, law=law), seed, 0, {})
    bounds, inversion = case.settings.bounds, invert(case.problem, case.settings, progress=lambda _: None)
    objective, evaluation = inversion.objective, inversion.minimum.evaluation
    errors = [[np.zeros(len(term.weights)) for term in evaluation.linearisations]] * NO_GRID
    stated = as_stated(inversion, covariance_of(objective, evaluation, errors), bounds)
    n = objective.n_parameters
    left = replace(stated, frozen=frozen_posterior(objective, stated.minimum.unknowns))
    for profile in profiles(stated, n, bounds):
        for place in profile.outermost:
            objective = with_all_responses(objective, place)
    full = ends(replace(stated, frozen=frozen_posterior(objective, stated.minimum.unknowns)), n, bounds)
    off = [np.abs(ends(of, n, bounds) - full).tolist() for of in (left, stated)]
    return {"seed": seed, "as the estimate left it": off[0], "exact at the ends": off[1], "ends": full.tolist()}


def with_all_responses(objective: Objective, place: NDArray[np.float64]) -> Objective:
    """The objective on bases that have every response at unknowns (n_unknowns,)."""
    bases = [basis for basis in objective.bends_as if isinstance(basis, ReducedBasis)]
    pairs = zip(bases, objective.linearisation_points(place), strict=True)
    return objective.bent_as([basis.with_responses(at.moduli, at.coefficients) for basis, at in pairs])


def profiles(posterior: StatedPosterior, n_parameters: int, bounds: Bounds) -> list[Profile]:
    """Those of all moduli."""
    variances = np.diag(posterior.covariance).tolist()[:n_parameters]
    of = (posterior.marginal, posterior.minimum)
    return [modulus_interval(*of, k, variance=variance, bounds=bounds).profile for k, variance in enumerate(variances)]


def ends(posterior: StatedPosterior, n_parameters: int, bounds: Bounds) -> NDArray[np.float64]:
    """Their ends (2 n_parameters,) in ln E, the lower one first; not a number where one is open."""
    found = [(of.low, of.high) for of in profiles(posterior, n_parameters, bounds)]
    return np.array(found, dtype=np.float64).ravel()


if __name__ == "__main__":
    sys.exit(main())
