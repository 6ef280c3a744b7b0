"""Random pelves that are as hard to mesh as real segmentations: thick slices, thin organs, organs that touch."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.images import LabelImage, VoxelGrid, write_label_image
from palpate.phantoms import Ellipsoid, PelvisShapes, Tube, centred_grid, draw_pelvis, grid_box, rotation_about

__all__ = ["RandomPelvis", "random_pelvis", "write_images"]

REACH_MM = 35.0  # over which the rectum's filling dies away in what surrounds it


@dataclass(frozen=True)
class RandomPelvis:
    """A pelvis before and after its rectum has filled, and in words what makes it hard."""

    before: LabelImage
    after: LabelImage
    what: str


def random_pelvis(seed: int) -> RandomPelvis:
    """The pelvis of a seed: slices of 3 to 5 mm; thin, touching organs and bones by turns; a field of 120 to 150 mm.

    No mechanics: the rectum's wall moves out by some millimetres, and what surrounds it gives way as around a cylinder
    that keeps the volume of its surroundings.
    """
    rng = np.random.default_rng([seed, 18])
    slices, pixel = rng.uniform(3.0, 5.0), rng.uniform(0.9, 2.0)
    field = tuple(rng.uniform([120.0, 125.0, 125.0], 150.0))
    grid = centred_grid(field, (pixel, pixel, slices))
    bones, vesicles, wall, touching, tumour = (bool(seed >> bit & 1) for bit in range(5))
    body = draw_pelvis(rng, grid_box(grid), bones=bones)
    if touching:
        body = _touching(body, rng)
    what = [f"{pixel:.1f} x {slices:.1f} mm"]
    organs: dict[str, Ellipsoid] = {}
    if tumour:
        organs["prostate_tumour"] = body.tumour
        what.append("tumour")
    if vesicles:
        organs |= _vesicles(body, rng)
        what.append("vesicles")
    organs |= {"prostate": body.prostate}
    if wall:
        thickness = rng.uniform(4.0, 7.0)
        inner = Ellipsoid(body.bladder.centre, body.bladder.semi_axes - thickness, body.bladder.rotation)
        organs |= {"bladder_lumen": inner, "bladder_wall": body.bladder}
        what.append(f"wall {thickness:.1f} mm")
    else:
        organs |= {"bladder": body.bladder}
    if touching:
        what.append("touching")
    held = dict(zip(("left_hip", "right_hip"), body.bones, strict=True)) if bones else {}
    if bones:
        what.append("bones")
    filling = rng.uniform(3.0, 6.0)
    before, after = (_imaged(grid, body.rectum, organs, held, filling_mm=filled) for filled in (0.0, filling))
    return RandomPelvis(before, after, ", ".join(what))


def write_images(folder: Path, body: RandomPelvis) -> tuple[Path, Path, Path]:
    """The two label images and their table in `folder`."""
    paths = folder / "before.nii.gz", folder / "after.nii.gz", folder / "names.json"
    write_label_image(paths[0], body.before)
    write_label_image(paths[1], body.after)
    paths[2].write_text(json.dumps({str(label): name for label, name in body.before.names.items()}))
    return paths


def _touching(body: PelvisShapes, rng: np.random.Generator) -> PelvisShapes:
    """The rectum brought to the prostate until it overlaps it by up to 2 mm, and the bones nearer to it."""
    knots, wanted = body.rectum.knots, -rng.uniform(0.0, 2.0)
    points = body.prostate.surface(_directions(400))
    for _ in range(20):
        gap = float(Tube(knots, body.rectum.radii).at(points).min()) - wanted
        knots = knots + gap * body.forwards
    middle = body.prostate.centre
    aside = [bone.centre - middle for bone in body.bones]
    nearer = [way * (1.0 - rng.uniform(4.0, 8.0) / np.linalg.norm(way)) for way in aside]
    bones = [
        Ellipsoid(middle + way, bone.semi_axes, bone.rotation) for way, bone in zip(nearer, body.bones, strict=True)
    ]
    rectum = Tube(knots, body.rectum.radii)
    return PelvisShapes(body.prostate, body.bladder, rectum, body.tumour, (bones[0], bones[1]), body.forwards)


def _vesicles(body: PelvisShapes, rng: np.random.Generator) -> dict[str, Ellipsoid]:
    """Two flat organs behind prostate and bladder, 6 to 10 mm thick."""
    behind = 0.5 * (body.prostate.centre + body.bladder.centre) - 20.0 * body.forwards
    aside = np.cross(body.forwards, [0.0, 0.0, 1.0])
    found = {}
    for name, side in (("left_vesicle", -1.0), ("right_vesicle", 1.0)):
        axes = np.array([rng.uniform(11.0, 15.0), *rng.uniform(3.0, 5.0, 2)])
        turn = rotation_about(rng.normal(size=3), rng.uniform(0.0, 25.0))
        found[name] = Ellipsoid(behind + side * 13.0 * aside, axes, turn)
    return found


def _imaged(
    grid: VoxelGrid,
    rectum: Tube,
    organs: dict[str, Ellipsoid],
    held: dict[str, Ellipsoid],
    *,
    filling_mm: float,
) -> LabelImage:
    """Labels by the voxels' centres; the rectum wins over bones, these over organs, and of these the first."""
    centres = grid.world(np.argwhere(np.ones(grid.shape, dtype=bool)).astype(float))
    rest = _at_rest(centres, rectum, filling_mm)
    inside = {"rectum": rectum.at(rest) < 0.0}
    inside |= {name: bone.at(centres) < 0.0 for name, bone in held.items()}
    inside |= {name: organ.at(rest) < 0.0 for name, organ in organs.items()}
    labels = np.full(len(centres), len(inside) + 1, dtype=np.int32)
    for label, mask in reversed(list(enumerate(inside.values(), start=1))):
        labels[mask] = label
    names = dict(enumerate((*inside, "body"), start=1))
    return LabelImage(labels.reshape(grid.shape), grid, names)


def _at_rest(points: NDArray[np.float64], rectum: Tube, filling_mm: float) -> NDArray[np.float64]:
    """Where points (n, 3) mm of the filled body lie at rest: r^2 about the rectum's centre line less a constant."""
    place, spoke = rectum.coordinates(points)
    radius = np.linalg.norm(spoke, axis=1)
    wall = float(rectum.radii.mean())
    gained = ((wall + filling_mm * np.sin(np.pi * place)) ** 2 - wall**2) * np.exp(-((radius / REACH_MM) ** 2) / 2.0)
    at_rest = np.sqrt(np.maximum(radius**2 - gained, 0.0))
    return np.asarray(points - spoke * (1.0 - at_rest / np.maximum(radius, 1e-9))[:, None])


def _directions(n: int) -> NDArray[np.float64]:
    vectors = np.random.default_rng(0).normal(size=(n, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
