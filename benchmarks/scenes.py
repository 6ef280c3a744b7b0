"""The generator of simulated bodies with a known truth, for all campaigns: the same seed gives the same body.

Three families, of random pelves unless they say otherwise, each solved on a mesh finer than the estimate's:

- `scene_folder`: image pairs with the faults of real ones (mismatch.py), each a folder with a case.toml
- `patient_folder`: patients with eight later images and every fault at once (patients.py), a folder each
- `TRUTHS`, `body_with_ball`: solved bodies in memory, with the errors of drawn surfaces (`NOISES`) and measured points

Folders are made once and kept, for a truth takes minutes.
"""

from __future__ import annotations

import json
import os
import shutil
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial.distance import cdist

from palpate.errors import GeometryError, NotConverged
from palpate.images import LabelImage, Role, Tissue, VoxelGrid, write_label_image
from palpate.mechanics import law_named
from palpate.mesh import (
    OUTER,
    Anatomy,
    LagrangeSpace,
    TetMesh,
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
    PointDisplacement,
    PointTable,
    correlation,
    observed_surface,
    stated_sd,
)
from palpate.phantoms import (
    AffineMotion,
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
from palpate_validation.mismatch import Grown, patched, redrawn
from palpate_validation.truth import ScaledMotion

__all__ = [
    "KINDS",
    "NOISES",
    "POINTS",
    "TRUTHS",
    "Patient",
    "SceneKey",
    "body_with_ball",
    "measured_points",
    "patient_folder",
    "point_term",
    "scene_folder",
    "skins_of",
    "write_case",
]

Array = NDArray[np.float64]
Facts = dict[str, Any]  # facts of a scene to print, in JSON's types

ORGANS, DRIVER, KNOWN = ("prostate", "bladder"), "rectum", "surroundings"
FIELD_MM, LARGER_MM = (110.0, 120.0, 120.0), (140.0, 146.0, 146.0)
NOISE_LENGTH_MM = 6.0
BORDER_RMS_MM, BORDER_LENGTH_MM = (1.0, 2.5), (40.0, 80.0)
FIELD_SD, FIELD_LENGTH_MM = (0.3, 0.6), (20.0, 30.0)  # of ln E


# ---- parts that the families share -----------------------------------------------------------------------------------


def drawn_filling(seed: int) -> float:
    """By how many mm the rectum of a seed fills, 6 to 8."""
    return float(np.random.default_rng([seed, 7]).uniform(6.0, 8.0))


def border_motion(
    rng: np.random.Generator, space: LagrangeSpace, rms_mm: float, length_mm: float
) -> tuple[ScaledMotion, float]:
    """A smooth motion of the outer border, of a root mean square length over its points, and its largest length, mm."""
    drawn = smooth_field(rng, sd_mm=1.0, correlation_mm=length_mm)
    points = np.unique(space.facets(space.mesh.boundary[space.mesh.beyond == OUTER]))
    lengths = np.linalg.norm(drawn.at(space.points[points]), axis=1)
    factor = rms_mm / float(np.sqrt(np.mean(lengths**2)))
    return ScaledMotion(drawn, factor), factor * float(lengths.max())


def patches(mesh: TetMesh, rng: np.random.Generator, sd: float, length_mm: float, tissues: Sequence[str]) -> Array:
    """Factors of E (n_tets,), in ln: in each of up to three tissues a component of a Gaussian field."""
    drawn = smooth_field(rng, sd_mm=sd, correlation_mm=length_mm).at(mesh.nodes[mesh.tets].mean(axis=1))
    factors = np.zeros(len(mesh.tets))
    for component, name in enumerate(tissues):
        here = mesh.region == mesh.tissue_index(name)
        factors[here] = drawn[here, component]
    return factors


def write_case(
    path: Path, name: str, after: Sequence[str], law: str, tissues: Sequence[Tissue], *, filler: str = KNOWN
) -> None:
    """A case of images beside it, by the program's defaults but for the law.

    Poisson's ratios are the truth's; `filler` is all that remains and has its modulus.
    """
    lines = [
        f"id = {json.dumps(name)}  # simulated",
        "[images]",
        'before = "before.nii.gz"',
        f"after = {json.dumps(after)}",
    ]
    lines += ["[mechanics]", f'law = "{law}"']
    for label, tissue in enumerate(tissues, start=1):
        known = tissue.name == filler
        lines += [f"[tissues.{tissue.name}]", f"label = {json.dumps('remaining' if known else label)}"]
        lines += [f'role = "{tissue.role}"']
        lines += [f"poisson_ratio = {tissue.poisson_ratio!r}"] if tissue.meshed else []
        lines += [f"youngs_modulus_kpa = {tissue.youngs_modulus_kpa!r}"] if known else []
    path.write_text("\n".join(lines) + "\n")


def _moved(folder: Path, made: Path) -> Path:
    """Move a finished folder to its place; one that another process has put there meanwhile stays."""
    try:
        made.rename(folder)
    except OSError:
        if not (folder / "truth.json").exists():
            raise
        shutil.rmtree(made)
    return folder


def _working(folder: Path) -> Path:
    """A new folder beside the one that it becomes."""
    made = folder.with_name(f".{folder.name}.{os.getpid()}")
    made.mkdir(parents=True, exist_ok=True)
    return made


# ---- image pairs with the faults of real ones ------------------------------------------------------------------------

VERSION = 1  # of what the seeds mean: a folder of another version is refused
TRUTH_EDGE_MM = 2.7  # at the organs; the estimate's default is some 4 mm
CROP_MM, CROP_TURN_DEG, CROP_MARGIN_MM = (45.0, 60.0), 5.0, 4.0
SHIFT_MM, SHIFT_DEG = (3.0, 8.0), (2.0, 6.0)
FOV_MM, FOV_SIDES = (4.0, 10.0), (3, 5)
FILLINGS = (1.0, 0.8, 0.6, 0.4)  # of the rectum's 6 to 8 mm: the first at which no tetrahedron of the truth folds over
STIFFER = 3.0  # one half of the surroundings than the other
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
class Kind:
    """A kind of scene: the truth that it shows ("held", "border" or a key of PATCHES), and what is off in its images.

    off_mm: by tissue, how far outwards the later image draws it, for even seeds; inwards for odd ones. cropped: both
    images end 45 to 60 mm from the centre, or 4 mm beyond the organs, along axes that are turned by up to 5 degrees.
    narrower: the later image ends 4 to 10 mm before the first on 3 to 5 sides. elsewhere: the patient lies 3 to 8 mm
    and 2 to 6 degrees elsewhere in the later image.
    """

    what: str
    truth: str = "held"
    off_mm: Mapping[str, float] = field(default_factory=dict)
    cropped: bool = False
    narrower: bool = False
    elsewhere: bool = False


_ORGANS_OFF, _DRIVER_OFF = dict.fromkeys(ORGANS, 0.25), {DRIVER: 1.0}
KINDS = {
    "still": Kind("nothing is mismatched"),
    "crop": Kind("cropped, the truth held where it was", cropped=True),
    "border": Kind("the truth's border moves smoothly", "border"),
    "shift": Kind("the patient lies elsewhere", elsewhere=True),
    "organs": Kind("organs drawn 0.25 mm smaller or larger", off_mm=_ORGANS_OFF),
    "driver": Kind("rectum drawn 1 mm thinner or thicker", off_mm=_DRIVER_OFF),
    "fov": Kind("later field of view smaller", narrower=True),
    "all": Kind(
        "border moves, the patient lies elsewhere, organs drawn off", "border", off_mm=_ORGANS_OFF, elsewhere=True
    ),
    "halves": Kind("surroundings three times stiffer in a half", "halves"),
    "field": Kind("a Gaussian field of ln E in the surroundings", "field"),
    "field-organs": Kind("Gaussian fields of ln E in surroundings and organs", "field-organs"),
    "sheath": Kind("a soft sheath round the prostate", "sheath"),
    "everything": Kind(
        "fields in all tissues, a soft sheath, 'all' and 'driver'",
        "everything",
        off_mm=_ORGANS_OFF | _DRIVER_OFF,
        elsewhere=True,
    ),
}


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
    before, after, facts = _images(truth, kind, key)
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
    made = _working(folder)
    write_label_image(made / "before.nii.gz", before)
    write_label_image(made / "after.nii.gz", after)
    write_case(made / "case.toml", key.name, ["after.nii.gz"], key.law, truth.space.mesh.tissues)
    (made / "truth.json").write_text(json.dumps(told, indent=1))
    return _moved(folder, made)


def _images(truth: Truth, kind: Kind, key: SceneKey) -> tuple[LabelImage, LabelImage, Facts]:
    """Both images, and facts of them; raises `RuntimeError` where an organ is not whole in one of them."""
    space, moved, seed, facts = truth.space, truth.displacement, key.seed, Facts()
    first = last = pelvis_grid(_options(seed))
    if kind.cropped:
        first, told = _cropped(truth, seed)
        last, facts = first, facts | told
    if kind.narrower:
        last, told = _narrower(first, seed)
        facts |= told
    if kind.elsewhere:
        lies, told = _elsewhere(seed)
        moved, facts = moved + lies.at(space.points + moved), facts | told
    warps: list[Callable[[Array], Array] | None] = [None, None]
    if key.noise_mm:
        rngs = np.random.default_rng([seed, 1]).spawn(2)
        warps = [smooth_field(rng, sd_mm=key.noise_mm, correlation_mm=NOISE_LENGTH_MM).warp for rng in rngs]
    before = imaged(space, np.zeros_like(moved), first, warp=warps[0])
    after = imaged(space, moved, last, warp=warps[1])
    off_mm = {name: (-1.0 if seed % 2 else 1.0) * mm for name, mm in kind.off_mm.items()}
    for off in sorted(set(off_mm.values())):
        names = [name for name, own in off_mm.items() if own == off]
        after = redrawn(after, space, moved, names, outwards_mm=off, into=KNOWN, warp=warps[1])
    filler = space.mesh.tissue_index(KNOWN) + 1
    for image in (before, after):
        inner = image.labels[1:-1, 1:-1, 1:-1]
        if np.count_nonzero(inner != filler) != np.count_nonzero(image.labels != filler):
            raise RuntimeError(f"{key.name}: an organ is cut by the image's border")
    return before, after, facts | ({"off_mm": off_mm} if off_mm else {})


def _cropped(truth: Truth, seed: int) -> tuple[VoxelGrid, Facts]:
    rng, places = _rng(seed, "crop"), []
    turn = rotation_about(rng.normal(size=3), rng.uniform(0.0, CROP_TURN_DEG))
    sides = rng.uniform(*CROP_MM, (2, 3))
    for index, tissue in enumerate(truth.space.mesh.tissues):
        if tissue.role in (Role.ESTIMATE, Role.DRIVER):
            surface = observed_surface(truth.space, index)
            places += [surface.rest, surface.rest + truth.displacement[surface.points]]
    along = np.concatenate(places) @ turn
    sides = np.maximum(sides, np.stack([-along.min(axis=0), along.max(axis=0)]) + CROP_MARGIN_MM)
    corner = -sides[0] + rng.uniform(0.0, 1.0, 3)
    shape = np.ceil(sides.sum(axis=0)).astype(int)
    return _grid(corner, shape, turn), {"crop_mm": sides.round(2).tolist()}


def _narrower(grid: VoxelGrid, seed: int) -> tuple[VoxelGrid, Facts]:
    rng, less, box = _rng(seed, "fov"), np.zeros(6), grid_box(grid)
    sides = rng.permutation(6)[: rng.integers(*FOV_SIDES, endpoint=True)]
    less[sides] = rng.uniform(*FOV_MM, len(sides))
    shape = np.floor(box.lengths - less[:3] - less[3:]).astype(int)
    return _grid(box.origin + less[:3], shape, np.eye(3)), {"less_mm": less.round(2).tolist()}


def _elsewhere(seed: int) -> tuple[AffineMotion, Facts]:
    rng = _rng(seed, "shift")
    way, degrees = rng.normal(size=3), rng.uniform(*SHIFT_DEG)
    way *= rng.uniform(*SHIFT_MM) / np.linalg.norm(way)
    axis = rng.normal(size=3)
    motion = AffineMotion(rotation_about(axis, degrees) - np.eye(3), np.zeros(3), way)
    told = {"shift_mm": way.round(3).tolist(), "axis": (axis / np.linalg.norm(axis)).tolist(), "degrees": degrees}
    return motion, told


def _truth(name: str, seed: int, law: str, cache: Path) -> Truth:
    """A truth of a body, from the cache or solved; those of the linear law that differ in the border share a solve."""
    path = cache / "truths" / f"{name}-{seed}-{law}.npz"
    options = _options(seed, law)
    patchy = PATCHES.get(name)
    raw = _mesh(options, cache, sheathed=patchy is not None and patchy.sheathed)
    space = lagrange_space(_merged(raw), "P2")
    if not path.exists():
        border, told = _border(seed, space)
        asked, factors = {"held": (None, Facts()), "border": (border, told)}, None
        if patchy is not None:
            factors, of_patches = patchy.factors(raw, seed)
            asked = {name: (border, told | of_patches) if patchy.moving else (None, of_patches)}
        elif law != "linear":
            asked = {name: asked[name]}
        found, filling = _solved(space, factors, [outside for outside, _ in asked.values()], options)
        for (other, (_, facts)), displacement in zip(asked.items(), found, strict=True):
            kept = {"displacement": displacement, "facts": json.dumps({"filling_mm": filling} | facts)}
            _save(path.with_name(f"{other}-{seed}-{law}.npz"), {"version": VERSION} | kept)
    loaded = np.load(path)
    _refuse_version(int(loaded["version"]), path)
    return Truth(space, loaded["displacement"], json.loads(str(loaded["facts"])))


def _solved(
    space: LagrangeSpace, factors: Array | None, borders: Sequence[WallMotion | None], options: PelvisOptions
) -> tuple[list[Array], float]:
    """Displacements (n_points, 3) mm under each of some motions of the border, and the rectum's filling, mm.

    factors (n_tets,): ln E, but for a constant a tissue. The rectum fills less where the truth would fold over.
    """
    solved = space if factors is None else replace(space, mesh=patched(space.mesh, factors))
    for share in FILLINGS:
        walls = pelvis_motions(replace(options, filling_mm=share * options.filling_mm))
        try:
            found = displacements(solved, [BoundaryMotion(walls, of) for of in borders], law=law_named(options.law))
            for displacement in found:
                refuse_folded(space, displacement)
        except (GeometryError, NotConverged):
            if share == FILLINGS[-1]:
                raise
        else:
            return found, share * options.filling_mm
    raise AssertionError("the last filling returns or raises")


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
    rng = _rng(seed, "border")
    rms, length = rng.uniform(*BORDER_RMS_MM), rng.uniform(*BORDER_LENGTH_MM)
    motion, largest = border_motion(rng, space, rms, length)
    return motion, {"border_rms_mm": rms, "border_largest_mm": largest, "border_length_mm": length}


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
    factors = patches(mesh, rng, sd, length, (KNOWN, *ORGANS) if organs else (KNOWN,))
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


def _options(seed: int, law: str = "linear") -> PelvisOptions:
    return PelvisOptions(
        seed=seed, filling_mm=drawn_filling(seed), field_mm=LARGER_MM, truth_edge_mm=TRUTH_EDGE_MM, law=law
    )


def _rng(seed: int, purpose: str) -> np.random.Generator:
    """What is drawn for a purpose; scenes that share one, as all of a mismatch together, draw the same."""
    return np.random.default_rng([seed, 38, zlib.crc32(purpose.encode())])


def _grid(corner: Array, shape: NDArray[np.int64], turn: Array) -> VoxelGrid:
    """Voxels of 1 mm whose box begins at `corner` (3,) mm along the axes of `turn` (3, 3), in its columns."""
    affine = np.eye(4)
    affine[:3, :3] = turn
    affine[:3, 3] = turn @ (corner + 0.5)
    return VoxelGrid((int(shape[0]), int(shape[1]), int(shape[2])), affine)


def _save(path: Path, arrays: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    made = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    np.savez_compressed(made, **arrays)
    made.replace(path)


def _refuse_version(found: int, path: Path) -> None:
    if found != VERSION:
        raise SystemExit(f"{path} is of version {found} of the mismatch scenes, this is {VERSION}: use another folder")


# ---- patients with several later images ------------------------------------------------------------------------------

MOST = 8  # later images of a patient that are made
PATIENT_EDGE_MM, PATIENT_SPACING_MM = 3.0, (1.0, 1.0, 2.0)
FILLING_MM, STILL_MM = (5.0, 8.0), (0.0, 1.0)
PATIENT_BORDER_MM, PATIENT_BORDER_LENGTH_MM = 1.0, 60.0
PATIENT_SHIFT_MM, PATIENT_SHIFT_DEG = 3.0, 2.0
PATIENT_FIELD_SD, PATIENT_FIELD_LENGTH_MM = 0.3, 25.0
EFFECT = {"prostate": 1.3, "bladder": 1.0}  # by which the higher stage's moduli are larger
LOWER_KPA, SCATTER = {"prostate": 25.0, "bladder": 30.0}, 0.2  # of the cohort: of the lower stage; sd of ln E


class Patient(NamedTuple):
    """A simulated patient; stage: 0 or 1 in the cohort, None: a patient with the moduli of the seed.

    alternating: every second later image shows nearly the filling of the reference image.
    """

    seed: int
    law: str
    noise_mm: float
    stage: int | None = None
    alternating: bool = False

    @property
    def name(self) -> str:
        """Of the folder."""
        of_stage = "" if self.stage is None else f"-stage{self.stage}"
        return f"patient-{self.seed}-{self.law}-{self.noise_mm:g}mm{of_stage}{'-alternating' * self.alternating}"

    @property
    def moduli_kpa(self) -> dict[str, float] | None:
        """The moduli of a patient of the cohort: of its stage, scattered by the seed."""
        if self.stage is None:
            return None
        scatter = SCATTER * np.random.default_rng([self.seed, 90]).normal(size=len(ORGANS))
        return {
            organ: LOWER_KPA[organ] * EFFECT[organ] ** self.stage * float(np.exp(away))
            for organ, away in zip(ORGANS, scatter, strict=True)
        }


def patient_folder(patient: Patient, cache: Path) -> Path:
    """The folder of a patient in `cache`, made if it is not there: images, truth.json, case-1.toml to case-8.toml.

    case-n.toml has the first n later images.
    """
    folder = cache / patient.name
    if (folder / "truth.json").exists():
        return folder
    seed, law, noise_mm, stage, alternating = patient
    rng = np.random.default_rng([seed, 89])
    options = PelvisOptions(seed, spacing_mm=PATIENT_SPACING_MM, field_mm=LARGER_MM, truth_edge_mm=PATIENT_EDGE_MM)
    options = replace(options, law=law, moduli_kpa=patient.moduli_kpa)
    mesh = tetrahedralise(pelvis_anatomy(options), edge_length_mm=PATIENT_EDGE_MM)
    space = lagrange_space(mesh, "P2")
    motions = []
    for number in range(1, MOST + 1):
        filling = float(rng.uniform(*(STILL_MM if alternating and number % 2 == 0 else FILLING_MM)))
        walls = pelvis_motions(replace(options, filling_mm=filling, motion_seed=number))
        border, _ = border_motion(rng, space, PATIENT_BORDER_MM, PATIENT_BORDER_LENGTH_MM)
        motions.append(BoundaryMotion(walls, border))
    factors = patches(mesh, rng, PATIENT_FIELD_SD, PATIENT_FIELD_LENGTH_MM, (KNOWN, *ORGANS))
    found = displacements(replace(space, mesh=patched(mesh, factors)), motions, law=law_named(law))
    made, still = _working(folder), np.zeros_like(space.points)
    noises = np.random.default_rng([seed, 1]).spawn(MOST + 1)
    for number, (moved, of) in enumerate(zip([still, *found], noises, strict=True)):
        refuse_folded(space, moved)
        lies = still if number == 0 else _lies(rng).at(space.points + moved)
        warp = smooth_field(of, sd_mm=noise_mm, correlation_mm=NOISE_LENGTH_MM).warp
        name = f"after-{number}" if number else "before"
        write_label_image(made / f"{name}.nii.gz", imaged(space, moved + lies, pelvis_grid(options), warp=warp))
        after = [f"after-{k}.nii.gz" for k in range(1, number + 1)]
        if after:
            write_case(made / f"case-{number}.toml", f"{patient.name}-{number}", after, law, mesh.tissues)
    moduli = {t.name: t.youngs_modulus_kpa for t in mesh.tissues if t.name in ORGANS}
    truth = {"simulated": True, "seed": seed, "law": law, "noise_mm": noise_mm, "stage": stage, "moduli_kpa": moduli}
    (made / "truth.json").write_text(json.dumps(truth, indent=1))
    return _moved(folder, made)


def _lies(rng: np.random.Generator) -> AffineMotion:
    """Where the patient lies in a later image: 3 mm and 2 degrees elsewhere."""
    way = rng.normal(size=3)
    way *= PATIENT_SHIFT_MM / np.linalg.norm(way)
    return AffineMotion(rotation_about(rng.normal(size=3), PATIENT_SHIFT_DEG) - np.eye(3), np.zeros(3), way)


# ---- bodies in memory ------------------------------------------------------------------------------------------------

TRUTH_EDGE = 0.68  # of the estimate's
FEATURES = 400  # waves of a random field, which are drawn anew for each
BALL_RADIUS_MM, BALL_DEPTH_MM = 7.0, 2.0  # of a ball in the prostate, and of the tissue around it


def _pelvis(
    seed: int, law: str, edge_mm: float, *, filling_mm: float | None = None, moving: bool = False, patchy: bool = False
) -> Scene:
    """A random pelvis; `moving`: cut out of a larger body, whose border moves smoothly; `patchy`: ln E varies in all.

    What a patchy tissue states is the geometric mean of its modulus.
    """
    filling = filling_mm or drawn_filling(seed)
    options = PelvisOptions(seed=seed, filling_mm=filling, field_mm=LARGER_MM if moving else FIELD_MM)
    grid = pelvis_grid(replace(options, field_mm=FIELD_MM))
    mesh = tetrahedralise(pelvis_anatomy(options), edge_length_mm=TRUTH_EDGE * edge_mm)
    space, solved, border = lagrange_space(mesh, "P2"), None, None
    rng = np.random.default_rng([seed, 38])
    if patchy:
        sd, length = rng.uniform(*FIELD_SD), rng.uniform(*FIELD_LENGTH_MM)
        solved = replace(space, mesh=patched(mesh, patches(mesh, rng, sd, length, (*ORGANS, KNOWN))))
    if moving:
        border, _ = border_motion(rng, space, rng.uniform(*BORDER_RMS_MM), rng.uniform(*BORDER_LENGTH_MM))
    return _scene(space, solved or space, BoundaryMotion(pelvis_motions(options), border), law, grid, seed)


def _scene(
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
    return _scene(space, space, BoundaryMotion(walls), law, grid, seed)


TRUTHS: dict[str, Callable[[int, str, float], Scene]] = {
    "pelvis": _pelvis,
    "small": partial(_pelvis, filling_mm=3.0),
    "moving": partial(_pelvis, moving=True),
    "patchy": partial(_pelvis, patchy=True),
    "balls": _balls,
    "liver": _liver,
}


@dataclass(frozen=True)
class BodyWithBall:
    """A body with a ball; ln E over its tissue's geometric mean (n_tets,); the ball's centre (3,) mm.

    without (n_points, 3) mm: the displacement of the body without the ball.
    """

    scene: Scene
    log_ratio: Array
    centre: Array
    without: Array


def body_with_ball(seed: int, gland_kpa: float, filling_mm: float, contrast: float, edge_mm: float) -> BodyWithBall:
    """A random pelvis whose prostate holds a ball of another modulus; 0: gland and filling as they are drawn."""
    options = PelvisOptions(seed=seed, filling_mm=filling_mm or drawn_filling(seed), field_mm=FIELD_MM)
    options = replace(options, moduli_kpa={ORGANS[0]: gland_kpa} if gland_kpa else None)
    mesh = tetrahedralise(pelvis_anatomy(options), edge_length_mm=TRUTH_EDGE * edge_mm)
    centres, own = mesh.nodes[mesh.tets].mean(axis=1), mesh.region == mesh.tissue_index(ORGANS[0])
    others, inside = centres[~own], np.flatnonzero(own)
    depth = np.array([np.linalg.norm(others - place, axis=1).min() for place in centres[inside]])
    deep = inside[depth > min(BALL_RADIUS_MM + BALL_DEPTH_MM, 0.95 * float(depth.max()))]
    centre = centres[np.random.default_rng([seed, 42]).choice(deep)]
    log_ratio = np.log(contrast) * (own & (np.linalg.norm(centres - centre, axis=1) < BALL_RADIUS_MM))
    log_ratio[own] -= np.average(log_ratio[own], weights=mesh.volumes[own])
    space, motion, grid = lagrange_space(mesh, "P2"), BoundaryMotion(pelvis_motions(options)), pelvis_grid(options)
    plain, solved = (replace(space, mesh=patched(mesh, of)) for of in (np.zeros_like(log_ratio), log_ratio))
    (without,) = displacements(plain, [motion], law=law_named("linear"))
    return BodyWithBall(_scene(space, solved, motion, "linear", grid, seed), log_ratio, centre, without)


# ---- errors of a drawing ---------------------------------------------------------------------------------------------

SHRUNK_MM = 0.2
BUMPED, BUMP_MM, BUMP_RADIUS_MM = 0.05, (2.0, 4.0), (4.0, 7.0)
SMOOTHED_MM = 2.0  # width of a Gaussian


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

INSIDE_MM = 4.0  # of the images' border: points lie deeper


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
    return point_term(space, places, np.asarray(moved), points.sd_mm, points.length_mm)


def point_term(
    space: LagrangeSpace, places: Array, moved: Array, sd_mm: float, length_mm: float = 0.0
) -> PointDisplacement:
    """The term of displacements (n, 3) mm at places (n, 3) mm: of a field where errors are alike over a length."""
    kind = "displacement-field" if length_mm else "landmarks"
    file = DataFile(kind, kind, (Path("simulated.csv"),), 1, sd_mm, correlation_mm=length_mm)
    table = PointTable(places, places + moved, stated_sd(file, len(places)), ("",) * len(places), ())
    source = DisplacementField(file, table) if length_mm else Landmarks(file, table)
    return source.on(space, _no_reaction)[0]


def _no_reaction(name: str, direction: Array) -> NoReturn:
    raise AssertionError(f"points need no force on {name} along {direction}")
