"""Whether a map of stiffness finds a stiff ball that the labels do not show, and finds none where there is none.

    python benchmarks/stiffness_maps.py [--bodies N] [--draws N] [--first-seed S] [--field-sd-mm 0.2] [--edge MM]
                                        [--surface-sd-mm 0] [--contrast 3] [--output FILE] [--json]

Simulated data. A random pelvis whose prostate, of `--gland-kpa` (0: as drawn, 15 to 60) in surroundings of 10 kPa,
holds a ball of 7 mm radius that is `--contrast` times as stiff, or none (1), is moved by its rectum, which fills by
`--filling-mm` (0: as drawn, 6 to 8), on a finer mesh; both states are imaged on 1 mm voxels, and a displacement field
is measured on a lattice of 4 mm in and round the prostate, its errors `--field-sd-mm` a component, alike over 5 mm.
The surfaces in both images are drawn as they are, or with smooth errors of `--surface-sd-mm`, alike over 6 mm.
The prostate's modulus is estimated as a field by the program's defaults (linear law). A line of JSON a draw: whether a
region was found, with which probability, how far its centre lies from the ball's, its contrast with its interval, how
much of the prior's variance the data removed, and the share of elements whose ln E lies inside its 95 % interval;
`in_ball` has the means of ln E over the tissue's and of its standard deviation in the ball, and of the former outside.
It also gives the limit: the ball's effect in standard deviations of the field's errors, with all else known.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from rows import Job, Result, collected, parser_of, printed, seeds_of, silent
from scipy import linalg
from scipy.spatial.distance import cdist

from palpate.body import aligned, inverse_problem, make_body
from palpate.case import Case, Mechanics, MeshSettings, Phantom
from palpate.images import FieldPrior, segment
from palpate.inversion import InverseProblem, invert
from palpate.mesh import LagrangeSpace, located, point_interpolation
from palpate.observation import PointDisplacement, correlation
from palpate.phantoms import Noise, reimaged
from palpate.study import inversion_settings
from palpate.uncertainty import NORMAL_95, sandwich_covariance, stiffness_maps
from scenes import BALL_RADIUS_MM, ORGANS, BodyWithBall, body_with_ball, point_term

Array = NDArray[np.float64]

ORGAN = ORGANS[0]
LATTICE_MM, ROUND_MM, ALIKE_MM = 4.0, 15.0, 5.0
SURFACE_ALIKE_MM, ANOTHER = 6.0, 1000  # length of the surfaces' errors; between the seeds of two draws of them
PRIOR = FieldPrior(0.7, 8.0)
OPTIONS = {"--surface-sd-mm": 0.0, "--gland-kpa": 15.0, "--filling-mm": 14.0, "--contrast": 3.0, "--edge": 7.0}
NAMES = [flag[2:].replace("-", "_") for flag in OPTIONS]


def main() -> int:
    """Run what was asked for and print what was found."""
    parser = parser_of(__doc__ or "", output="stiffness_maps.jsonl", first_seed=801, seeds=2)
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--field-sd-mm", type=float, nargs="+", default=[0.1])
    for flag, value in OPTIONS.items():
        parser.add_argument(flag, type=float, default=value)
    asked = parser.parse_args()
    found = collected(_jobs(asked), asked, ("seed", "field_sd_mm", "draw", *NAMES))
    printed({f"{r['seed']}, {r['field_sd_mm']:g} mm, {r['draw']}": r for r in found}, asked, COLUMNS)
    return 0


def _jobs(asked: argparse.Namespace) -> Iterator[Job]:
    given = {name: getattr(asked, name) for name in NAMES}
    body = lru_cache(maxsize=1)(body_with_ball)  # draws of one body come one after the other

    def row(seed: int, sd: float, draw: int) -> Result:
        """One draw of a body."""
        truth = body(seed, asked.gland_kpa, asked.filling_mm, asked.contrast, asked.edge)
        return _estimated(truth, asked, sd, draw)

    for key in product(seeds_of(asked), asked.field_sd_mm, range(asked.draws)):
        yield Job(dict(zip(("seed", "field_sd_mm", "draw"), key, strict=True)) | given, partial(row, *key))


def _drawn(truth: BodyWithBall, surface_sd_mm: float, draw: int) -> BodyWithBall:
    """The truth with its surfaces drawn in both images with errors of so many mm a component."""
    if not surface_sd_mm:
        return truth
    scene, noise = truth.scene, Noise(surface_sd_mm, SURFACE_ALIKE_MM)
    images = reimaged(replace(scene, seed=scene.seed + ANOTHER * draw), scene.before.grid, noise=noise)
    return replace(truth, scene=replace(scene, before=images.before, after=images.after))


def _estimated(truth: BodyWithBall, asked: argparse.Namespace, sd_mm: float, draw: int) -> Result:
    """What the map says of one draw of the field's errors."""
    truth, mesh = _drawn(truth, asked.surface_sd_mm, draw), MeshSettings(asked.edge)
    began, scene, log_ratio, centre = time.perf_counter(), truth.scene, truth.log_ratio, truth.centre
    case = Case("map", phantom=Phantom("pelvis"), mesh=mesh, mechanics=Mechanics("linear", "auto"))
    tissues = tuple(replace(t, field=PRIOR) if t.name == ORGAN else t for t in scene.tissues)
    before, after = (segment(image, tissues) for image in (scene.before, scene.after))
    body = make_body(aligned(before, (after,), method="none"), case, progress=silent)
    problem = inverse_problem(body, case, progress=silent)
    state = problem.states[0]
    points, n_points, limit = _field(truth, body.space, sd_mm, np.random.default_rng([scene.seed, draw, 43]))
    state = state.with_observations([*state.observations, points])
    settings = inversion_settings(case, problem.parameters)
    inversion = invert(InverseProblem((state,), problem.parameters), settings, progress=silent)
    minimum = inversion.minimum
    (found,) = stiffness_maps(inversion, np.diag(sandwich_covariance(inversion.objective, minimum.evaluation)))
    places = body.space.mesh.nodes[body.space.mesh.tets[found.elements]].mean(axis=1)
    at, names = located(scene.mesh, places), [t.name for t in scene.mesh.tissues]
    organ = scene.mesh.region[at.tet] == names.index(ORGAN)
    known = log_ratio[at.tet] + np.log(scene.tissues[names.index(ORGAN)].youngs_modulus_kpa or np.nan)
    theta = inversion.objective.parameters.moduli(minimum.unknowns)[names.index(ORGAN)]
    error = (found.log_ratio + np.log(theta) - known)[organ]
    region, near = found.region, np.linalg.norm(places - centre, axis=1) < BALL_RADIUS_MM
    ends = [np.nan if end is None else end for end in region.interval95] if region else []
    return {
        "limit_sd": round(limit, 2),
        "converged": minimum.converged,
        "found": region is not None,
        "probability": region and round(region.probability, 4),
        "off_mm": region and round(float(np.linalg.norm(region.centre_mm - centre)), 2),
        "volume_ml": region and round(region.volume_ml, 2),
        "region_contrast": region and [round(v, 2) for v in (region.contrast, *ends)],
        "in_ball": [
            *(round(float(of[organ & near].mean()), 2) for of in (found.log_ratio, found.sd)),
            round(float(found.log_ratio[organ & ~near].mean()), 2),
        ],
        "resolved": round(found.resolved, 3),
        "prior_sd": round(found.prior_sd, 3),
        "inside_95": round(float(np.mean(np.abs(error) < NORMAL_95 * found.sd[organ])), 3),
        "error_rms": round(float(np.sqrt(np.mean(error**2))), 3),
        "points": n_points,
        "modes": int(next(b.size for b in inversion.objective.parameters.blocks if b.cause == "field")),
        "seconds": round(time.perf_counter() - began, 1),
    }


def _field(
    truth: BodyWithBall, space: LagrangeSpace, sd_mm: float, rng: np.random.Generator
) -> tuple[PointDisplacement, int, float]:
    """Displacements on a lattice in and round the organ, with errors that are alike over a length; how many.

    Last, what the ball moves them by, in standard deviations of their errors.
    """
    scene, names = truth.scene, [t.name for t in truth.scene.mesh.tissues]
    own = scene.mesh.nodes[scene.mesh.tets[scene.mesh.region == names.index(ORGAN)]].reshape(-1, 3)
    low, high = own.min(axis=0) - ROUND_MM, own.max(axis=0) + ROUND_MM
    lattice = np.meshgrid(*(np.arange(a, b, LATTICE_MM) for a, b in zip(low, high, strict=True)), indexing="ij")
    places = np.stack(lattice, axis=-1).reshape(-1, 3)
    places = places[located(space.mesh, places).inside & located(scene.mesh, places).inside]
    at = point_interpolation(scene.space, located(scene.mesh, places))
    moved, by_ball = (np.asarray(at @ of) for of in (scene.displacement, scene.displacement - truth.without))
    root = np.linalg.cholesky(correlation(cdist(places, places), ALIKE_MM) + 1e-9 * np.eye(len(places)))
    limit = float(np.linalg.norm(linalg.solve_triangular(root, by_ball, lower=True))) / sd_mm
    moved = moved + sd_mm * root @ rng.normal(size=(len(places), 3))
    return point_term(space, places, moved, sd_mm, ALIKE_MM), len(places), limit


COLUMNS = {
    "limit": lambda row: f"{row['limit_sd']:.1f}",
    "probability": lambda row: f"{row['probability']:.3f}",
    "off": lambda row: f"{row['off_mm']:.1f} mm",
    "contrast": lambda row: str(row["region_contrast"]),
    "resolved": lambda row: f"{row['resolved']:.0%}",
    "inside 95 %": lambda row: f"{row['inside_95']:.0%}",
}

if __name__ == "__main__":
    raise SystemExit(main())
