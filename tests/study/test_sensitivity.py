"""A case under changed assumptions: what is varied, how, and that an interrupted study goes on where it ended."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
import referencing

import palpate
from case_texts import LINEAR, ORGAN, REST, case_text
from palpate.body.body import joint_problem, make_body
from palpate.body.read import read_states
from palpate.case.file import read_case
from palpate.case.json_schema import SCHEMAS
from palpate.cli import main
from palpate.errors import EstimationError
from palpate.images.readers import write_label_image
from palpate.inversion import REPORTED
from palpate.mechanics.dilatation import choose_element
from palpate.progress import silent
from palpate.report.tornado import effect_text, sensitivity_page, sensitivity_table, tornado_rows
from palpate.statement.variations import fast_variations
from palpate.study import case_inversion
from palpate.study import sensitivity as study
from palpate.study.case_inversion import invert_case
from palpate.study.run import inversion_settings
from palpate.unknowns import Choice

CASE = case_text(
    {"gland <b>": ORGAN, "tube": {"label": 3, "role": "driver"}, "rest": REST | {"label": [2, 4]}},
    mechanics=LINEAR,
    mesh={"edge_length_mm": 7.0},
    driver={"modes": 8},
    domain={"outer_boundary": "fixed"},
    discrepancy={"heterogeneity_sd": 0.0, "poisson_sd": 0.0, "surface_offset_mm": 0.0},
    estimate={"start_ratios": [3.0]},
)
GLAND = "gland <b>"


@pytest.fixture(scope="module")
def case_file(twin, tmp_path_factory):
    folder = tmp_path_factory.mktemp("case")
    for name, image in (("before", twin.scene.before), ("after", twin.scene.after)):
        write_label_image(folder / f"{name}.nii.gz", image)
    (folder / "case.toml").write_text(CASE)
    return folder / "case.toml"


@pytest.fixture(scope="module")
def interrupted(case_file, tmp_path_factory):
    """Folder, document and progress of a study that was interrupted in its second variant, and was begun again.

    Of the variants two are left; that under a law without equilibrium is refused.
    """
    folder, told, real = tmp_path_factory.mktemp("out"), [], case_inversion.invert
    case = read_case(case_file)
    calls = []

    def until(problem, settings, *, progress, **rule):
        calls.append((len(settings.starts), rule))
        if len(calls) == 4:  # after the case, the case again, and a variant
            raise KeyboardInterrupt
        return real(problem, settings, progress=progress, **rule)

    def again(problem, settings, *, progress, **rule):
        if problem.finite_strain:
            raise EstimationError("no equilibrium")
        return until(problem, settings, progress=progress, **rule)

    every = list(study.variants_of(case, case.mesh.edge_length_mm))
    few = [
        next(v for v in every if v.name == name)
        for name in ("edge-length", "outer-boundary-sliding", "law-neo-hookean")
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "variants_of", lambda *_: iter(few))
        patch.setattr(case_inversion, "invert", again)
        with pytest.raises(KeyboardInterrupt):
            palpate.sensitivity(case, output=folder)
        before = len(calls)
        assert calls[0] == (len(case.estimate.start_ratios), {"rule": REPORTED}), (
            "the case itself, from every start to full accuracy"
        )
        assert calls[1:] == [(1, {"rule": study.VARIED})] * (before - 1)
        found = palpate.sensitivity(case, output=folder, progress=told.append)
        assert len(calls) == before + 1, "what was finished is not computed again"
        assert main(["sensitivity", str(case_file), "--output", str(folder), "--quiet"]) == 0
        assert len(calls) == before + 1
    return folder, found.to_dict(), told


@pytest.fixture(scope="module")
def document(interrupted):
    return interrupted[1]


def row_of(document, cause, subject="", setting=None):
    return next(
        v
        for v in document["variations"]
        if (v["cause"], v["subject"]) == (cause, subject) and setting in (None, v["setting"])
    )


def test_a_study_goes_on_where_it_was_interrupted(interrupted):
    folder, document, told = interrupted
    assert sorted(path.name.rsplit("-", 1)[0] for path in (folder / "variants").iterdir()) == [
        "as-it-is",
        "edge-length",
        "estimate",
        "law-neo-hookean",
        "outer-boundary-sliding",
    ]
    assert [line for line in told if line.startswith("estimate ")] == [
        "estimate 2 of 3 under another assumption: outer boundary sliding",
        "estimate 3 of 3 under another assumption: law neo-hookean",
    ]
    written = json.loads((folder / "sensitivity.json").read_text())
    assert set(written["files"]) == {"sensitivity.html"}
    assert {k: v for k, v in written.items() if k not in ("files", "seconds")} == {
        k: v for k, v in document.items() if k != "seconds"
    }


def test_an_assumption_that_is_not_changed_changes_nothing(case_file, monkeypatch):
    """Though an estimate from where another one ended moves on by a part of its standard deviation."""
    case = read_case(case_file)
    same = study.Variant("same", "outer_boundary", "as it is", case)
    monkeypatch.setattr(study, "variants_of", lambda *_: iter([same]))
    found = palpate.sensitivity(case, progress=None).to_dict()
    assert row_of(found, "outer_boundary")["changes"] == {GLAND: pytest.approx(0.0, abs=1e-12)}


def test_another_case_takes_nothing_from_it(case_file):
    case = read_case(case_file)
    keys = {
        study.kept_under(case, {}),
        study.kept_under(case, {"before": "ab"}),
        study.kept_under(replace(case, driver=replace(case.driver, modes=15)), {}),
    }
    assert len(keys) == 3


def test_the_document_meets_its_schema(document):
    schemas = [json.loads(path.read_text()) for path in SCHEMAS.iterdir() if path.name.endswith(".json")]
    registry = referencing.Registry().with_contents([(schema["$id"], schema) for schema in schemas])
    (own,) = (schema for schema in schemas if schema["$id"] == "sensitivity.schema.json")
    validator = jsonschema.Draft202012Validator(own, registry=registry)
    assert [error.message for error in validator.iter_errors(document)] == []
    assert list(validator.iter_errors(document | {"news": 1}))


def test_every_assumption_is_varied_by_the_method_that_serves(document):
    found = {(v["cause"], v["subject"]): v["method"] for v in document["variations"]}
    assert found == {
        ("known_modulus", "rest"): "exact",
        **{("poisson_ratio", name): "linearised" for name in (GLAND, "rest", "all tissues")},
        **{("segmentation", name): "linearised" for name in (GLAND, "tube")},
        ("driver_prior", ""): "linearised",
        ("driver_modes", ""): "linearised",
        ("edge_length", ""): "re-estimated",
        ("outer_boundary", ""): "re-estimated",
        ("law", ""): "re-estimated",
    }
    assert row_of(document, "known_modulus", "rest", "x 1.2")["changes"] == {GLAND: pytest.approx(np.log(1.2))}
    settings = [v["setting"] for v in document["variations"] if v["subject"] == "tube"]
    assert settings == ["-0.5 voxel", "-0.25 voxel", "+0.25 voxel", "+0.5 voxel"]


def test_a_surface_whose_drawing_is_an_unknown_is_not_moved_beside_it(case_file):
    """No step from an estimate with its offset free says what another offset would be found: the interval holds it."""
    case = read_case(case_file)
    case = replace(case, discrepancy=replace(case.discrepancy, surface_offset_mm=1.0))
    body = make_body(read_states(case, progress=silent), case, progress=silent)
    problem = joint_problem((body,), case, progress=silent)
    settings = inversion_settings(case, problem.parameters)
    inversion = invert_case((body,), problem, case, settings, progress=silent)
    tissues, linear = body.space.mesh.tissues, choose_element("P1").dilatation
    sought = {block.of for block in problem.parameters.blocks if block.choice is Choice.DRAWING}
    assert sought
    rows = fast_variations(inversion, settings, tissues, dilatation=linear, voxel_mm=1.0)
    drawn = [row for row in rows if row.cause == "segmentation" and row.subject in sought]
    assert {row.subject for row in drawn} == sought
    assert all(row.changes is None and "interval includes it" in row.reason for row in drawn)


def test_what_has_no_estimate_says_why(document):
    lost = row_of(document, "law", setting="neo-hookean")
    assert lost["changes"] is None
    assert lost["reason"] == "no equilibrium"


def test_variants_begin_with_the_cheap_ones_and_leave_out_what_the_case_says(case_file):
    case = read_case(case_file)
    assert [v.name for v in study.variants_of(case, 7.0)] == [
        "edge-length",
        "outer-boundary-sliding",
        "outer-boundary-free",
        "law-neo-hookean",
        "law-mooney-rivlin",
        "law-fung",
    ]
    curved = replace(case, mechanics=replace(case.mechanics, law="neo-hookean"))
    assert next(study.variants_of(curved, 7.0)).case.mechanics.law == "linear"
    assert next(study.variants_of(case, 7.0)).case.mesh.edge_length_mm == pytest.approx(8.75)


def test_the_largest_effect_comes_first_and_failures_last(document):
    rows = tornado_rows(document, GLAND)
    sizes = [row.size for row in rows]
    assert sizes == sorted(sizes, reverse=True)
    assert rows[-1].label == "material law"
    assert effect_text(rows[-1]) == "neo-hookean: no estimate"
    table = sensitivity_table(document)
    assert table[1][0] == GLAND
    assert len(table) == 2 + len(rows)


def test_the_page_is_whole_escaped_and_without_scripts(document):
    page = sensitivity_page(document)
    assert "gland &lt;b&gt;" in page
    assert GLAND not in page
    assert "<script" not in page
    assert page.count("<svg") == 1


def test_a_runaway_ends_in_an_arrow_and_says_so(document):
    changed = [
        v | {"changes": {GLAND: -7.0}, "at_bound": [GLAND]} if v["cause"] == "edge_length" else v
        for v in document["variations"]
    ]
    rows = tornado_rows(document | {"variations": changed}, GLAND)
    assert rows[0].label == "edge length of the mesh"
    assert effect_text(rows[0]) == "8.75 mm: -99.9 % (at the search's bound)"
    assert "<svg" in sensitivity_page(document | {"variations": changed})
