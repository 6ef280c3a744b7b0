"""A test of the Cramer-Rao limit: the scatter of its weights on noisy images, compared with the limit itself.

    python benchmarks/noise_limit.py [--seed S] [--draws N]

A neo-Hookean pelvis with the noise of accuracy.py's row `finite-noise` is imaged N times. The residuals at the truth go
through the weights that the limit stands for, for cells of several edge lengths (0: every face alone), and through the
estimator's own. Simulated data.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, replace

import numpy as np
from accuracy import at_truth, true_noise
from accuracy_rows import NOISE, ROWS, from_voxels, truth_of
from cramer_rao import cramer_rao, efficient_gain, model_to_image, target_of
from numpy.typing import NDArray

from palpate.body import aligned
from palpate.case import Case, Mechanics, MeshSettings, Phantom
from palpate.images import segment
from palpate.inversion import Evaluation, invert
from palpate.observation import NoiseModel, surface_distances
from palpate.phantoms import pelvis_grid, reimaged
from palpate.study import fitted_states, inversion_settings
from palpate.uncertainty import gain

ROW = ROWS["finite-noise"]
CELLS_MM = (0.0, 2.0, 4.0, 6.0, 8.0)
ALONE = 1e-3  # mm: a cell of one face


@dataclass(frozen=True)
class Weights:
    """Derivative (n_parameters, n_residuals) of the log-moduli, and the covariance that is promised, if any."""

    name: str
    rows: NDArray[np.float64]
    promised: NDArray[np.float64] | None


def main() -> int:
    """Print one JSON document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=320)
    parser.add_argument("--draws", type=int, default=30)
    arguments = parser.parse_args()
    scene, options = truth_of(replace(ROW, noise=None), arguments.seed, 0, {})
    case = Case(
        "noise-limit",
        phantom=Phantom("pelvis", arguments.seed),
        mesh=MeshSettings(ROW.edge_mm),
        mechanics=Mechanics(ROW.law, "auto"),
    )
    problem, body = from_voxels(scene, case)
    inversion = invert(problem, inversion_settings(case, problem.parameters), progress=lambda _: None)
    there = at_truth(inversion, problem, scene)
    rng = np.random.default_rng([arguments.seed, 11])
    noise = true_noise(there, fitted_states(inversion, body), NOISE, rng)
    evaluation = there.minimum.evaluation
    weights = _weights(evaluation, noise, there.objective.n_parameters)
    shifts: dict[str, list[NDArray[np.float64]]] = {w.name: [] for w in weights}
    surfaces = [target_of(line.observation).surface for line in evaluation.linearisations]
    for draw in range(1, arguments.draws + 1):
        noisy = replace(options, noise=NOISE)
        imaged = reimaged(replace(scene, seed=scene.seed + 1000 * draw), pelvis_grid(noisy), noise=NOISE)
        before, after = (segment(image, scene.tissues) for image in (imaged.before, imaged.after))
        states = aligned(before, (after,), method="none")
        targets = [target_of(o) for o in surface_distances(replace(body, states=states).imaged(), surfaces)[0]]
        errors = np.concatenate(
            [
                target.after.at(line.residuals.places[model_to_image(line)]) - target.rest_distance
                for line, target in zip(evaluation.linearisations, targets, strict=True)
            ]
        )
        for w in weights:
            shifts[w.name].append(w.rows @ errors)
        print(f"draw {draw} of {arguments.draws}", file=sys.stderr, flush=True)
    names = problem.parameters.tissues
    rows = [_row(w, np.array(shifts[w.name]), evaluation, names) for w in weights]
    print(json.dumps({"seed": arguments.seed, "draws": arguments.draws, "rows": rows}, indent=1))
    return 0


def _weights(evaluation: Evaluation, noise: NoiseModel, n: int) -> list[Weights]:
    found = []
    for cell in CELLS_MM:
        size = max(cell, ALONE)
        rows = np.concatenate(efficient_gain(evaluation, noise, n, cell_mm=size), axis=1)
        found.append(Weights(f"limit, cells of {cell:g} mm", rows, cramer_rao(evaluation, noise, n, cell_mm=size)))
    pairs = zip(gain(evaluation, n), evaluation.linearisations, strict=True)
    # half of the weight is on each direction of the distance, which see the same error
    own = np.concatenate([2.0 * row[:, model_to_image(line)] for row, line in pairs], axis=1)
    return [*found, Weights("the estimator's own", own, None)]


def _row(
    weights: Weights, shifts: NDArray[np.float64], evaluation: Evaluation, names: tuple[str, ...]
) -> dict[str, object]:
    """Standard deviations of the log-moduli: as promised, and as the draws scatter, with the prior's part."""
    n = len(names)
    jacobian = np.concatenate([line.jacobian.of_rows(model_to_image(line)).dense for line in evaluation.linearisations])
    by_modes = weights.rows @ jacobian[:, n:]  # modes that the weights do not keep out of the moduli
    by_prior = by_modes @ np.linalg.solve(evaluation.prior.dense[n:, n:], by_modes.T)
    scatter = np.sqrt(np.diag(np.cov(shifts.T) + by_prior))
    promised = None if weights.promised is None else np.sqrt(np.diag(weights.promised)).tolist()
    return {"weights": weights.name, "tissues": list(names), "promised_sd": promised, "scatter_sd": scatter.tolist()}


if __name__ == "__main__":
    raise SystemExit(main())
