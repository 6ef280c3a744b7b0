"""[tissues] of a case: names, labels, roles and constants."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from palpate.case.schema import nearest, rule, shown
from palpate.errors import ConfigurationError
from palpate.images.named_labels import MAX_LABEL, MAX_NAME, computed_by_spreadsheets
from palpate.images.tissue import FieldPrior, Role, Tissue
from palpate.uncertainty.intervals import NORMAL_95

REMAINING = "remaining"
TISSUE_ROLES = tuple(str(role) for role in Role if role is not Role.SLIDING)
KILOPASCALS = (1e-3, 1e9)  # of a modulus: from the softest gels to diamond
POISSON_RATIO = 0.45
RATIO_SDS = (1e-4, 10.0)  # standard deviation of the prior of one
POISSON_RATIOS = (-0.99, 0.4999)  # beyond, a solid loses its shape or its volume's give, and equations their digits


def _label(value: object) -> tuple[int, ...] | str:
    """A tissue's `label`: an integer, a list of integers, a name of the table, or "remaining"."""
    if isinstance(value, str) and value:
        return value
    items = value if isinstance(value, list) else [value]
    whole = [item for item in items if isinstance(item, int) and not isinstance(item, bool)]
    if not items or whole != items or not 0 <= min(whole) <= max(whole) <= MAX_LABEL:
        raise ConfigurationError(
            f"a tissue's label is {shown(value)}; it must be an integer from 0 to {MAX_LABEL}, a list of them, a name"
            f" of the label table, or '{REMAINING}'"
        )
    return tuple(items)


def refuse_name(name: str, of: str) -> None:
    """Raise `ConfigurationError` when `name` is no printable name of 1 to 200 characters; `of`: what it is of."""
    if not name.isprintable() or not name.strip() or len(name) > MAX_NAME:
        raise ConfigurationError(f"{of} is {shown(name)}; give a printable name of 1 to {MAX_NAME} characters")


def is_tissue_name(name: str) -> bool:
    """Whether a printable name may be a tissue's: our files list it beside other keys and in a table of cells."""
    return name != "after" and name == name.strip() and not computed_by_spreadsheets(name)


@dataclass(frozen=True, slots=True)
class CaseTissue:
    """A tissue as the case names it: `label` is a tuple of labels, a name of the label table, or "remaining".

    `poisson_ratio` None: 0.45, or what a phantom draws; `poisson_ratio_sd`: its prior standard deviation
    where it is estimated, None: so wide that two of them reach 0.05 and 0.499. `youngs_modulus_kpa`: a number, or the
    95 % range of what is believed of a `known` one. `modulus` "field": it varies in the tissue and is mapped;
    `field_sd`: prior standard deviation of ln E inside, `field_length_mm`: of its kernel; `field_modes`: how many modes
    make it at the most.
    """

    name: str
    label: tuple[int, ...] | str = field(metadata=rule(convert=_label))
    role: Role = field(metadata=rule(choices=TISSUE_ROLES))
    poisson_ratio: float | None = field(
        default=None,
        metadata=rule(
            between=POISSON_RATIOS,
            wanted="an isotropic elastic solid needs -1 < nu < 0.5; soft tissue usually has 0.40 to 0.49",
        ),
    )
    youngs_modulus_kpa: float | tuple[float, float] | None = field(
        default=None,
        metadata=rule(between=KILOPASCALS, wanted="a positive number in kPa (soft tissue: 0.5 to 1000 kPa)"),
    )
    density_kg_m3: float = field(default=1000.0, metadata=rule(between=(0.1, 3e4)))
    poisson_ratio_sd: float | None = field(default=None, metadata=rule(between=RATIO_SDS))
    modulus: str = field(default="one", metadata=rule(choices=("one", "field")))
    field_sd: float = field(default=0.7, metadata=rule(between=(0.01, 3.0)))
    field_length_mm: float = field(default=8.0, metadata=rule(between=(1.0, 1e3)))
    field_modes: int = field(default=400, metadata=rule(between=(1, 2000)))

    def __post_init__(self) -> None:
        refuse_name(self.name, "the name of a tissue")
        if not is_tissue_name(self.name):
            raise ConfigurationError(
                f"a tissue cannot be called {shown(self.name)}; choose a name that is not 'after', has no blanks around"
                " it, and does not begin with =, +, - or @ (also after a ;), which spreadsheets compute"
            )
        if isinstance(self.label, str):
            refuse_name(self.label, f"the label of tissue '{self.name}'")
        if isinstance(self.youngs_modulus_kpa, tuple):
            if self.role is not Role.KNOWN:
                raise ConfigurationError(
                    f"tissue '{self.name}': youngs_modulus_kpa is a range, which only a `known` modulus may have, but"
                    f" its role is '{self.role}'; give a number, or remove it"
                )
            if not self.youngs_modulus_kpa[0] < self.youngs_modulus_kpa[1]:
                raise ConfigurationError(
                    f"tissue '{self.name}': youngs_modulus_kpa is {shown(self.youngs_modulus_kpa)}; a range begins with"
                    " its smaller end"
                )
        if self.modulus == "field" and self.role is not Role.ESTIMATE:
            raise ConfigurationError(
                f"tissue '{self.name}': modulus is \"field\", but its role is '{self.role}'; only an `estimate` tissue"
                " can be mapped: give it that role, or remove `modulus`"
            )
        self.with_labels(())  # a tissue's constants are checked by the tissue itself

    def with_labels(self, labels: tuple[int, ...]) -> Tissue:
        """The tissue with its labels; raises `ConfigurationError` when its constants are impossible."""
        ratio = POISSON_RATIO if self.poisson_ratio is None else self.poisson_ratio
        believed = FieldPrior(self.field_sd, self.field_length_mm, self.field_modes)
        mapped = believed if self.modulus == "field" else None
        return Tissue(self.name, self.role, labels, ratio, self.modulus_kpa, modulus_sd=self.modulus_sd, field=mapped)

    @property
    def modulus_kpa(self) -> float | None:
        """Young's modulus, kPa: the number that is given, or the geometric mean of a range's ends."""
        given = self.youngs_modulus_kpa
        return math.sqrt(given[0] * given[1]) if isinstance(given, tuple) else given

    @property
    def modulus_sd(self) -> float:
        """Standard deviation of ln E, by the 95 % range that is given; 0 of a number."""
        given = self.youngs_modulus_kpa
        return math.log(given[1] / given[0]) / (2.0 * NORMAL_95) if isinstance(given, tuple) else 0.0

    def resolve(self, names: Mapping[int, str]) -> Tissue:
        """The tissue with the labels that `names` (label -> name) gives to its label's name.

        Raises `ConfigurationError` when the table has no such name.
        """
        if self.label == REMAINING:
            return self.with_labels(())
        if not isinstance(self.label, str):
            return self.with_labels(self.label)
        labels = tuple(sorted(number for number, name in names.items() if name == self.label))
        if not labels:
            known = nearest(self.label, names.values()) if names else "give a label table, [images] names"
            raise ConfigurationError(
                f"tissue '{self.name}': no label is called '{self.label}' in the label table; {known}"
            )
        return self.with_labels(labels)
