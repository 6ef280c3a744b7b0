"""Random male pelves: a prostate that touches the bladder above it, the rectum behind, bones at the sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ConfigurationError
from palpate.mesh.anatomy import Box
from palpate.phantoms.shapes import Ellipsoid, Tube, Union, rotation_about

DRAWS = 40
MARGIN_MM, RECTUM_MARGIN_MM = 5.0, 13.0  # to the border of the image; the rectum needs room to fill
GAP_MM = 3.0  # between bones and organs, at least
TURN_DEG = 18.0
FORWARDS_MM = 4.0  # from the image's middle to the body's, which leaves room behind the rectum


@dataclass(frozen=True, slots=True)
class PelvisShapes:
    """The organs' shapes and places; `forwards` (3,): unit vector from the rectum to the front of the body."""

    prostate: Ellipsoid
    bladder: Ellipsoid
    rectum: Tube
    tumour: Ellipsoid
    bones: tuple[Ellipsoid, Ellipsoid]
    forwards: NDArray[np.float64]


def draw_pelvis(rng: np.random.Generator, box: Box, *, bones: bool) -> PelvisShapes:
    """A pelvis of random shape, position and orientation that fits into `box`; its axes are near right, front and up.

    The same `rng` state gives the same body, with or without its tumour or bones, unless the bones do not fit. Raises
    `ConfigurationError` when the box is too small.
    """
    for _ in range(DRAWS):
        body = _placed(_upright(rng), rng, box)
        margins: list[tuple[Ellipsoid | Tube, float]] = [(body.prostate, MARGIN_MM), (body.bladder, MARGIN_MM)]
        margins += [(body.rectum, RECTUM_MARGIN_MM), *((bone, GAP_MM) for bone in body.bones if bones)]
        places = [box.local(shape.surface(_directions(400))) for shape, _ in margins]
        clearances = [np.minimum(local, box.lengths - local).min() for local in places]
        inside = all(found > margin for found, (_, margin) in zip(clearances, margins, strict=True))
        soft = Union([body.prostate, body.bladder, body.rectum])
        apart = not bones or all(soft.at(bone.surface(_directions(400))).min() > GAP_MM for bone in body.bones)
        if inside and apart:
            return body
    raise ConfigurationError(
        f"no pelvis fits into a field of {np.round(box.lengths, 1).tolist()} mm; give at least 110 x 120 x 120 mm"
    )


def _upright(rng: np.random.Generator) -> PelvisShapes:
    """A body in its own axes, with the prostate's centre at the origin."""
    prostate = Ellipsoid(np.zeros(3), rng.uniform(17.0, 22.0, 3), _turn(rng, 15.0))
    up = rotation_about(np.array([1.0, 0.0, 0.0]), -rng.uniform(0.0, 12.0)) @ np.array([0.0, 0.0, 1.0])
    semi_axes = np.array([*rng.uniform(23.0, 29.0, 2), rng.uniform(21.0, 25.0)])
    turn = _turn(rng, 12.0)
    reach = _reach(prostate.semi_axes, prostate.rotation, up) + _reach(semi_axes, turn, up)
    bladder = Ellipsoid((reach - rng.uniform(3.5, 6.0)) * up, semi_axes, turn)
    # a tube some 65 mm long behind the organs, moved until its gap to them is 8 to 10 mm
    height = np.linspace(-0.5, 0.5, 5)
    length = rng.uniform(40.0, 44.0)
    bend, lean, side = rng.uniform(2.0, 8.0), rng.uniform(-3.0, 3.0), rng.uniform(-3.0, 3.0)
    across = side + rng.uniform(-4.0, 4.0) * height
    along = rng.uniform(11.0, 17.0) + length * height
    knots = np.column_stack([across, -45.0 + lean * height - bend * height**2, along])
    radii = rng.uniform(13.0, 14.5, 5)
    gap, organs = rng.uniform(8.0, 10.0), Union([prostate, bladder])
    for _ in range(20):
        excess = float(organs.at(Tube(knots, radii).surface(_directions(400))).min()) - gap
        if abs(excess) < 1e-3:
            break
        knots = knots + np.array([0.0, excess, 0.0])
    rectum = Tube(knots, radii)
    # a tumour of at least 5 mL, off the prostate's centre, and at least 2 mm below its surface where there is room
    semi_axes, turn = rng.uniform(10.7, 11.8, 3), _turn(rng, 90.0)
    away = 6.0 * _directions(1, rng)[0]
    for share in np.linspace(1.0, 0.0, 11):
        tumour = Ellipsoid(prostate.centre + share * away, semi_axes, turn)
        if prostate.at(tumour.surface(_directions(400))).max() < -2.0:
            break
    bones = []
    for side in (-1.0, 1.0):
        semi_axes = rng.uniform([6.0, 12.0, 12.0], [8.0, 16.0, 16.0])
        aside = _reach(prostate.semi_axes, prostate.rotation, np.array([1.0, 0.0, 0.0])) + semi_axes[0]
        centre = np.array([side * (aside + rng.uniform(6.0, 9.0)), *rng.uniform([-4.0, -8.0], [4.0, 0.0])])
        bones.append(Ellipsoid(centre, semi_axes, _turn(rng, 15.0)))
    return PelvisShapes(prostate, bladder, rectum, tumour, (bones[0], bones[1]), np.array([0.0, 1.0, 0.0]))


def _placed(body: PelvisShapes, rng: np.random.Generator, box: Box) -> PelvisShapes:
    """The body turned by up to 18 degrees and put near the middle of the box."""
    turn = _turn(rng, TURN_DEG)
    organs: tuple[Ellipsoid | Tube, ...] = (body.prostate, body.bladder, body.rectum)
    points = np.concatenate([organ.surface(_directions(400)) for organ in organs]) @ turn.T
    forwards = turn @ body.forwards
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    target = box.world(0.5 * box.lengths[None])[0] + FORWARDS_MM * forwards + rng.uniform(-2.0, 2.0, 3)
    shift = target - middle

    def moved(shape: Ellipsoid) -> Ellipsoid:
        """The ellipsoid turned and shifted with the body."""
        return Ellipsoid(shape.centre @ turn.T + shift, shape.semi_axes, turn @ shape.rotation)

    bones = (moved(body.bones[0]), moved(body.bones[1]))
    rectum = Tube(body.rectum.knots @ turn.T + shift, body.rectum.radii)
    return PelvisShapes(moved(body.prostate), moved(body.bladder), rectum, moved(body.tumour), bones, forwards)


def _reach(semi_axes: NDArray[np.float64], rotation: NDArray[np.float64], direction: NDArray[np.float64]) -> float:
    """Distance (mm) from an ellipsoid's centre to its surface along a unit direction."""
    return float(1.0 / np.linalg.norm((direction @ rotation) / semi_axes))


def _turn(rng: np.random.Generator, largest_deg: float) -> NDArray[np.float64]:
    return rotation_about(rng.normal(size=3), rng.uniform(0.0, largest_deg))


def _directions(n: int, rng: np.random.Generator | None = None) -> NDArray[np.float64]:
    """Unit vectors (n, 3); without `rng` always the same."""
    vectors = (rng or np.random.default_rng(0)).normal(size=(n, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
