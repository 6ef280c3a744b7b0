"""The scenes of mismatch.py: simulated pelves with the faults of real image pairs, each a folder with a case.toml.

A truth is a random pelvis in a field of 140 x 146 x 146 mm, solved on a mesh finer than the estimate's; scenes of one
body share it. Truths and scenes are made once and kept in a folder: `scene_folder` gives the scene, made or not.
"""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate.errors import GeometryError, NotConverged, PalpateError
from palpate.images import LabelImage, Role, VoxelGrid, write_label_image
from palpate.mechanics import Law, law_named
from palpate.mesh import OUTER, Anatomy, LagrangeSpace, TetMesh, lagrange_space, tetrahedralise
from palpate.observation import observed_surface
from palpate.phantoms import (
    AffineMotion,
    BoundaryMotion,
    PelvisOptions,
    WallMotion,
    displacements,
    grid_box,
    imaged,
    pelvis_anatomy,
    pelvis_grid,
    pelvis_motions,
    refuse_folded,
    rotation_about,
    smooth_field,
)
from palpate_validation.mismatch import Grown, patched, redrawn
from palpate_validation.truth import ScaledMotion

__all__ = ["KINDS", "SceneKey", "scene_folder"]

Array = NDArray[np.float64]
Facts = dict[str, Any]  # facts of a scene to print, in JSON's types

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
FIELD_SD, FIELD_LENGTH_MM = (0.3, 0.6), (20.0, 30.0)  # of ln E
SHEATH_MM, SHEATH = 3.0, (1.0 / 3.0, 1.0 / 20.0)  # its share of the surroundings' stiffness: of even seeds, of odd ones


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
    """A solved body: displacement (n_points, 3) mm on `space`, and facts to print."""

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


def _fov(truth: Truth, seed: int) -> tuple[View, Facts]:
    """The later image ends 4 to 10 mm before the first one on 3 to 5 sides."""
    view, _ = _still(truth, seed)
    rng = _rng(seed, "fov")
    less = np.zeros(6)
    sides = rng.permutation(6)[: rng.integers(*FOV_SIDES, endpoint=True)]
    less[sides] = rng.uniform(*FOV_MM, len(sides))
    box = grid_box(view.before)
    shape = np.floor(box.lengths - less[:3] - less[3:]).astype(int)
    return replace(view, after=_grid(box.origin + less[:3], shape, np.eye(3))), {"less_mm": less.round(2).tolist()}


def _all(truth: Truth, seed: int) -> tuple[View, Facts]:
    """The patient lies elsewhere and the organs are drawn smaller or larger, as in those scenes of the body."""
    (view, facts), (drawn, told) = _shift(truth, seed), _organs(truth, seed)
    return replace(view, off_mm=drawn.off_mm), facts | told


def _everything(truth: Truth, seed: int) -> tuple[View, Facts]:
    """All of that, and the rectum is drawn thinner, or thicker."""
    (view, facts), (drawn, told) = _all(truth, seed), _driver(truth, seed)
    off = {**(view.off_mm or {}), **(drawn.off_mm or {})}
    return replace(view, off_mm=off), facts | told | {"off_mm": off}


@dataclass(frozen=True)
class Kind:
    """A kind of scene: the truth that it shows ("held", "border" or a key of PATCHES), and how."""

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
    "fov": Kind("held", _fov, "later field of view smaller"),
    "all": Kind("border", _all, "border moves, the patient lies elsewhere, organs drawn off"),
    "halves": Kind("halves", _still, "surroundings three times stiffer in a half"),
    "field": Kind("field", _still, "a Gaussian field of ln E in the surroundings"),
    "field-organs": Kind("field-organs", _still, "Gaussian fields of ln E in surroundings and organs"),
    "sheath": Kind("sheath", _still, "a soft sheath round the prostate"),
    "everything": Kind("everything", _everything, "fields in all tissues, a soft sheath, 'all' and 'driver'"),
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
    options = _options(seed, law)
    patchy = PATCHES.get(name)
    raw = _mesh(options, cache, sheathed=patchy is not None and patchy.sheathed)
    space = lagrange_space(_merged(raw), "P2")
    if not path.exists():
        border, told = _border(seed, space)
        asked, patches = {"held": (None, Facts()), "border": (border, told)}, None
        if patchy is not None:
            patches, of_patches = patchy.factors(raw, seed)
            asked = {name: (border, told | of_patches) if patchy.moving else (None, of_patches)}
        elif law != "linear":
            asked = {name: asked[name]}
        found, filling = _solved(space, patches, [outside for outside, _ in asked.values()], options)
        for (other, (_, facts)), displacement in zip(asked.items(), found, strict=True):
            kept = {"displacement": displacement, "facts": json.dumps({"filling_mm": filling} | facts)}
            _save(path.with_name(f"{other}-{seed}-{law}.npz"), {"version": VERSION} | kept)
    loaded = np.load(path)
    _refuse_version(int(loaded["version"]), path)
    return Truth(space, loaded["displacement"], json.loads(str(loaded["facts"])))


def _solved(
    space: LagrangeSpace, patches: Array | None, borders: Sequence[WallMotion | None], options: PelvisOptions
) -> tuple[list[Array], float]:
    """Displacements (n_points, 3) mm under each of some motions of the border, and the rectum's filling, mm.

    patches (n_tets,): ln E, but for a constant a tissue. The rectum fills less where the truth would fold over.
    """
    solved = space if patches is None else replace(space, mesh=patched(space.mesh, patches))
    law = law_named(options.law)
    asked = []
    for share in FILLINGS:
        walls = pelvis_motions(replace(options, filling_mm=share * options.filling_mm))
        asked.append([BoundaryMotion(walls, border) for border in borders])
    batches = [asked[k : k + 1] for k in range(len(asked))] if law.finite else [asked]
    tried = (found for batch in batches for found in _together(solved, batch, law))
    for share, found in zip(FILLINGS, tried, strict=True):
        if isinstance(found, PalpateError):
            if share == FILLINGS[-1]:
                raise found
            continue
        return found, share * options.filling_mm
    raise AssertionError("the last filling returns or raises")


def _together(
    space: LagrangeSpace, asked: Sequence[Sequence[BoundaryMotion]], law: Law
) -> Iterator[list[Array] | PalpateError]:
    """The displacements of each list of motions, all by one call, or why there are none."""
    try:
        found = iter(displacements(space, [motion for motions in asked for motion in motions], law=law))
    except NotConverged as error:
        yield from [error] * len(asked)
        return
    for motions in asked:
        of_motions = [next(found) for _ in motions]
        try:
            for displacement in of_motions:
                refuse_folded(space, displacement)
        except GeometryError as error:
            yield error
        else:
            yield of_motions


def _mesh(options: PelvisOptions, cache: Path, *, sheathed: bool) -> TetMesh:
    """The truth's mesh of a body, from the cache or made; with the sheath for a last tissue, if there is to be one."""
    path = cache / "truths" / f"{'sheathed-' * sheathed}mesh-{options.seed}.npz"
    anatomy = pelvis_anatomy(options)
    if sheathed:
        prostate = anatomy.level_sets[[t.name for t in anatomy.tissues].index(ORGANS[0])]
        known = next(t for t in anatomy.tissues if t.name == KNOWN)
        assert prostate is not None
        tissues = (*anatomy.tissues, replace(known, name="sheath", labels=(len(anatomy.tissues) + 1,)))
        anatomy = Anatomy(tissues, (*anatomy.level_sets, Grown(prostate, SHEATH_MM)), anatomy.box)
    if not path.exists():
        mesh = tetrahedralise(anatomy, edge_length_mm=options.truth_edge_mm)
        parts = {name: getattr(mesh, name) for name in ("nodes", "tets", "region", "boundary", "beyond")}
        _save(path, {"version": VERSION} | parts)
    kept = np.load(path)
    _refuse_version(int(kept["version"]), path)
    return TetMesh(kept["nodes"], kept["tets"], kept["region"], kept["boundary"], kept["beyond"], anatomy.tissues)


def _merged(mesh: TetMesh) -> TetMesh:
    """The mesh with the sheath, if there is one, as a part of the surroundings."""
    tissues = tuple(t for t in mesh.tissues if t.name != "sheath")
    region = np.where(mesh.region >= len(tissues), mesh.tissue_index(KNOWN), mesh.region)
    return replace(mesh, region=region, tissues=tissues)


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


def _field(mesh: TetMesh, seed: int, *, organs: bool = False) -> tuple[Array, Facts]:
    """The same of a Gaussian field in the surroundings, and of others in the organs."""
    rng = _rng(seed, "field")
    sd, length = rng.uniform(*FIELD_SD), rng.uniform(*FIELD_LENGTH_MM)
    drawn = smooth_field(rng, sd_mm=sd, correlation_mm=length).at(mesh.nodes[mesh.tets].mean(axis=1))
    factors = np.zeros(len(mesh.tets))
    for component, name in enumerate((KNOWN, *ORGANS) if organs else (KNOWN,)):
        here = mesh.region == mesh.tissue_index(name)
        factors[here] = drawn[here, component]
    return factors, {"field_sd": sd, "field_length_mm": length}


def _sheath(mesh: TetMesh, seed: int) -> tuple[Array, Facts]:
    """The same of a sheath of 3 mm round the prostate, where neither bladder nor rectum is."""
    share = SHEATH[seed % 2]
    factors = np.where(mesh.region == mesh.tissue_index("sheath"), np.log(share), 0.0)
    return factors, {"sheath_mm": SHEATH_MM, "sheath_share": share}


def _patchy(mesh: TetMesh, seed: int) -> tuple[Array, Facts]:
    """The fields of all tissues, and the sheath beside them."""
    (field, told), (sheath, of_sheath) = _field(mesh, seed, organs=True), _sheath(mesh, seed)
    return field + sheath, told | of_sheath


@dataclass(frozen=True)
class Patches:
    """A truth whose tissues are not homogeneous: factors of E (n_tets,), in ln, a sheath, a moving border."""

    factors: Callable[[TetMesh, int], tuple[Array, Facts]]
    sheathed: bool = False
    moving: bool = False


PATCHES = {
    "halves": Patches(_halves),
    "field": Patches(_field),
    "field-organs": Patches(partial(_field, organs=True)),
    "sheath": Patches(_sheath, sheathed=True),
    "everything": Patches(_patchy, sheathed=True, moving=True),
}


# ---- common parts ----------------------------------------------------------------------------------------------------


def _options(seed: int, law: str = "linear") -> PelvisOptions:
    filling = float(np.random.default_rng([seed, 7]).uniform(6.0, 8.0))
    return PelvisOptions(seed=seed, filling_mm=filling, field_mm=FIELD_MM, truth_edge_mm=TRUTH_EDGE_MM, law=law)


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
