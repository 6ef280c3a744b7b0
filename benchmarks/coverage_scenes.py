"""The rows of coverage.py: bodies with a known truth, errors of their drawn surfaces, and further measurements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NoReturn

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.distance import cdist

from palpate.images import Role, Tissue, VoxelGrid
from palpate.mechanics import law_named
from palpate.mesh import (
    OUTER,
    Anatomy,
    LagrangeSpace,
    lagrange_space,
    located,
    point_interpolation,
    tetrahedralise,
    vertex_normals,
)
from palpate.observation import (
    DataFile,
    DisplacementField,
    Landmarks,
    NoiseModel,
    PointDisplacement,
    PointTable,
    correlation,
    observed_surface,
)
from palpate.phantoms import (
    BoundaryMotion,
    Ellipsoid,
    PelvisOptions,
    Scene,
    SmoothField,
    SpheresOptions,
    WallMotion,
    ball,
    centred_grid,
    displacements,
    grid_box,
    imaged,
    pelvis_anatomy,
    pelvis_grid,
    pelvis_motions,
    refuse_folded,
    rotation_about,
    smooth_field,
    spheres,
)
from palpate_validation.mismatch import patched
from palpate_validation.truth import ScaledMotion

__all__ = ["NOISES", "POINTS", "ROWS", "TRUTHS", "Points", "Row", "Skin", "measured_points", "skins_of"]

Array = NDArray[np.float64]

TRUTH_EDGE = 0.68  # of the estimate's
FIELD_MM, LARGER_MM = (110.0, 120.0, 120.0), (140.0, 146.0, 146.0)
BORDER_RMS_MM, BORDER_LENGTH_MM = (1.0, 2.5), (40.0, 80.0)
PATCH_SD, PATCH_LENGTH_MM = (0.3, 0.6), (20.0, 30.0)  # of ln E
FEATURES = 400  # waves of a random field, which are drawn anew for each
SHRUNK_MM = 0.2
BUMPED, BUMP_MM, BUMP_RADIUS_MM = 0.05, (2.0, 4.0), (4.0, 7.0)
SMOOTHED_MM = 2.0  # width of a Gaussian
NU_SD = 0.02
INSIDE_MM = 4.0  # of the images' border: points lie deeper


# ---- bodies ----------------------------------------------------------------------------------------------------------


def _pelvis(
    seed: int, law: str, edge_mm: float, *, filling_mm: float | None = None, moving: bool = False, patchy: bool = False
) -> Scene:
    """A random pelvis; `moving`: cut out of a larger body, whose border moves smoothly; `patchy`: ln E varies in all.

    What a patchy tissue states is the geometric mean of its modulus.
    """
    filling = filling_mm or float(np.random.default_rng([seed, 7]).uniform(6.0, 8.0))
    options = PelvisOptions(seed=seed, filling_mm=filling, field_mm=LARGER_MM if moving else FIELD_MM)
    grid = pelvis_grid(replace(options, field_mm=FIELD_MM))
    mesh = tetrahedralise(pelvis_anatomy(options), edge_length_mm=TRUTH_EDGE * edge_mm)
    space, solved, border = lagrange_space(mesh, "P2"), None, None
    rng = np.random.default_rng([seed, 38])
    if patchy:
        sd, length = rng.uniform(*PATCH_SD), rng.uniform(*PATCH_LENGTH_MM)
        drawn = smooth_field(rng, sd_mm=sd, correlation_mm=length).at(mesh.nodes[mesh.tets].mean(axis=1))
        solved = replace(space, mesh=patched(mesh, drawn[np.arange(len(mesh.tets)), np.minimum(mesh.region, 2)]))
    if moving:
        border = _border(rng, space)
    return _solved(space, solved or space, BoundaryMotion(pelvis_motions(options), border), law, grid, seed)


def _border(rng: np.random.Generator, space: LagrangeSpace) -> ScaledMotion:
    """A smooth motion of the outer border of 1 to 2.5 mm, root mean square, by a field of 40 to 80 mm."""
    rms, field = (
        rng.uniform(*BORDER_RMS_MM),
        smooth_field(rng, sd_mm=1.0, correlation_mm=rng.uniform(*BORDER_LENGTH_MM)),
    )
    drawn = field.at(space.points[np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == OUTER]))])
    return ScaledMotion(field, float(rms / np.sqrt(np.mean(np.sum(drawn**2, axis=1)))))


def _solved(
    space: LagrangeSpace, solved: LagrangeSpace, motion: BoundaryMotion, law: str, grid: VoxelGrid, seed: int
) -> Scene:
    """The scene of a body `space` that moves as `solved`, the same with other moduli, does."""
    displacement = displacements(solved, [motion], law=law_named(law))[0]
    refuse_folded(space, displacement)
    before, after = (imaged(space, moved, grid) for moved in (np.zeros_like(displacement), displacement))
    return Scene(space, displacement, before, after, motion.walls, seed)


def _balls(seed: int, law: str, edge_mm: float) -> Scene:
    """A ball with a tumour out of its centre, in a frame that is squeezed."""
    del edge_mm
    return spheres(SpheresOptions(seed=seed, kind="tumour", law=law, truth_edge_mm=3.0))


@dataclass(frozen=True)
class _Swelling:
    """A ball that fills: u = push_mm (x - centre) / radius_mm."""

    centre: Array
    radius_mm: float
    push_mm: float

    def at(self, points: Array) -> Array:
        """Displacement (n, 3) mm at wall points (n, 3) mm."""
        return self.push_mm * (points - self.centre) / self.radius_mm


def _liver(seed: int, law: str, edge_mm: float) -> Scene:
    """A liver of 84 to 92 mm, a kidney below it, and next to both a stomach that fills by 3.5 to 4.5 mm."""
    rng = np.random.default_rng([seed, 39])
    turn = rotation_about(rng.normal(size=3), rng.uniform(0.0, 18.0))
    liver = Ellipsoid(np.array([-8.0, 0.0, 12.0]) @ turn.T, rng.uniform([42.0, 28.0, 22.0], [46.0, 32.0, 25.0]), turn)
    kidney = Ellipsoid(
        np.array([-18.0, 0.0, -28.0]) @ turn.T, rng.uniform([15.0, 13.0, 11.0], [17.0, 15.0, 13.0]), turn
    )
    stomach = np.array([20.0, rng.uniform(-4.0, 4.0), -28.0]) @ turn.T
    moduli = 10.0 * np.exp(rng.uniform(np.log(1.5), np.log(6.0), 2))
    nu = rng.uniform(0.40, 0.45, 3)
    tissues = (
        Tissue("liver", Role.ESTIMATE, (1,), float(nu[0]), float(moduli[0])),
        Tissue("kidney", Role.ESTIMATE, (2,), float(nu[1]), float(moduli[1])),
        Tissue("stomach", Role.DRIVER, (3,)),
        Tissue("surroundings", Role.KNOWN, (4,), float(nu[2]), 10.0),
    )
    grid = centred_grid((116.0, 100.0, 108.0), (1.0, 1.0, 1.0))
    anatomy = Anatomy(tissues, (liver, kidney, ball(stomach, 13.0), None), grid_box(grid))
    space = lagrange_space(tetrahedralise(anatomy, edge_length_mm=TRUTH_EDGE * edge_mm), "P2")
    walls: dict[str, WallMotion] = {"stomach": _Swelling(stomach, 13.0, float(rng.uniform(3.5, 4.5)))}
    return _solved(space, space, BoundaryMotion(walls), law, grid, seed)


TRUTHS: dict[str, Callable[[int, str, float], Scene]] = {
    "pelvis": _pelvis,
    "small": partial(_pelvis, filling_mm=3.0),
    "moving": partial(_pelvis, moving=True),
    "patchy": partial(_pelvis, patchy=True),
    "balls": _balls,
    "liver": _liver,
}


# ---- errors of a drawing ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Skin:
    """A drawn surface of a truth in one image: places (n, 3) mm, triangles (m, 3) and outward normals (n, 3)."""

    places: Array
    triangles: NDArray[np.int64]
    normals: Array


Shift = Callable[[Sequence[Skin], np.random.Generator, bool], list[Array]]
"""How far (n,) mm outwards each surface of an image is drawn; the last argument: of the later image."""


def skins_of(scene: Scene, tissues: Sequence[int], *, later: bool) -> list[Skin]:
    """The true surfaces of tissues in one of both images."""
    truths = [observed_surface(scene.space, tissue) for tissue in tissues]
    places = [t.rest + (scene.displacement[t.points] if later else 0.0) for t in truths]
    return [Skin(p, t.triangles, vertex_normals(p, t.triangles)) for p, t in zip(places, truths, strict=True)]


def _along(field: SmoothField, skins: Sequence[Skin]) -> list[Array]:
    return [np.asarray(np.einsum("ni,ni->n", field.at(skin.places), skin.normals)) for skin in skins]


def _gauss(
    skins: Sequence[Skin], rng: np.random.Generator, later: bool, *, sd_mm: float, length_mm: float
) -> list[Array]:
    """A normal field of its own in each image."""
    del later
    return _along(smooth_field(rng, sd_mm=sd_mm, correlation_mm=length_mm, features=FEATURES), skins)


def _matern(skins: Sequence[Skin], rng: np.random.Generator, later: bool) -> list[Array]:
    """The same by Matern's kernel 3/2, (1 + sqrt(3) d / l) exp(-sqrt(3) d / l), 0.2 mm and l = 6 mm: it is rough.

    Its spectrum is Student's law with three degrees of freedom.
    """
    field = smooth_field(rng, sd_mm=0.2, correlation_mm=6.0, features=FEATURES)
    stretch = np.sqrt(3.0 / rng.chisquare(3.0, size=FEATURES))
    del later
    return _along(replace(field, frequencies=field.frequencies * stretch[:, None]), skins)


def _bumps(skins: Sequence[Skin], rng: np.random.Generator, later: bool) -> list[Array]:
    """A normal field of 0.1 mm, and bumps or dents of 2 to 4 mm on 5 % of each surface."""
    found = []
    for skin, smooth in zip(skins, _gauss(skins, rng, later, sd_mm=0.1, length_mm=6.0), strict=True):
        left, error = BUMPED * float(igl.doublearea(skin.places, skin.triangles).sum()) / 2.0, smooth.copy()
        while left > 0.0:
            radius, height = rng.uniform(*BUMP_RADIUS_MM), rng.uniform(*BUMP_MM) * rng.choice([-1.0, 1.0])
            away = np.linalg.norm(skin.places - skin.places[rng.integers(len(skin.places))], axis=1) / radius
            error += height * np.maximum(1.0 - away**2, 0.0) ** 2
            left -= np.pi * radius**2
        found.append(error)
    return found


def _uneven(skins: Sequence[Skin], rng: np.random.Generator, later: bool) -> list[Array]:
    """The first image is drawn smoothly, 0.1 mm over 12 mm, the later one roughly, 0.3 mm over 4 mm."""
    sd, length = (0.3, 4.0) if later else (0.1, 12.0)
    return _gauss(skins, rng, later, sd_mm=sd, length_mm=length)


def _resegmented(skins: Sequence[Skin], rng: np.random.Generator, later: bool) -> list[Array]:
    """A normal field of 0.1 mm; also a Gaussian of 2 mm smooths the later image's organs.

    That moves a surface by its mean curvature: a step of width^2 / 2 of the heat equation on it.
    """
    found = _gauss(skins, rng, later, sd_mm=0.1, length_mm=6.0)
    if not later:
        return found
    smoothed = []
    for skin, own in zip(skins, found, strict=True):
        mass = sparse.csc_matrix(igl.massmatrix(skin.places, skin.triangles))
        heat = sparse.csc_matrix(mass - 0.5 * SMOOTHED_MM**2 * igl.cotmatrix(skin.places, skin.triangles))
        moved = np.asarray(spsolve(heat, mass @ skin.places)) - skin.places
        smoothed.append(own + np.einsum("ni,ni->n", moved, skin.normals))
    return smoothed


def _shrunk(skins: Sequence[Skin], rng: np.random.Generator, later: bool) -> list[Array]:
    """In the later image every organ and the driver are drawn 0.2 mm smaller, with a field of 0.1 mm."""
    found = _gauss(skins, rng, later, sd_mm=0.1, length_mm=6.0)
    return [own - (SHRUNK_MM if later else 0.0) for own in found]


NOISES: dict[str, Shift] = {
    "gauss-0.1": partial(_gauss, sd_mm=0.1, length_mm=6.0),
    "gauss-0.2": partial(_gauss, sd_mm=0.2, length_mm=6.0),
    "gauss-0.3": partial(_gauss, sd_mm=0.3, length_mm=6.0),
    "matern": _matern,
    "bumps": _bumps,
    "uneven": _uneven,
    "resegmented": _resegmented,
    "shrunk": _shrunk,
}


# ---- points that are measured ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Points:
    """So many points inside the body, whose displacements err by sd_mm a component, alike over a length (0: alone)."""

    n: int
    sd_mm: float
    length_mm: float = 0.0


POINTS = {
    "markers": Points(30, 0.3),
    "field-1": Points(1500, 1.0, 5.0),
    "field-0.5": Points(1500, 0.5, 5.0),
    "field-0.2": Points(1500, 0.2, 5.0),
}


def measured_points(
    scene: Scene, space: LagrangeSpace, points: Points, rng: np.random.Generator | None
) -> PointDisplacement:
    """The term of points at random places on an estimate's `space`, which err where an `rng` is given."""
    low, high = space.points.min(axis=0) + INSIDE_MM, space.points.max(axis=0) - INSIDE_MM
    places = np.random.default_rng([scene.seed, 40]).uniform(low, high, (4 * points.n, 3))
    inside = located(space.mesh, places).inside & located(scene.mesh, places).inside
    places = places[inside][: points.n]
    moved = point_interpolation(scene.space, located(scene.mesh, places)) @ scene.displacement
    if rng is not None:
        covariance = correlation(cdist(places, places), points.length_mm)
        root = np.linalg.cholesky(covariance)
        moved = moved + points.sd_mm * root @ rng.normal(size=(len(places), 3))
    kind = "displacement-field" if points.length_mm else "landmarks"
    file = DataFile(kind, kind, (Path("simulated.csv"),), 1, points.sd_mm, correlation_mm=points.length_mm)
    table = PointTable(places, places + moved, ("",) * len(places), ())
    source = DisplacementField(file, table) if points.length_mm else Landmarks(file, table)
    return source.on(space, _no_reaction)[0]


def _no_reaction(name: str, direction: Array) -> NoReturn:
    raise AssertionError(f"points need no force on {name} along {direction}")


# ---- rows ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """What is drawn: a key of TRUTHS, of NOISES and of POINTS ("": none), the truth's law and the estimate's.

    noise: of a residual, where a Cramer-Rao limit is computed, too.
    """

    name: str
    truth: str
    noise: str
    points: str = ""
    law: str = "linear"
    truth_law: str = "linear"
    limit: NoiseModel | None = None


def _normal(sd_mm: float) -> NoiseModel:
    return NoiseModel(np.array([2.0 * sd_mm**2]), np.array([6.0]))


ROWS = {
    row.name: row
    for row in (
        Row("gauss-0.1", "pelvis", "gauss-0.1", limit=_normal(0.1)),
        Row("gauss-0.2", "pelvis", "gauss-0.2", limit=_normal(0.2)),
        Row("matern", "pelvis", "matern"),
        Row("bumps", "pelvis", "bumps"),
        Row("uneven", "pelvis", "uneven"),
        Row("resegmented", "pelvis", "resegmented"),
        Row("shrunk", "pelvis", "shrunk"),
        Row("patchy", "patchy", "gauss-0.1"),
        Row("moving", "moving", "gauss-0.1", limit=_normal(0.1)),
        Row("balls", "balls", "gauss-0.1"),
        Row("liver", "liver", "gauss-0.1"),
        Row("other-law", "small", "gauss-0.1", truth_law="neo-hookean"),
        Row("finite", "pelvis", "gauss-0.1", law="neo-hookean", truth_law="neo-hookean"),
        Row("surfaces", "moving", "gauss-0.3", limit=_normal(0.3)),
        *(Row(name, "moving", "gauss-0.3", points=name, limit=_normal(0.3)) for name in POINTS),
    )
}
