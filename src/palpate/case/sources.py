"""Where the body of a case comes from: images, a mesh with named surfaces, or a phantom."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from palpate.case.schema import rule
from palpate.case.tissue import refuse_name
from palpate.errors import ConfigurationError
from palpate.images.tissue import Role, Tissue
from palpate.mechanics.laws.registry import LAWS

AUTO = "auto"
SURFACE_ROLES = {  # of what lies behind a surface of a mesh
    "moving": Role.DRIVER,
    "fixed": Role.RIGID,
    "sliding": Role.SLIDING,
    "free": Role.VOID,
    "prescribed": Role.RIGID,
}
LAW_NAMES = tuple(LAWS)
LARGEST_SEED = 2**53 - 1  # the largest whole number that JSON keeps everywhere
SEED = rule(between=(0, LARGEST_SEED))
NOT_EMPTY = rule(test=bool, wanted="a list with at least one entry")


@dataclass(frozen=True, slots=True)
class Images:
    """Label images: `before` the reference state, `after` the later states; `names` a label table; grey images.

    `after` may be left out where [motion] says how the driver moves, or [[loads]] act. `body_from_ct`: label 0 is air,
    or what the body lies on, only outside the body that the grey image of its state shows, a CT in HU; inside it, and
    where a state has none, it is of the remaining tissue.
    """

    before: Path
    after: tuple[Path, ...] = field(default=(), metadata=NOT_EMPTY)
    names: Path | None = None
    intensities_before: Path | None = None
    intensities_after: tuple[Path, ...] = ()
    align: str = field(default=AUTO, metadata=rule(choices=(AUTO, "rigid-tissues", "surfaces", "none")))
    body_from_ct: bool = False

    def __post_init__(self) -> None:
        if self.body_from_ct and self.intensities_before is None:
            raise ConfigurationError("[images] body_from_ct needs the CT of the reference state: intensities_before")


@dataclass(frozen=True, slots=True)
class MeshBody:
    """A body that is given as a mesh, RAS mm; `tissue_data`: the cell data that tell the tissue."""

    mesh: Path
    tissue_data: str | None = None


@dataclass(frozen=True, slots=True)
class CaseSurface:
    """A named surface of a mesh: a group of triangles, an outermost plane, or all of the boundary.

    `where`: the group's name or number, "x_min" ... "z_max" within `within_mm`, or "boundary". `boundary` "moving": its
    motion is an unknown; "fixed": it is held; "sliding": it moves within itself alone; "free": nothing holds it, loads
    may act; "prescribed": it moves as the measured points of its state say.
    """

    name: str
    where: str
    boundary: str = field(default="moving", metadata=rule(choices=tuple(SURFACE_ROLES)))
    within_mm: float = field(default=1.0, metadata=rule(between=(1e-6, 1e4)))

    def __post_init__(self) -> None:
        refuse_name(self.name, "the name of a surface")

    @property
    def behind(self) -> Tissue:
        """The hollow tissue that stands behind it in a mesh."""
        return Tissue(self.name, SURFACE_ROLES[self.boundary])


@dataclass(frozen=True, slots=True)
class Pair:
    """A further pair of images of the same patient, with its own reference state."""

    before: Path
    after: tuple[Path, ...] = field(metadata=NOT_EMPTY)


@dataclass(frozen=True, slots=True)
class ImagePair:
    """A reference image of a case with its later images.

    key: how the keys of its files begin in `result.json`; numbers: of its later states in the case, from 1.
    """

    before: Path
    after: tuple[Path, ...]
    key: str
    numbers: range

    @property
    def paths(self) -> dict[str, Path]:
        """Its files by their keys."""
        later = {f"{self.key}after[{i}]": path for i, path in enumerate(self.after)}
        return {f"{self.key}before": self.before} | later


@dataclass(frozen=True, slots=True)
class Phantom:
    """A scene with a known truth instead of images; `law`: that of the truth (default: the case's).

    The truth's moduli and Poisson's ratios are those that the case's tissues state, else the phantom's own.
    """

    kind: str = field(metadata=rule(choices=("pelvis", "spheres")))
    seed: int = field(default=1, metadata=SEED)
    law: str | None = field(default=None, metadata=rule(choices=LAW_NAMES))


@dataclass(frozen=True, slots=True)
class Motion:
    """The driver's motion in a simulation: how far its wall moves outwards, mm."""

    filling_mm: float = field(default=7.0, metadata=rule(between=(-100.0, 100.0)))
