"""A tissue of the body: its labels, its role and its material constants."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

from palpate.errors import ConfigurationError

# They stay apart on black, on white and for the colour-blind; after Okabe & Ito, "Color Universal Design" (2008).
ORGANS = ("#e69f00", "#56b4e9", "#cc79a7", "#2ba888", "#d55e00", "#8f8ff0", "#c5b800")
KNOWN = ("#6d7278", "#85786c", "#6c8075", "#7b6f85")
RIGID = "#cfc8b8"
VOID = "#303438"
DARKEST = 64  # of the brightest channel of a tissue's own colour


class Role(StrEnum):
    """The role of a tissue; the body slides along a `SLIDING` one, which only a surface of a mesh can be."""

    ESTIMATE = "estimate"
    KNOWN = "known"
    DRIVER = "driver"
    RIGID = "rigid"
    VOID = "void"
    SLIDING = "sliding"


@dataclass(frozen=True, slots=True)
class FieldPrior:
    """The prior of ln E inside a tissue whose modulus is a field.

    sd: standard deviation, dimensionless; length_mm: of its kernel, Matern's with one derivative, mm; modes: so many of
    the kernel's make it at the most.
    """

    sd: float
    length_mm: float
    modes: int = 400


@dataclass(frozen=True, slots=True)
class Tissue:
    """One tissue: `labels` of the image, `role`, Poisson's ratio (dimensionless) and Young's modulus (kPa).

    `labels` empty means "remaining": every voxel that no other tissue names.
    `youngs_modulus_kpa` is required for `known`, the truth of a simulation for `estimate`, else None.
    `modulus_sd`: prior standard deviation of ln E of a `known` tissue, dimensionless; 0: it is certain.
    `field`: the prior of ln E inside the tissue, if it is to be mapped.
    Where the image or its table has them, `colour`: #rrggbb, and `called`: the names of the labels there.
    """

    name: str
    role: Role
    labels: tuple[int, ...] = ()
    poisson_ratio: float = 0.45
    youngs_modulus_kpa: float | None = None
    colour: str | None = None
    called: tuple[str, ...] = ()
    modulus_sd: float = 0.0
    field: FieldPrior | None = None

    def __post_init__(self) -> None:
        if not -1.0 < self.poisson_ratio < 0.5:
            raise ConfigurationError(
                f"tissue '{self.name}': poisson_ratio is {self.poisson_ratio}, but an isotropic elastic solid needs"
                " -1 < nu < 0.5; soft tissue is usually given 0.40 to 0.49"
            )
        modulus = self.youngs_modulus_kpa
        if modulus is not None and not 0.0 < modulus <= 1e9:
            raise ConfigurationError(
                f"tissue '{self.name}': youngs_modulus_kpa is {modulus}; give a positive number in kPa"
                " (soft tissue: 0.5 to 1000 kPa)"
            )
        if modulus is None and self.role is Role.KNOWN:
            raise ConfigurationError(f"tissue '{self.name}' is `known`: give its youngs_modulus_kpa (kPa)")

    @property
    def meshed(self) -> bool:
        """Whether the tissue is filled with tetrahedra; the others are holes in the mesh."""
        return self.role in (Role.ESTIMATE, Role.KNOWN)


def tissue_colours(tissues: tuple[Tissue, ...]) -> tuple[str, ...]:
    """A colour (#rrggbb) for each tissue: its own, or one of ours, bright for estimated ones and drivers.

    A colour of its own that is almost black, and could not be seen on an image, is replaced by one of ours.
    """
    fixed = {Role.RIGID: (RIGID,), Role.VOID: (VOID,), Role.KNOWN: KNOWN}
    ranked = sorted(range(len(tissues)), key=lambda i: (tissues[i].role is not Role.ESTIMATE, i))
    colours = [""] * len(tissues)
    used: Counter[Role] = Counter()
    for i in ranked:
        role = Role.ESTIMATE if tissues[i].role is Role.DRIVER else tissues[i].role
        palette = fixed.get(role, ORGANS)
        own = tissues[i].colour or ""
        seen = re.fullmatch("#[0-9a-fA-F]{6}", own) and max(bytes.fromhex(own[1:])) >= DARKEST
        colours[i] = own.lower() if seen else palette[used[role] % len(palette)]
        used[role] += 1
    return tuple(colours)
