"""case.toml: defaults, overrides, and a sentence for everything that cannot be."""

from __future__ import annotations

from pathlib import Path

import pytest

from case_texts import ORGAN, REST, case_text
from palpate.case.case import SOLVER_NAMES
from palpate.case.file import read_case
from palpate.errors import ConfigurationError
from palpate.images.tissue import Role
from palpate.mechanics.solvers.registry import SOLVERS

SMALL = case_text({"prostate": ORGAN, "rectum": {"label": "rectum", "role": "driver"}, "surroundings": REST})


@pytest.fixture
def case_file(tmp_path) -> Path:
    path = tmp_path / "sub-01.toml"
    path.write_text(SMALL, encoding="utf-8")
    return path


def test_defaults_are_those_of_the_schema(case_file):
    case = read_case(case_file)
    assert (case.id, case.patient, case.stage, case.seed) == ("sub-01", "sub-01", None, 0)
    assert (case.mechanics.law, case.mechanics.element) == ("neo-hookean", "auto")
    assert (case.domain.extent, case.domain.margin_mm, case.domain.outer_boundary) == ("image", 40.0, "moving")
    assert (case.driver.modes, case.driver.kernel_mm, case.driver.prior_mm) == (90, 20.0, 5.0)
    assert case.mesh.edge_length_mm is None
    assert read_case(case_file, ["mesh.edge_length_mm='auto'"]).mesh == case.mesh
    assert case.estimate.start_ratios == (0.5, 2.0, 8.0)
    assert case.estimate.bounds_ratio == (0.02, 200.0)
    assert (case.noise.surface_sd_mm, case.noise.correlation_length_mm) == (None, None)
    assert case.tissues[0].with_labels((1,)).poisson_ratio == 0.45


@pytest.mark.parametrize(
    ("role", "boundary", "align"),
    [
        ("rigid", "fixed", "rigid-tissues"),
        ("rigid", "moving", "rigid-tissues"),
        ("driver", "fixed", "none"),
        ("driver", "sliding", "none"),
        ("driver", "free", "surfaces"),
        ("driver", "moving", "surfaces"),
    ],
)
def test_alignment_follows_the_rigid_tissues_and_what_is_said_of_the_frame(case_file, role, boundary, align):
    overrides = [f"tissues.rectum.role={role}", f"domain.outer_boundary={boundary}"]
    assert read_case(case_file, overrides).align == align
    assert read_case(case_file, [*overrides, "images.align=surfaces"]).align == "surfaces"


def test_an_override_replaces_one_value_and_keeps_the_rest(case_file):
    case = read_case(case_file, ["mesh.edge_length_mm=3", "mechanics.element=P1", "images.after=['a.nii', 'b.nii']"])
    assert case.mesh.edge_length_mm == 3.0
    assert case.mechanics.element == "P1"
    assert [path.name for path in case.images.after] == ["a.nii", "b.nii"]
    assert case.images.before.name == "before.nii.gz"


@pytest.mark.parametrize("name", ["auto", *SOLVERS])
def test_every_solver_can_be_asked_for_by_its_name(case_file, name):
    assert read_case(case_file, [f'mechanics.solver="{name}"']).mechanics.solver == name
    assert set(SOLVER_NAMES) == {"auto", *SOLVERS}


def test_names_are_resolved_with_the_label_table(case_file):
    tissues = read_case(case_file).resolve_tissues({3: "rectum", 7: "rectum", 2: "bladder"})
    assert [tissue.labels for tissue in tissues] == [(1,), (3, 7), ()]
    assert tissues[1].role is Role.DRIVER


def test_a_name_missing_in_the_table_names_the_nearest(case_file):
    with pytest.raises(ConfigurationError, match="did you mean 'rectum_wall'"):
        read_case(case_file).resolve_tissues({3: "rectum_wall", 2: "bladder"})


def test_the_nearest_of_45000_names_is_found(case_file):
    names = {i: f"organ {i}" for i in range(45_000)} | {50_000: "rectum_wall"}
    with pytest.raises(ConfigurationError, match="did you mean 'rectum_wall'"):
        read_case(case_file).resolve_tissues(names)


def test_a_home_in_a_path_is_found_and_a_file_whose_name_looks_like_one_is_no_home(case_file, environment):
    environment(HOME="/home/somebody")
    paths = [
        read_case(case_file, [f"images.before='{name}'"]).images.before for name in ("~/a.nii", "./~b.nii", "~x/c.nii")
    ]
    assert [str(path) for path in paths] == [
        "/home/somebody/a.nii",
        str(case_file.parent / "~b.nii"),
        str(case_file.parent / "~x" / "c.nii"),
    ]


def test_a_label_claimed_by_name_and_by_number_is_refused(case_file):
    with pytest.raises(ConfigurationError, match="claimed by tissue 'prostate' and by tissue 'rectum'"):
        read_case(case_file).resolve_tissues({1: "rectum"})


def test_a_phantom_brings_its_own_tissues(tmp_path):
    path = tmp_path / "phantom.toml"
    path.write_text('[phantom]\nkind = "pelvis"\n[tissues.prostate]\nrole = "estimate"\nyoungs_modulus_kpa = 60.0\n')
    case = read_case(path)
    assert case.phantom.seed == 1
    assert case.tissues[0].label == "prostate"


BAD = {
    "mesh.edge_lenght_mm=3": "did you mean 'edge_length_mm'",
    "imagse.before='x'": "did you mean 'images'",
    "tissues.prostate.rol='known'": r"\[tissues.prostate\]: did you mean 'role'",
    "tissues.prostate.field_prior='gaussian'": r"'field_prior' in .*; correct the key, or remove it",
    "tissues.prostate.role=estimat": "did you mean 'estimate'",
    "tissues.prostate.poisson_ratio=0.5": "-1 < nu < 0.5",
    "tissues.prostate.poisson_ratio=-1.0": "-1 < nu < 0.5",
    "tissues.surroundings.youngs_modulus_kpa=-10": "positive number in kPa",
    "tissues.surroundings.youngs_modulus_kpa='10'": "must be a number",
    "tissues.surroundings.label=1": "claimed by tissue 'prostate' and by tissue 'surroundings'",
    "tissues.rectum.label=remaining": "only one tissue can be the rest",
    "tissues.rectum.label=[]": "label is",
    "tissues.rectum.label=true": "label is true",
    "tissues.rectum.label=-1": "label is -1",
    "tissues.prostate.role=driver": 'no tissue with role = "estimate"',
    "tissues.prostate.role=known": "give its youngs_modulus_kpa",
    "tissues.prostate=3": "must be a table",
    "images.after=[]": "at least one entry",
    "images.after='after.nii.gz'": "list in square brackets",
    "images=3": "must be a table",
    "mesh.edge_length_mm=0": "must be a number from 0.01 to 1000",
    "mesh.edge_length_mm=nan": "is nan, but it must be a number",
    "mesh.edge_length_mm='atuo'": "is 'atuo', but it must be a number or 'auto'",
    "seed=true": "whole number",
    "seed=1.5": "whole number",
    "mechanics.law=hooke": "did you mean",
    "mechanics.element=P3": "did you mean",
    "estimate.method=newton": "did you mean 'gauss-newton'",
    "estimate.parameters=['poisson_ratio']": "Young's moduli are always estimated",
    "tissues.prostate.poisson_ratio_sd=0.02": "without effect",
    "estimate.parameters=['youngs_modulus', 'density']": "did you mean",
    "estimate.bounds_ratio=[2.0, 1.0]": "low < high",
    "estimate.bounds_ratio=[1.0]": "must hold 2 values",
    "estimate.start_ratios=[0.001]": "do not lie between the bounds",
    "estimate.start_ratios=[]": "positive numbers",
    "estimate={start_ratios=[2.0], starts_kpa=[50.0]}": "give one of them",
    "domain.outer_boundary=open": "did you mean",
    "phantom.kind=pelvis": "not both",
    "phantom={kind='pelvis', law='hooke'}": "did you mean",
    "id=''": "printable name",
    "edge": "write key.path=value",
    "a b=3": "not valid TOML",
}


@pytest.mark.parametrize(("override", "sentence"), BAD.items(), ids=BAD)
def test_what_cannot_be_is_refused_with_a_sentence(case_file, override, sentence):
    with pytest.raises(ConfigurationError, match=sentence):
        read_case(case_file, [override])


def test_a_missing_required_key_is_named(case_file):
    case_file.write_text(SMALL.replace('before = "before.nii.gz"', ""))
    with pytest.raises(ConfigurationError, match=r"'before' is missing in \[images\]"):
        read_case(case_file)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00x", b"[images\n", b"x = 1\nx = 2\n", b"", b"a = " + b"[" * 5000])
def test_a_file_that_is_no_case_is_refused(tmp_path, content):
    (tmp_path / "case.toml").write_bytes(content)
    with pytest.raises(ConfigurationError):
        read_case(tmp_path / "case.toml")
    for path in (tmp_path / "nowhere.toml", tmp_path):
        with pytest.raises(ConfigurationError, match=rf"cannot read the case file .*{path.name}"):
            read_case(path)
