"""Who is who: a tissue of the body, its labels, its role and its material constants."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from palpate.errors import ConfigurationError

__all__ = ["FieldPrior", "Role", "Tissue"]


class Role(StrEnum):
    """What a tissue does in the model; `SLIDING`: the body glides along it, which a mesh's surfaces alone can say."""

    ESTIMATE = "estimate"
    KNOWN = "known"
    DRIVER = "driver"
    RIGID = "rigid"
    VOID = "void"
    SLIDING = "sliding"


@dataclass(frozen=True, slots=True)
class FieldPrior:
    """What is believed of ln E inside a tissue whose modulus is a field.

    sd: standard deviation, dimensionless; length_mm: of its kernel, Matern's with one derivative, mm.
    """

    sd: float
    length_mm: float


@dataclass(frozen=True, slots=True)
class Tissue:
    """One tissue: `labels` of the image, `role`, Poisson's ratio (dimensionless) and Young's modulus (kPa).

    `labels` empty means "remaining": every voxel that no other tissue names.
    `youngs_modulus_kpa` is required for `known`, the truth of a simulation for `estimate`, else None.
    `modulus_sd`: standard deviation of what is believed of ln E of a `known` tissue, dimensionless; 0: it is certain.
    `field`: what is believed of ln E inside the tissue, where it is to be mapped.
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
