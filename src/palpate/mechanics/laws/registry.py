"""The registered laws, by their names in `case.toml`."""

from __future__ import annotations

from collections.abc import Mapping

from palpate.errors import ConfigurationError
from palpate.mechanics.laws.contract import Law, LawParameter
from palpate.mechanics.laws.fung import Fung
from palpate.mechanics.laws.linear import Linear
from palpate.mechanics.laws.mooney_rivlin import MooneyRivlin
from palpate.mechanics.laws.neo_hookean import NeoHookean

REGISTERED = (Linear, NeoHookean, MooneyRivlin, Fung)  # a new law is a file, and its class in this tuple

LAWS: dict[str, Law] = {law.name: law for law in (kind() for kind in REGISTERED)}


def law_named(name: str, **parameters: float) -> Law:
    """The law of that name with its parameters (see `law_parameters`), by default its own.

    Raises `ConfigurationError` for another name, for a parameter that the law has not, and for an impossible value.
    """
    if name not in LAWS:
        raise ConfigurationError(f"law is '{name}'; it must be one of {sorted(LAWS)}")
    own = {parameter.name for parameter in LAWS[name].parameters}
    for key in parameters:
        if key not in own:
            owners = [law.name for law in LAWS.values() if key in {p.name for p in law.parameters}]
            raise ConfigurationError(
                f"the law '{name}' has no parameter '{key}'; it belongs to {' and '.join(map(repr, owners)) or 'none'}"
            )
    return type(LAWS[name])(**parameters)


def law_from(name: str, stated: Mapping[str, float]) -> Law:
    """The law of that name with those of the `stated` parameters that are its own; raises as `law_named`."""
    own = {parameter.name for parameter in LAWS[name].parameters} if name in LAWS else set()
    return law_named(name, **{key: value for key, value in stated.items() if key in own})


def law_parameters() -> dict[str, LawParameter]:
    """The parameters of all laws, by their names in [mechanics] of a `case.toml`."""
    return {parameter.name: parameter for law in LAWS.values() for parameter in law.parameters}
