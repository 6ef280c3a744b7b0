"""A case written as case.toml is read as the same case, from wherever the file stands."""

from __future__ import annotations

import tomllib
from dataclasses import fields, replace
from pathlib import Path

import pytest

from palpate.case.file import case_tables, case_text, read_case
from palpate.errors import ConfigurationError

TISSUES = """
[tissues."left hip"]
label = [6, 7]
role = "rigid"
[tissues.prostate]
label = "Gland \\"A\\""
role = "estimate"
poisson_ratio = 0.3
[tissues.surroundings]
label = "remaining"
role = "known"
youngs_modulus_kpa = 10
"""
RESOLVED = ("images", "pairs", "tissues", "mechanics")  # where what follows from the whole case is written out
CASES = {
    "least": f'[images]\nbefore = "b.nii.gz"\nafter = ["a.nii.gz"]\n{TISSUES}',
    "everything": f"""
id = "sub \\u00e4 01"
patient = "sub"
stage = 2
seed = 9007199254740991
[images]
before = "in/b.nii.gz"
after = ["a1.nii.gz", "./~a2.nii.gz"]
names = "names.json"
intensities_before = "ct.nii.gz"
align = "none"
[[pairs]]
before = "b2.nii.gz"
after = ["a3.nii.gz"]
[[loads]]
kind = "pressure"
surface = "outer"
pressure_kpa = 1e-7
following = false
[[loads]]
kind = "gravity"
acceleration_m_s2 = [0.0, -9.81, 0]
[mechanics]
law = "mooney-rivlin"
c01_over_c10 = 0.1
element = "P1"
[noise]
surface_sd_mm = 0.1
[estimate]
starts_kpa = [3, 30.5]
bounds_kpa = [0.1, 1e9]
{TISSUES}""",
    "phantom": '[phantom]\nkind = "spheres"\n[motion]\nfilling_mm = -3\n[tissues.core]\nrole = "estimate"\n',
    "phantom alone": '[phantom]\nkind = "pelvis"\nlaw = "linear"\n',
    "simulation": f'motion = {{ filling_mm = 3.0 }}\nimages = {{ before = "b.nii.gz" }}\n{TISSUES}',
}


def read(folder: Path, text: str, *overrides: str):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "case.toml"
    path.write_text(text, encoding="utf-8")
    return read_case(path, overrides)


@pytest.mark.parametrize("text", CASES.values(), ids=CASES)
def test_a_case_written_elsewhere_is_read_as_the_same_case(tmp_path, text):
    case, folder = read(tmp_path / "cases", text), tmp_path / "results" / "one"
    again = read(folder, case_text(case, folder))
    assert case_tables(again, resolved) == case_tables(case, resolved)
    for field in fields(case):
        if field.name not in RESOLVED:
            assert getattr(again, field.name) == getattr(case, field.name)


def resolved(path: Path) -> str:
    return str(path.resolve())


def test_every_default_is_written_out(tmp_path):
    tables = tomllib.loads(case_text(read(tmp_path, CASES["least"]), tmp_path))
    assert tables["mesh"]["edge_length_mm"] == "auto"
    assert tables["domain"]["outer_boundary"] == "moving"
    assert tables["images"]["align"] == "rigid-tissues"
    assert tables["tissues"]["left hip"]["poisson_ratio"] == 0.45
    assert tables["estimate"]["start_ratios"] == [0.5, 2.0, 8.0]
    law = case_tables(read(tmp_path, CASES["least"] + '[mechanics]\nlaw = "mooney-rivlin"\n'), str)["mechanics"]
    assert law["c01_over_c10"] == 0.25


def test_overrides_are_in_the_values_and_told_beside_them(tmp_path):
    case = read(tmp_path, CASES["least"], "mesh.edge_length_mm=3", 'patient = """a\\\nb"""')
    text = case_text(case, tmp_path)
    assert tomllib.loads(text)["mesh"]["edge_length_mm"] == 3.0
    assert "# --set mesh.edge_length_mm=3\n" in text
    assert case.overrides[0] == "mesh.edge_length_mm=3"
    assert case == replace(case, overrides=())


def test_overrides_are_no_key_of_the_file(tmp_path):
    with pytest.raises(ConfigurationError, match="unknown key 'overrides'"):
        read(tmp_path, 'overrides = ["mesh.edge_length_mm=3"]\n' + CASES["least"])
