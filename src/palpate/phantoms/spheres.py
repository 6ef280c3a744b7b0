"""Concentric balls: small scenes with a known truth, for benchmarks and first steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from palpate.errors import ConfigurationError
from palpate.images.label_image import VoxelGrid
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.laws.registry import law_from
from palpate.mesh.anatomy import Anatomy, LevelSet
from palpate.phantoms.motion import AffineMotion, Swelling, WallMotion, smooth_field
from palpate.phantoms.scene import Noise, Scene, centred_grid, grid_box, make_scene
from palpate.phantoms.shapes import Complement, ball

SPHERES_KINDS = ("squeezed", "pushed", "tumour")
CORE, SHELL, OUTSIDE = 10.0, 20.0, 30.0  # radii, mm
MODULI_KPA = {"core": 60.0, "shell": 30.0, "organ": 30.0, "tumour": 75.0, "surroundings": 10.0}
MARGIN_MM = 6.0  # of the image around the outermost ball
LEAN = 0.6
STRAY = 0.05


@dataclass(frozen=True, slots=True)
class SpheresOptions:
    """The options of the balls.

    `kind` is one of three. "squeezed": a core (radius 10 mm) in a shell (20 mm) in surroundings (30 mm); the driver
    `frame` around them is deformed by a random stretch. "tumour": the same with a tumour off the organ's centre.
    "pushed": a hollow core, the driver `cavity`, grows in the shell, in a box of surroundings with held sides.
    `push_mm`: the wall's largest motion. `moduli_kpa` by tissue (default: core 60, shell or organ 30, tumour 75,
    surroundings 10). `poisson_ratio` of all or by tissue (default 0.45). `law` and `law_parameters`: those of all
    tissues (see `make_scene`).
    """

    seed: int
    kind: str = "squeezed"
    push_mm: float = 3.0
    spacing_mm: tuple[float, float, float] = (1.0, 1.0, 1.0)
    truth_edge_mm: float = 2.5
    moduli_kpa: Mapping[str, float] | None = None
    poisson_ratio: float | Mapping[str, float] = 0.45
    noise: Noise | None = None
    law: str = "linear"
    law_parameters: Mapping[str, float] = field(default_factory=dict)


def spheres(options: SpheresOptions) -> Scene:
    """The scene of `options`; the balls' common centre lies at a random place within a voxel.

    Raises `ConfigurationError` for an unknown kind or tissue, `GeometryError` when the truth folds over.
    """
    anatomy, motions = _body(options)
    return make_scene(
        anatomy,
        motions,
        _grid(options),
        edge_length_mm=options.truth_edge_mm,
        noise=options.noise,
        seed=options.seed,
        law=law_from(options.law, options.law_parameters),
    )


def spheres_anatomy(options: SpheresOptions) -> Anatomy:
    """The analytic balls, tissues and true moduli of `options`; raises `ConfigurationError` as `spheres` does."""
    return _body(options)[0]


def _grid(options: SpheresOptions) -> VoxelGrid:
    return centred_grid((2.0 * (OUTSIDE + MARGIN_MM),) * 3, options.spacing_mm)


def _body(options: SpheresOptions) -> tuple[Anatomy, dict[str, WallMotion]]:
    """The anatomy, and how its walls move."""
    if options.kind not in SPHERES_KINDS:
        raise ConfigurationError(f"kind is '{options.kind}'; it must be one of {list(SPHERES_KINDS)}")
    rng = np.random.default_rng(options.seed)
    grid = _grid(options)
    centre = rng.uniform(-0.5, 0.5, 3) * grid.spacing
    parts: dict[str, LevelSet | None]
    motions: dict[str, WallMotion] = {}
    if options.kind == "pushed":  # a cavity grows, more to one side, in a ball in a box
        parts = {"cavity": ball(centre, CORE), "shell": ball(centre, SHELL), "surroundings": None}
        towards = rng.normal(size=3)
        towards /= np.linalg.norm(towards)
        stray = smooth_field(rng, sd_mm=STRAY * options.push_mm, correlation_mm=CORE, features=300)
        motions["cavity"] = Swelling(centre, CORE, options.push_mm, towards, LEAN, stray)
    else:  # a random affine motion without change of volume, to first order, deforms the frame around the balls
        inner, outer = ("tumour", "organ") if options.kind == "tumour" else ("core", "shell")
        away = rng.normal(size=3)
        off = 5.0 * away / np.linalg.norm(away) if options.kind == "tumour" else np.zeros(3)
        parts = {
            inner: ball(centre + off, CORE),
            outer: ball(centre, SHELL),
            "frame": Complement(ball(centre, OUTSIDE)),
            "surroundings": None,
        }
        gradient = rng.normal(size=(3, 3))
        gradient -= np.trace(gradient) / 3.0 * np.eye(3)
        gradient *= options.push_mm / OUTSIDE / np.linalg.norm(gradient, ord=2)
        motions["frame"] = AffineMotion(gradient, centre, np.zeros(3))
    names = tuple(parts)
    given = dict(options.moduli_kpa or {})
    unknown = sorted(set(given) - set(names))
    if unknown:
        raise ConfigurationError(f"moduli_kpa names {unknown}; these spheres have {list(names)}")
    moduli = MODULI_KPA | given
    roles = {"frame": Role.DRIVER, "cavity": Role.DRIVER, "surroundings": Role.KNOWN}
    stated = options.poisson_ratio
    ratios = dict(stated) if isinstance(stated, Mapping) else dict.fromkeys(names, stated)
    tissues = tuple(
        Tissue(name, roles.get(name, Role.ESTIMATE), (label,), ratios.get(name, 0.45), moduli.get(name))
        for label, name in enumerate(names, start=1)
    )
    return Anatomy(tissues, tuple(parts.values()), grid_box(grid)), motions
