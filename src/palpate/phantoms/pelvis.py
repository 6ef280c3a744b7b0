"""A male pelvis in which the rectum fills: scenes of random anatomy with a known truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from palpate.errors import ConfigurationError
from palpate.images.label_image import VoxelGrid
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.laws.registry import law_from
from palpate.mesh.anatomy import Anatomy, LevelSet
from palpate.phantoms.motion import AffineMotion, WallMotion, filling_of, smooth_field
from palpate.phantoms.pelvis_shapes import PelvisShapes, draw_pelvis
from palpate.phantoms.scene import Noise, Scene, centred_grid, grid_box, make_scene
from palpate.phantoms.shapes import rotation_about

SURROUNDINGS_KPA = 10.0
STRAY = 0.05  # standard deviation of each component of the rectum's random motion, over the filling
STRAY_LENGTH_MM = 20.0


@dataclass(frozen=True, slots=True)
class PelvisOptions:
    """The options of a pelvis; whatever is None is drawn with the seed.

    `filling_mm`: largest motion of the rectum's wall. `moduli_kpa` by tissue: by default 15 to 60 kPa for prostate and
    bladder, 2 to 3 times the prostate's for a tumour, 10 kPa for the surroundings. `poisson_ratio` of all tissues or by
    tissue: by default 0.40 to 0.45 each. `bone_motion_mm`: each bone moves as a rigid body by so many mm and degrees.
    `law` and `law_parameters`: those of all tissues (see `make_scene`). `motion_seed` draws another motion of the same
    body.
    """

    seed: int
    filling_mm: float = 7.0
    spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0)
    field_mm: tuple[float, float, float] = (110.0, 120.0, 120.0)
    truth_edge_mm: float = 2.7
    moduli_kpa: Mapping[str, float] | None = None
    poisson_ratio: float | Mapping[str, float] | None = None
    noise: Noise | None = None
    bones: bool = False
    bone_motion_mm: float = 0.0
    tumour: bool = False
    law: str = "linear"
    law_parameters: Mapping[str, float] = field(default_factory=dict)
    motion_seed: int | None = None


def pelvis(options: PelvisOptions) -> Scene:
    """The scene of `options`.

    Tissues: prostate and bladder (`estimate`), which touch; tumour (`estimate`) in the prostate; rectum (`driver`);
    left and right bone (`rigid`); surroundings (`known`). Shapes, moduli and motion have random streams of their own.
    So a tumour, noise or another voxel size does not change the rest of the body. Raises `GeometryError` when the
    truth folds over, and `ConfigurationError` for a field that is too small or a modulus of an unknown tissue.
    """
    anatomy = pelvis_anatomy(options)
    return make_scene(
        anatomy,
        pelvis_motions(options),
        pelvis_grid(options),
        edge_length_mm=options.truth_edge_mm,
        noise=options.noise,
        seed=options.seed,
        law=law_from(options.law, options.law_parameters),
    )


def pelvis_motions(options: PelvisOptions) -> dict[str, WallMotion]:
    """How the walls of the body of `options` move, by tissue."""
    motion_rng = np.random.default_rng(options.seed).spawn(3)[2]
    if options.motion_seed is not None:
        motion_rng = np.random.default_rng([options.seed, options.motion_seed])
    body = _body(options)
    turn = rotation_about(motion_rng.normal(size=3), motion_rng.uniform(0.0, 30.0))
    motions: dict[str, WallMotion] = {
        "rectum": filling_of(
            body.rectum,
            filling_mm=options.filling_mm,
            fullest_mm=float(motion_rng.uniform(-6.0, 6.0)),
            length_mm=float(motion_rng.uniform(18.0, 24.0)),
            towards=turn @ body.forwards,
            lean=float(motion_rng.uniform(0.0, 0.2)),
            stray=smooth_field(
                motion_rng, sd_mm=STRAY * options.filling_mm, correlation_mm=STRAY_LENGTH_MM, features=300
            ),
        )
    }
    for name, bone in zip(("left bone", "right bone"), body.bones, strict=True):
        axis, direction = motion_rng.normal(size=(2, 3))  # of the rotation about the bone's centre, and of its shift
        gradient = rotation_about(axis, options.bone_motion_mm) - np.eye(3)
        motion = AffineMotion(gradient, bone.centre, options.bone_motion_mm * direction / np.linalg.norm(direction))
        if options.bones and options.bone_motion_mm > 0.0:
            motions[name] = motion
    return motions


def pelvis_grid(options: PelvisOptions) -> VoxelGrid:
    """The voxel grid of the images of `options`."""
    return centred_grid(options.field_mm, options.spacing_mm)


def pelvis_anatomy(options: PelvisOptions) -> Anatomy:
    """The analytic shapes, tissues and true moduli of `options`, in the box of the images' voxels."""
    body = _body(options)
    parts: dict[str, LevelSet | None] = {"tumour": body.tumour} if options.tumour else {}
    parts |= {"prostate": body.prostate, "bladder": body.bladder, "rectum": body.rectum}
    if options.bones:
        parts |= {"left bone": body.bones[0], "right bone": body.bones[1]}
    parts |= {"surroundings": None}
    material_rng = np.random.default_rng(options.seed).spawn(3)[1]
    prostate, bladder = SURROUNDINGS_KPA * np.exp(material_rng.uniform(np.log(1.5), np.log(6.0), 2))
    factor = material_rng.uniform(2.0, 3.0)
    moduli = {"surroundings": SURROUNDINGS_KPA, "prostate": prostate, "bladder": bladder}
    given = dict(options.moduli_kpa or {})
    unknown = sorted(set(given) - {*moduli, "tumour"})
    if unknown:
        raise ConfigurationError(f"moduli_kpa names {unknown}; a pelvis has {[*moduli, 'tumour']}")
    moduli |= given
    moduli["tumour"] = given.get("tumour", factor * moduli["prostate"])
    ratios = dict(zip(moduli, material_rng.uniform(0.40, 0.45, len(moduli)), strict=True))
    stated = options.poisson_ratio or {}
    ratios |= stated if isinstance(stated, Mapping) else dict.fromkeys(ratios, stated)
    roles = {"rectum": Role.DRIVER, "left bone": Role.RIGID, "right bone": Role.RIGID, "surroundings": Role.KNOWN}
    tissues = []
    for label, name in enumerate(parts, start=1):
        role = roles.get(name, Role.ESTIMATE)
        if name not in moduli:
            tissues.append(Tissue(name, role, (label,)))
            continue
        tissues.append(Tissue(name, role, (label,), float(ratios[name]), float(moduli[name])))
    return Anatomy(tuple(tissues), tuple(parts.values()), grid_box(pelvis_grid(options)))


def _body(options: PelvisOptions) -> PelvisShapes:
    shape_rng = np.random.default_rng(options.seed).spawn(3)[0]
    return draw_pelvis(shape_rng, grid_box(pelvis_grid(options)), bones=options.bones)
