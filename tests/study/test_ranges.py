"""Every number of a case has a plausible range, which docs/case-file.md states."""

from __future__ import annotations

import dataclasses
import re
import typing
from pathlib import Path

import pytest

from case_texts import ORGAN, case_text
from palpate.case.case import Case, CaseTissue
from palpate.case.file import read_case
from palpate.case.schema import Rule, rule
from palpate.errors import ConfigurationError
from palpate.images.named_labels import MAX_LABEL

PAGE = Path(__file__).parents[2] / "docs" / "case-file.md"
CASE = case_text({"prostate": ORGAN})
NEEDED = {
    "sd_mm": 'data=[{kind="landmarks", file="m.csv", sd_mm=VALUE}]',
    "force_n": 'data=[{kind="force", surface="outer", direction=[0, 0, 1.0], sd_n=1.0, force_n=VALUE}]',
    "direction": 'data=[{kind="force", surface="outer", direction=[0, 0, VALUE], sd_n=1.0, force_n=1.0}]',
    "sd_n": 'data=[{kind="force", surface="outer", direction=[0, 0, 1.0], sd_n=VALUE, force_n=1.0}]',
    "offset_sd_n": 'data=[{kind="force", surface="a", direction=[0, 0, 1.0], sd_n=1, force_n=1, offset_sd_n=VALUE}]',
    "within_mm": 'surfaces=[{name="top", where="z_max", within_mm=VALUE}]',
    "correlation_mm": 'data=[{kind="landmarks", file="m.csv", sd_mm=1.0, correlation_mm=VALUE}]',
    "data.state": 'data=[{kind="landmarks", file="x.csv", sd_mm=1.0, state=VALUE}]',
    "state": 'loads=[{kind="gravity", state=VALUE, acceleration_m_s2=[0.0, 0.0, 1.0]}]',
    "pressure_kpa": 'loads=[{kind="pressure", surface="outer", pressure_kpa=VALUE}]',
    "traction_kpa": 'loads=[{kind="traction", surface="outer", traction_kpa=[VALUE, 0.0, 0.0]}]',
    "acceleration_m_s2": 'loads=[{kind="gravity", acceleration_m_s2=[VALUE, 0.0, 0.0]}]',
    "data.subset_mm": 'data=[{kind="displacement-field", file="f.csv", subset_mm=VALUE}]',
    "data.frame": 'data=[{kind="displacement-field", file="f.npz", frame=VALUE}]',
    "start_ratios": "estimate={start_ratios=[VALUE], bounds_ratio=[2e-6, 9e5]}",
    "starts_kpa": "estimate={starts_kpa=[VALUE], bounds_kpa=[2e-3, 9e8]}",
    "bounds_ratio": "estimate={bounds_ratio=[1e-6, VALUE]}",
    "bounds_kpa": "estimate={bounds_kpa=[1e-3, VALUE]}",
}


def numbers(kind: type, where: str = ""):
    """Place (key.path with * for a name) and field of every number in the tree of tables."""
    hints = typing.get_type_hints(kind)
    for item in dataclasses.fields(kind):
        flat = [hints[item.name], *typing.get_args(hints[item.name])]
        flat += [arm for kind_of in flat for arm in typing.get_args(kind_of)]
        tables = [arm for arm in flat if dataclasses.is_dataclass(arm)]
        name = {CaseTissue: ".*"}.get(tables[0], "") if tables else ""
        for table in dict.fromkeys(tables):
            yield from numbers(table, f"{where}{item.name}{name}.")
        for key, between in item.metadata.get("rule", Rule()).collects.items():
            yield f"{where}{key}", dataclasses.field(metadata=rule(between=between), default=between[0])
        if {int, float} & set(flat) and item.name not in ("label", "law_parameters", "covariance_mm2"):
            yield f"{where}{item.name}", item


NUMBERS = dict(numbers(Case))


@pytest.mark.parametrize("place", NUMBERS)
def test_every_number_has_a_range_that_holds_its_default(place):
    item = NUMBERS[place]
    low, high = item.metadata["rule"].between
    assert low < high
    default = item.default if isinstance(item.default, tuple) else (item.default,)
    assert all(low <= value <= high for value in default if isinstance(value, int | float))


def test_the_page_states_every_range():
    section = PAGE.read_text(encoding="utf-8").partition("## Ranges")[2].partition("\n## ")[0]
    stated = {
        f"{table}.{key}".lstrip("."): (float(low), float(high))
        for table, keys in re.findall(r"^- (?:`([\w.*]+)`: )?(.*)$", section, re.MULTILINE)
        for key, low, high in re.findall(r"`(\w+)` (\S+) to (\S+?)(?:,|$)", keys)
    }
    assert stated.pop("tissues.*.label") == (0, MAX_LABEL)
    assert stated == {place: tuple(item.metadata["rule"].between) for place, item in NUMBERS.items()}


@pytest.mark.parametrize("place", NUMBERS)
@pytest.mark.parametrize("end", [0, 1])
def test_what_lies_beyond_a_range_is_refused_with_the_range(place, end, tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(CASE)
    bound = NUMBERS[place].metadata["rule"].between[end]
    beyond = bound + (bound * 1e-3 or 1e-3) * (-1 if (end == 0) == (bound >= 0) else 1)
    key = place.rpartition(".")[2]
    whole = isinstance(NUMBERS[place].default, int) or key in ("stage", "frame")
    value = str(bound + (1, -1)[end == 0]) if whole else repr(beyond)
    template = NEEDED.get(place) or NEEDED.get(key, f"{place.replace('*', 'prostate')}=VALUE")
    override = template.replace("VALUE", value)
    more = {"phantom.seed": ["phantom.kind=spheres"]}.get(place, [])
    with pytest.raises(ConfigurationError, match=f"'{key}' in .* must be a number from"):
        read_case(path, [override, *more])
