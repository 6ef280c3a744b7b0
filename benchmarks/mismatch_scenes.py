"""The scenes of mismatch.py: simulated pelves whose images do what real pairs do, each a folder with a case.toml.

A truth is a random pelvis in a field of 140 x 146 x 146 mm, solved on a mesh finer than the estimate's; scenes of one
body share it. Truths and scenes are made once and kept in a folder: `scene_folder` gives the scene, made or not.
"""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError, NotConverged
from palpate.images import LabelImage, Role, VoxelGrid, write_label_image
from palpate.mechanics import law_named
from palpate.mesh import OUTER, LagrangeSpace, TetMesh, lagrange_space, tetrahedralise
from palpate.observation import observed_surface
from palpate.phantoms import (
    AffineMotion,
    BoundaryMotion,
    PelvisOptions,
    ScaledMotion,
    displacements,
    imaged,
    patched,
    pelvis_anatomy,
    pelvis_grid,
    pelvis_motions,
    redrawn,
    rotation_about,
    smooth_field,
)

__all__ = ["KINDS", "SceneKey", "scene_folder"]

Array = NDArray[np.float64]
Facts = dict[str, Any]  # what is told of a scene, in JSON's types

VERSION = 1  # of what the seeds mean: a folder of another version is refused
FIELD_MM = (140.0, 146.0, 146.0)
TRUTH_EDGE_MM = 2.7  # at the organs; the estimate's default is some 4 mm
NOISE_LENGTH_MM = 6.0
ORGANS, DRIVER, KNOWN = ("prostate", "bladder"), "rectum", "surroundings"
CROP_MM, CROP_TURN_DEG, CROP_MARGIN_MM = (45.0, 60.0), 5.0, 4.0
BORDER_RMS_MM, BORDER_LENGTH_MM = (1.0, 2.5), (40.0, 80.0)
SHIFT_MM, SHIFT_DEG = (3.0, 8.0), (2.0, 6.0)
FOV_MM, FOV_SIDES = (4.0, 10.0), (3, 5)
ORGANS_OFF_MM, DRIVER_OFF_MM = 0.25, 1.0  # smaller for odd seeds, larger for even ones
FILLINGS = (1.0, 0.8, 0.6, 0.4)  # of the rectum's 6 to 8 mm: the first at which no tetrahedron of the truth folds over
STIFFER = 3.0  # one half of the surroundings than the other


@dataclass(frozen=True)
class SceneKey:
    """Which scene: a kind of KINDS, the body's seed, the law of its truth, and the surfaces' noise, mm (0: clean)."""

    kind: str
    seed: int
    law: str = "linear"
    noise_mm: float = 0.0

    @property
    def name(self) -> str:
        """The scene's name, which is its folder's and its case's."""
        return f"{self.kind}-{self.seed}-{self.law}-{f'{self.noise_mm:g}mm' if self.noise_mm else 'clean'}"


@dataclass(frozen=True)
class Truth:
    """A solved body: displacement (n_points, 3) mm on `space`, and what is told of it."""

    space: LagrangeSpace
    displacement: Array
    facts: Facts


@dataclass(frozen=True)
class View:
    """What the two images of a truth show: their grids, where the body lies in the later one, how much it is redrawn.

    `lies`: the rigid motion of the whole deformed body; `off_mm`: by tissue, how far outwards it is drawn.
    """

    before: VoxelGrid
    after: VoxelGrid
    lies: AffineMotion | None = None
    off_mm: Mapping[str, float] | None = None


# ---- kinds of scenes -------------------------------------------------------------------------------------------------


def _still(truth: Truth, seed: int) -> tuple[View, Facts]:
    """The images end where the truth's border lies."""
    del truth
    grid = pelvis_grid(_options(seed))
    return View(grid, grid), {}


def _crop(truth: Truth, seed: int) -> tuple[View, Facts]:
    """Both images end 45 to 60 mm from the centre, or 4 mm beyond the organs; axes turned by up to 5 degrees."""
    rng = _rng(seed, "crop")
    turn = rotation_about(rng.normal(size=3), rng.uniform(0.0, CROP_TURN_DEG))
    sides = rng.uniform(*CROP_MM, (2, 3))
    low, high = _extent(truth, turn)
    sides = np.maximum(sides, np.stack([-low, high]) + CROP_MARGIN_MM)
    corner = -sides[0] + rng.uniform(0.0, 1.0, 3)
    shape = np.ceil(sides.sum(axis=0)).astype(int)
    grid = _grid(corner, shape, turn)
    return View(grid, grid), {"crop_mm": sides.round(2).tolist()}


def _shift(truth: Truth, seed: int) -> tuple[View, Facts]:
    """The patient lies elsewhere in the later image: a rigid motion of 3 to 8 mm and 2 to 6 degrees."""
    view, _ = _still(truth, seed)
    rng = _rng(seed, "shift")
    way, degrees = rng.normal(size=3), rng.uniform(*SHIFT_DEG)
    way *= rng.uniform(*SHIFT_MM) / np.linalg.norm(way)
    axis = rng.normal(size=3)
    motion = AffineMotion(rotation_about(axis, degrees) - np.eye(3), np.zeros(3), way)
    facts = {"shift_mm": way.round(3).tolist(), "axis": (axis / np.linalg.norm(axis)).tolist(), "degrees": degrees}
    return replace(view, lies=motion), facts


def _organs(truth: Truth, seed: int) -> tuple[View, Facts]:
    """The organs are drawn 0.25 mm smaller, or larger, in the later image, each alone."""
    view, _ = _still(truth, seed)
    off = dict.fromkeys(ORGANS, _sign(seed) * ORGANS_OFF_MM)
    return replace(view, off_mm=off), {"off_mm": off}


def _driver(truth: Truth, seed: int) -> tuple[View, Facts]:
    """The rectum is drawn 1 mm thinner, or thicker, in the later image."""
    view, _ = _still(truth, seed)
    off = {DRIVER: _sign(seed) * DRIVER_OFF_MM}
    return replace(view, off_mm=off), {"off_mm": off}


@dataclass(frozen=True)
class Kind:
    """A kind of scene: the truth that it shows, a key of TRUTHS, and how."""

    truth: str
    view: Callable[[Truth, int], tuple[View, Facts]]
    what: str


KINDS = {
    "still": Kind("held", _still, "nothing is mismatched"),
    "crop": Kind("held", _crop, "cropped, the truth held where it was"),
    "border": Kind("border", _still, "the truth's border moves smoothly"),
    "shift": Kind("held", _shift, "the patient lies elsewhere"),
    "organs": Kind("held", _organs, "organs drawn 0.25 mm smaller or larger"),
    "driver": Kind("held", _driver, "rectum drawn 1 mm thinner or thicker"),
    "halves": Kind("halves", _still, "surroundings three times stiffer in a half"),
}


# ---- scenes ----------------------------------------------------------------------------------------------------------


def scene_folder(key: SceneKey, cache: Path) -> Path:
    """The folder of a scene in `cache`, made if it is not there: before.nii.gz, after.nii.gz, case.toml, truth.json.

    Raises `SystemExit` where the folder is of another version of this benchmark.
    """
    folder = cache / key.name
    if (folder / "truth.json").exists():
        _refuse_version(json.loads((folder / "truth.json").read_text())["version"], folder)
        return folder
    kind = KINDS[key.kind]
    truth = _truth(kind.truth, key.seed, key.law, cache)
    view, facts = kind.view(truth, key.seed)
    before, after = _images(truth, view, key)
    tissues = {t.name: t for t in truth.space.mesh.tissues}
    moduli = {name: tissues[name].youngs_modulus_kpa for name in (*ORGANS, KNOWN)}
    told = {
        "version": VERSION,
        "simulated": True,
        "kind": key.kind,
        "what": kind.what,
        "seed": key.seed,
        "law": key.law,
        "noise_mm": key.noise_mm,
        "moduli_kpa": moduli,
        "truth_dofs": 3 * len(truth.space.points),
        **truth.facts,
        **facts,
    }
    made = cache / f".{key.name}.{os.getpid()}"
    made.mkdir(parents=True, exist_ok=True)
    write_label_image(made / "before.nii.gz", before)
    write_label_image(made / "after.nii.gz", after)
    (made / "case.toml").write_text(_case_text(key, truth))
    (made / "truth.json").write_text(json.dumps(told, indent=1))
    _put(made, folder)
    return folder


def _case_text(key: SceneKey, truth: Truth) -> str:
    """The case of a scene: defaults but for the law; Poisson's ratios are the truth's, the surroundings hold 10 kPa."""
    lines = [f'id = "{key.name}"  # simulated', "", "[images]", 'before = "before.nii.gz"', 'after = ["after.nii.gz"]']
    lines += ["", "[mechanics]", f'law = "{key.law}"']
    for label, tissue in enumerate(truth.space.mesh.tissues, start=1):
        if tissue.name not in (*ORGANS, DRIVER, KNOWN):
            continue
        known = tissue.name == KNOWN
        lines += ["", f"[tissues.{tissue.name}]", f"label = {json.dumps('remaining' if known else label)}"]
        lines += [f'role = "{tissue.role}"']
        lines += [f"poisson_ratio = {tissue.poisson_ratio!r}"] if tissue.meshed else []
        lines += [f"youngs_modulus_kpa = {tissue.youngs_modulus_kpa!r}"] if known else []
    return "\n".join(lines) + "\n"


def _images(truth: Truth, view: View, key: SceneKey) -> tuple[LabelImage, LabelImage]:
    """Both images; raises `RuntimeError` where an organ is not whole in one of them."""
    warps: list[Callable[[Array], Array] | None] = [None, None]
    if key.noise_mm:
        rngs = np.random.default_rng([key.seed, 1]).spawn(2)
        fields = [smooth_field(rng, sd_mm=key.noise_mm, correlation_mm=NOISE_LENGTH_MM) for rng in rngs]
        warps = [field.warp for field in fields]
    space, moved = truth.space, truth.displacement
    if view.lies is not None:
        moved = moved + view.lies.at(space.points + moved)
    before = imaged(space, np.zeros_like(moved), view.before, warp=warps[0])
    after = imaged(space, moved, view.after, warp=warps[1])
    for off in sorted(set((view.off_mm or {}).values())):
        names = [name for name, own in (view.off_mm or {}).items() if own == off]
        after = redrawn(after, space, moved, names, outwards_mm=off, into=KNOWN, warp=warps[1])
    filler = space.mesh.tissue_index(KNOWN) + 1
    for image in (before, after):
        inner = image.labels[1:-1, 1:-1, 1:-1]
        if np.count_nonzero(inner != filler) != np.count_nonzero(image.labels != filler):
            raise RuntimeError(f"{key.name}: an organ is cut by the image's border")
    return before, after


# ---- truths ----------------------------------------------------------------------------------------------------------


def _truth(name: str, seed: int, law: str, cache: Path) -> Truth:
    """A truth of a body, from the cache or solved; those of the linear law that differ in the border share a solve."""
    path = cache / "truths" / f"{name}-{seed}-{law}.npz"
    options = _options(seed)
    mesh = _mesh(options, cache)
    space = lagrange_space(mesh, "P2")
    if not path.exists():
        made = _solved(name, space, law, options)
        for other, (displacement, facts) in made.items():
            target = path.with_name(f"{other}-{seed}-{law}.npz")
            _save(target, {"version": VERSION, "displacement": displacement, "facts": json.dumps(facts)})
    kept = np.load(path)
    _refuse_version(int(kept["version"]), path)
    return Truth(space, kept["displacement"], json.loads(str(kept["facts"])))


def _solved(name: str, space: LagrangeSpace, law: str, options: PelvisOptions) -> dict[str, tuple[Array, Facts]]:
    """Displacement and facts of a truth, and of those that come with it; the rectum fills less where it folds over."""
    border, told = _border(options.seed, space)
    solved, asked = space, {"held": (None, Facts()), "border": (border, told)}
    if name == "halves":
        factors, told = _halves(space.mesh, options.seed)
        solved, asked = replace(space, mesh=patched(space.mesh, factors)), {name: (None, told)}
    elif law != "linear":
        asked = {name: asked[name]}
    for share in FILLINGS:
        walls = pelvis_motions(replace(options, filling_mm=share * options.filling_mm))
        motions = [BoundaryMotion(walls, outside) for outside, _ in asked.values()]
        try:
            found = displacements(solved, motions, law=law_named(law))
        except (GeometryError, NotConverged):
            if share == FILLINGS[-1]:
                raise
            continue
        break
    filling = {"filling_mm": share * options.filling_mm}
    return {key: (u, filling | facts) for (key, (_, facts)), u in zip(asked.items(), found, strict=True)}


def _mesh(options: PelvisOptions, cache: Path) -> TetMesh:
    """The truth's mesh of a body, from the cache or made."""
    path, anatomy = cache / "truths" / f"mesh-{options.seed}.npz", pelvis_anatomy(options)
    if not path.exists():
        mesh = tetrahedralise(anatomy, edge_length_mm=options.truth_edge_mm)
        parts = {name: getattr(mesh, name) for name in ("nodes", "tets", "region", "boundary", "beyond")}
        _save(path, {"version": VERSION} | parts)
    kept = np.load(path)
    _refuse_version(int(kept["version"]), path)
    return TetMesh(kept["nodes"], kept["tets"], kept["region"], kept["boundary"], kept["beyond"], anatomy.tissues)


def _border(seed: int, space: LagrangeSpace) -> tuple[ScaledMotion, Facts]:
    """A smooth motion of the truth's border: a Gaussian field scaled to 1 to 2.5 mm, RMS length over its points."""
    rng = _rng(seed, "border")
    rms, length = rng.uniform(*BORDER_RMS_MM), rng.uniform(*BORDER_LENGTH_MM)
    field = smooth_field(rng, sd_mm=1.0, correlation_mm=length)
    points = np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == OUTER]))
    drawn = field.at(space.points[points])
    factor = rms / float(np.sqrt(np.mean(np.sum(drawn**2, axis=1))))
    largest = factor * float(np.linalg.norm(drawn, axis=1).max())
    return ScaledMotion(field, factor), {"border_rms_mm": rms, "border_largest_mm": largest, "border_length_mm": length}


def _halves(mesh: TetMesh, seed: int) -> tuple[Array, Facts]:
    """Factors of E (n_tets,), in ln: surroundings stiffer on one side of a plane that halves their volume."""
    direction = _rng(seed, "halves").normal(size=3)
    direction /= np.linalg.norm(direction)
    known = mesh.region == mesh.tissue_index(KNOWN)
    height = mesh.nodes[mesh.tets].mean(axis=1) @ direction
    order = np.flatnonzero(known)[np.argsort(height[known])]
    below = order[np.cumsum(mesh.volumes[order]) < 0.5 * mesh.volumes[known].sum()]
    factors = np.where(known, 0.5 * np.log(STIFFER), 0.0)
    factors[below] = -0.5 * np.log(STIFFER)
    return factors, {"stiffer": STIFFER, "towards": direction.tolist()}


# ---- common parts ----------------------------------------------------------------------------------------------------


def _options(seed: int) -> PelvisOptions:
    filling = float(np.random.default_rng([seed, 7]).uniform(6.0, 8.0))
    return PelvisOptions(seed=seed, filling_mm=filling, field_mm=FIELD_MM, truth_edge_mm=TRUTH_EDGE_MM)


def _rng(seed: int, purpose: str) -> np.random.Generator:
    """What is drawn for a purpose; scenes that share one, as all of a mismatch together, draw the same."""
    return np.random.default_rng([seed, 38, zlib.crc32(purpose.encode())])


def _sign(seed: int) -> float:
    return -1.0 if seed % 2 else 1.0


def _grid(corner: Array, shape: NDArray[np.int64], turn: Array) -> VoxelGrid:
    """Voxels of 1 mm whose box begins at `corner` (3,) mm along the axes of `turn` (3, 3), in its columns."""
    affine = np.eye(4)
    affine[:3, :3] = turn
    affine[:3, 3] = turn @ (corner + 0.5)
    return VoxelGrid((int(shape[0]), int(shape[1]), int(shape[2])), affine)


def _extent(truth: Truth, turn: Array) -> tuple[Array, Array]:
    """Least and largest coordinates (3,) mm of organs and driver in both states, along the columns of `turn`."""
    places = []
    for index, tissue in enumerate(truth.space.mesh.tissues):
        if tissue.role in (Role.ESTIMATE, Role.DRIVER):
            surface = observed_surface(truth.space, index)
            places += [surface.rest, surface.rest + truth.displacement[surface.points]]
    along = np.concatenate(places) @ turn
    return along.min(axis=0), along.max(axis=0)


def _save(path: Path, arrays: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    made = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    np.savez_compressed(made, **arrays)
    made.replace(path)


def _put(made: Path, folder: Path) -> None:
    """Move a finished folder to its place; one that another process has put there meanwhile stays."""
    try:
        made.rename(folder)
    except OSError:
        if not (folder / "truth.json").exists():
            raise
        shutil.rmtree(made)


def _refuse_version(found: int, path: Path) -> None:
    if found != VERSION:
        raise SystemExit(f"{path} is of version {found} of the mismatch scenes, this is {VERSION}: use another folder")
