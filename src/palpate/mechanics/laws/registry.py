"""The registered laws, by their names in `case.toml`."""

from __future__ import annotations

from palpate.errors import ConfigurationError
from palpate.mechanics.laws.contract import Law
from palpate.mechanics.laws.linear import Linear
from palpate.mechanics.laws.mooney_rivlin import MooneyRivlin
from palpate.mechanics.laws.neo_hookean import NeoHookean

__all__ = ["LAWS", "law_named"]

LAWS: dict[str, Law] = {law.name: law for law in (Linear(), NeoHookean(), MooneyRivlin())}


def law_named(name: str, *, c01_over_c10: float = 0.25) -> Law:
    """The law of that name; c01_over_c10 (dimensionless) is used by "mooney-rivlin" only.

    Raises `ConfigurationError` for another name, and for an impossible ratio.
    """
    if name not in LAWS:
        raise ConfigurationError(f"law is '{name}'; it must be one of {sorted(LAWS)}")
    return MooneyRivlin(c01_over_c10) if name == "mooney-rivlin" else LAWS[name]
