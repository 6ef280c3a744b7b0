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
import json
import time
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from coverage_scenes import FIELD_MM, TRUTH_EDGE
from numpy.typing import NDArray
from scipy import linalg
from scipy.spatial.distance import cdist

from palpate.body import aligned, inverse_problem, make_body
from palpate.case import Case, Mechanics, MeshSettings, Phantom
from palpate.images import FieldPrior, segment
from palpate.inversion import InverseProblem, invert
from palpate.mechanics import law_named
from palpate.mesh import LagrangeSpace, lagrange_space, located, point_interpolation, tetrahedralise
from palpate.observation import DataFile, DisplacementField, PointDisplacement, PointTable, correlation
from palpate.phantoms import (
    BoundaryMotion,
    Noise,
    PelvisOptions,
    Scene,
    displacements,
    imaged,
    pelvis_anatomy,
    pelvis_grid,
    pelvis_motions,
    reimaged,
)
from palpate.study import inversion_settings
from palpate.uncertainty import NORMAL_95, Interval, sandwich_covariance, stiffness_maps
from palpate_validation.mismatch import patched

Array = NDArray[np.float64]

ORGAN = "prostate"
RADIUS_MM, DEPTH_MM = 7.0, 2.0  # of the ball, and of the tissue around it
LATTICE_MM, ROUND_MM, ALIKE_MM = 4.0, 15.0, 5.0
SURFACE_ALIKE_MM, ANOTHER = 6.0, 1000  # length of the surfaces' errors; between the seeds of two draws of them
PRIOR = FieldPrior(0.7, 8.0)


def main() -> int:
    """Run what was asked for and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bodies", type=int, default=2)
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=801)
    parser.add_argument("--field-sd-mm", type=float, nargs="+", default=[0.1])
    parser.add_argument("--surface-sd-mm", type=float, default=0.0)
    parser.add_argument("--gland-kpa", type=float, default=15.0)
    parser.add_argument("--filling-mm", type=float, default=14.0)
    parser.add_argument("--contrast", type=float, default=3.0)
    parser.add_argument("--edge", type=float, default=7.0, help="edge length (mm) of the estimate's mesh")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    asked = parser.parse_args()
    found = []
    for seed in range(asked.first_seed, asked.first_seed + asked.bodies):
        options = _options(seed, asked.gland_kpa, asked.filling_mm)
        truth = _truth(options, asked.contrast, asked.edge)
        for sd, draw in product(asked.field_sd_mm, range(asked.draws)):
            row = {"seed": seed, "draw": draw, "contrast": asked.contrast, "field_sd_mm": sd}
            row |= {"surface_sd_mm": asked.surface_sd_mm}
            drawn = _drawn(truth, asked.surface_sd_mm, draw)
            found.append(row | _estimated(drawn, sd, asked.edge, draw))
            if asked.output:
                with asked.output.open("a") as file:
                    file.write(json.dumps(found[-1]) + "\n")
            if not asked.json:
                print(json.dumps(found[-1]), flush=True)
    if asked.json:
        print(json.dumps({"simulated": True, "draws": found}, indent=1))
    return 0


@dataclass(frozen=True)
class _Truth:
    """A body with a ball; ln E over its tissue's geometric mean (n_tets,); the ball's centre (3,) mm.

    without (n_points, 3) mm: the displacement of the body without the ball.
    """

    scene: Scene
    log_ratio: Array
    centre: Array
    without: Array


def _options(seed: int, gland_kpa: float, filling_mm: float) -> PelvisOptions:
    drawn = float(np.random.default_rng([seed, 7]).uniform(6.0, 8.0))
    moduli = {ORGAN: gland_kpa} if gland_kpa else None
    return PelvisOptions(seed=seed, filling_mm=filling_mm or drawn, field_mm=FIELD_MM, moduli_kpa=moduli)


def _truth(options: PelvisOptions, contrast: float, edge_mm: float) -> _Truth:
    grid, law = pelvis_grid(options), law_named("linear")
    mesh = tetrahedralise(pelvis_anatomy(options), edge_length_mm=TRUTH_EDGE * edge_mm)
    space, number = lagrange_space(mesh, "P2"), next(i for i, t in enumerate(mesh.tissues) if t.name == ORGAN)
    centres, own = mesh.nodes[mesh.tets].mean(axis=1), mesh.region == number
    others, inside = centres[~own], np.flatnonzero(own)
    depth = np.array([np.linalg.norm(others - place, axis=1).min() for place in centres[inside]])
    deep = inside[depth > min(RADIUS_MM + DEPTH_MM, 0.95 * float(depth.max()))]
    centre = centres[np.random.default_rng([options.seed, 42]).choice(deep)]
    log_ratio = np.log(contrast) * (own & (np.linalg.norm(centres - centre, axis=1) < RADIUS_MM))
    log_ratio[own] -= np.average(log_ratio[own], weights=mesh.volumes[own])
    motion = BoundaryMotion(pelvis_motions(options))
    motions = [
        displacements(replace(space, mesh=patched(mesh, field)), [motion], law=law)[0]
        for field in (np.zeros_like(log_ratio), log_ratio)
    ]
    before, after = (imaged(space, moved, grid) for moved in (np.zeros_like(motions[1]), motions[1]))
    return _Truth(Scene(space, motions[1], before, after, motion.walls, options.seed), log_ratio, centre, motions[0])


def _drawn(truth: _Truth, surface_sd_mm: float, draw: int) -> _Truth:
    """The truth with its surfaces drawn in both images with errors of so many mm a component."""
    if not surface_sd_mm:
        return truth
    scene, noise = truth.scene, Noise(surface_sd_mm, SURFACE_ALIKE_MM)
    images = reimaged(replace(scene, seed=scene.seed + ANOTHER * draw), scene.before.grid, noise=noise)
    return replace(truth, scene=replace(scene, before=images.before, after=images.after))


def _estimated(truth: _Truth, sd_mm: float, edge_mm: float, draw: int) -> dict[str, Any]:
    """What the map says of one draw of the field's errors."""
    began, scene, log_ratio, centre = time.perf_counter(), truth.scene, truth.log_ratio, truth.centre
    case = Case("map", phantom=Phantom("pelvis"), mesh=MeshSettings(edge_mm), mechanics=Mechanics("linear", "auto"))
    tissues = tuple(replace(t, field=PRIOR) if t.name == ORGAN else t for t in scene.tissues)
    before, after = (segment(image, tissues) for image in (scene.before, scene.after))
    body = make_body(aligned(before, (after,), method="none"), case, progress=_silent)
    problem = inverse_problem(body, case, progress=_silent)
    state = problem.states[0]
    points, n_points, limit = _field(truth, body.space, sd_mm, np.random.default_rng([scene.seed, draw, 43]))
    state = state.with_observations([*state.observations, points])
    settings = inversion_settings(case, problem.parameters)
    inversion = invert(InverseProblem((state,), problem.parameters), settings, progress=_silent)
    minimum = inversion.minimum
    (found,) = stiffness_maps(inversion, np.diag(sandwich_covariance(inversion.objective, minimum.evaluation)))
    places = body.space.mesh.nodes[body.space.mesh.tets[found.elements]].mean(axis=1)
    at, names = located(scene.mesh, places), [t.name for t in scene.mesh.tissues]
    organ = scene.mesh.region[at.tet] == names.index(ORGAN)
    known = log_ratio[at.tet] + np.log(scene.tissues[names.index(ORGAN)].youngs_modulus_kpa or np.nan)
    theta = inversion.objective.parameters.moduli(minimum.unknowns)[names.index(ORGAN)]
    error = (found.log_ratio + np.log(theta) - known)[organ]
    region, near = found.region, np.linalg.norm(places - centre, axis=1) < RADIUS_MM
    return {
        "limit_sd": round(limit, 2),
        "converged": minimum.converged,
        "found": region is not None,
        "probability": region and round(region.probability, 4),
        "off_mm": region and round(float(np.linalg.norm(region.centre_mm - centre)), 2),
        "volume_ml": region and round(region.volume_ml, 2),
        "region_contrast": region and [round(v, 2) for v in (region.contrast, *_numbers(region.interval95))],
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
    truth: _Truth, space: LagrangeSpace, sd_mm: float, rng: np.random.Generator
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
    file = DataFile("field", "displacement-field", (Path("simulated.csv"),), 1, sd_mm, correlation_mm=ALIKE_MM)
    table = PointTable(places, places + moved, ("",) * len(places), ())
    return DisplacementField(file, table).on(space, _none)[0], len(places), limit


def _numbers(interval: Interval) -> tuple[float, ...]:
    return tuple(np.nan if end is None else end for end in interval)


def _none(name: str, direction: Array) -> NoReturn:
    raise AssertionError(f"a field needs no force on {name} along {direction}")


def _silent(message: str) -> None:
    del message


if __name__ == "__main__":
    raise SystemExit(main())
