"""Poisson's ratios sought beside the moduli: belief, verdict, and that they reach result, report and exports."""

from __future__ import annotations

import html
import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
import referencing

from bodies import BAR_MM, with_first_pair, write_bar
from case_texts import BALLS, LINEAR, case_text
from palpate.body.poisson_ratios import (
    PoissonRatioEstimate,
    eta_of_ratio,
    eta_slope,
    ratio_of_eta,
    ratio_verdict,
    sought_priors,
    with_ratios,
)
from palpate.case.case import Estimate
from palpate.case.file import read_case
from palpate.case.json_schema import SCHEMAS
from palpate.cli import main
from palpate.cli.outcome import estimates_table
from palpate.errors import ConfigurationError, NotConverged
from palpate.export.fitted_model import fitted_model
from palpate.images.readers import write_label_image
from palpate.report.case_report import write_case_report, write_failure_report
from palpate.statement.result import failure_document
from palpate.study.run import estimate
from palpate.study.sensitivity import sensitivity
from palpate.uncertainty import Covariance
from scenes import coarse_balls

CASE = case_text(
    BALLS | {"shell": BALLS["shell"] | {"poisson_ratio": 0.4, "poisson_ratio_sd": 0.01}},
    mechanics=LINEAR,
    mesh={"edge_length_mm": 12.0},
    driver={"modes": 8},
    discrepancy={"layer_sd": 0.0},
    estimate={"parameters": ["youngs_modulus", "poisson_ratio"], "start_ratios": [3.0]},
)
BAR = """
surfaces = [{{ name = "floor", where = "z_min" }}, {{ name = "grip", where = "z_max" }}]
body.mesh = "bar.vtu"
tissues.bar = {{ label = 1, role = "estimate", poisson_ratio = {given} }}
mechanics.law = "{law}"
discrepancy.heterogeneity_sd = 0.0
data = [
  {{ kind = "displacement-field", file = "field.csv", sd_mm = 0.01 }},
  {{ kind = "force", surface = "grip", force_n = {newtons}, direction = [0.0, 0.0, 1.0], sd_n = {sd} }},
]

[estimate]
parameters = ["youngs_modulus", "poisson_ratio"]
starts_kpa = [20.0, 200.0]
bounds_kpa = [1.0, 5000.0]
"""
FILES = [json.loads(path.read_text(encoding="utf-8")) for path in SCHEMAS.iterdir() if path.name.endswith(".json")]
REGISTRY = referencing.Registry().with_contents([(schema["$id"], schema) for schema in FILES])
RESULT = jsonschema.Draft202012Validator(REGISTRY.contents("result.schema.json"), registry=REGISTRY)
BOTH = Estimate(parameters=("youngs_modulus", "poisson_ratio"))


def seeking(case):
    return replace(case, estimate=BOTH)


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ratios")
    for name, image in (("before", coarse_balls().before), ("after", coarse_balls().after)):
        write_label_image(folder / f"{name}.nii.gz", image)
    (folder / "case.toml").write_text(CASE)
    assert main(["estimate", str(folder / "case.toml"), "--output", str(folder / "out"), "--quiet"]) == 0
    return folder / "out"


@pytest.fixture
def with_ratio(case_result):
    """A result that says something of one tissue's ratio, its covariance with it."""
    estimation = case_result.estimation
    found = PoissonRatioEstimate("prostate", 0.47, (0.44, 0.49), "weak", "it is wide", {"noise": 1})
    noise = np.diag([0.01, 0.06, 0.3])
    every = Covariance(noise, *np.zeros((3, *noise.shape)), noise)
    estimation = replace(estimation, poisson_ratios=(found,), covariance=every.of_first(2), with_ratios=every)
    space = with_ratios(case_result.space, estimation.found_ratios)
    return with_first_pair(replace(case_result, case=seeking(case_result.case), estimation=estimation), space=space)


def test_the_result_states_moduli_then_ratios_with_their_verdict(outputs):
    result = json.loads((outputs / "result.json").read_text())
    assert list(RESULT.iter_errors(result)) == []
    assert result["status"] == "converged"
    found = {(item["parameter"], item["tissue"]): item for item in result["estimates"]}
    assert list(found) == [(p, t) for p in ("youngs_modulus", "poisson_ratio") for t in ("core", "shell")]
    assert np.array(result["correlation"]).shape == (4, 4)
    ratios = [found["poisson_ratio", tissue] for tissue in ("core", "shell")]
    for item, given in zip(ratios, (0.45, 0.4), strict=True):
        if item["verdict"] == "not identified":
            assert item["interval95"] is None
        else:
            low, high = item["interval95"]
            assert low < item["value"] < high
            assert low < given < high
        assert sum(item["variance_shares"].values()) == pytest.approx(1.0)
    assert "stated prior" in ratios[1]["why"]
    assert ratios[1]["verdict"] == "not identified"
    page = (outputs / "report.html").read_text()
    assert "<h3>Poisson's ratios</h3>" in page
    assert "(found)" in page


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
@pytest.mark.parametrize("given", [0.2, 0.45, 0.49])
def test_a_bar_that_narrows_tells_its_ratio_under_every_law(tmp_path, given, law):
    """Of half a per cent of strain, where all laws are one: by Hooke's law, wherever the search begins."""
    strain, ratio, modulus = 0.005, 0.3, 50.0
    write_bar(tmp_path, strain=strain, ratio=ratio)
    newtons = 1e-3 * modulus * BAR_MM[0] * BAR_MM[1] * strain
    (tmp_path / "case.toml").write_text(BAR.format(given=given, law=law, newtons=newtons, sd=0.01 * newtons))
    found = estimate(read_case(tmp_path / "case.toml")).estimation
    (bar,), (nu,) = found.estimates, found.poisson_ratios
    assert bar.value == pytest.approx(modulus, rel=0.05)
    assert bar.interval95[0] < modulus < bar.interval95[1]
    assert nu.verdict != "not identified"
    assert nu.interval95[0] < ratio < nu.interval95[1]
    assert nu.value == pytest.approx(ratio, abs=0.03)
    assert found.correlation.shape == (2, 2)


def test_the_case_beside_the_result_says_what_was_sought_and_believed(outputs):
    case = read_case(outputs / "case.toml")
    assert case.estimate.seeks_poisson_ratios
    believed = {tissue.name: tissue.poisson_ratio_sd for tissue in case.tissues}
    assert believed == {"core": None, "shell": 0.01, "frame": None, "surroundings": None}


@pytest.mark.parametrize("made", [0.2, 0.45, 0.49])
def test_what_is_believed_is_normal_in_eta_with_the_width_stated_of_the_ratio(case_result, made):
    """To the first order: eta one standard deviation off is the ratio one of its own off, wherever models are."""
    case, given = seeking(case_result.case), case_result.tissues
    case = replace(case, tissues=(replace(case.tissues[0], poisson_ratio_sd=1e-4), *case.tissues[1:]))
    tissues = with_ratios(case_result.space, {case.tissues[0].name: made}).mesh.tissues
    (name, mean, sd), *_ = sought_priors(given, tissues, case)
    assert name == case.tissues[0].name
    centre = eta_of_ratio(made) + eta_slope(made) * mean
    ratio = next(tissue.poisson_ratio for tissue in given if tissue.name == name)
    assert ratio_of_eta(centre) == pytest.approx(ratio)
    assert ratio_of_eta(centre + eta_slope(made) * sd) - ratio == pytest.approx(1e-4, rel=1e-2)


def test_what_is_not_stated_is_so_wide_that_two_standard_deviations_reach_all_soft_solids(case_result):
    tissues = case_result.tissues
    for tissue, (_, mean, sd) in zip(tissues, sought_priors(tissues, tissues, seeking(case_result.case)), strict=False):
        ends = [eta_of_ratio(tissue.poisson_ratio) + eta_slope(tissue.poisson_ratio) * k * sd for k in (-2, 2)]
        assert mean == 0.0
        assert ratio_of_eta(ends[0]) < 0.05 + 1e-9
        assert ratio_of_eta(ends[1]) > 0.499 - 1e-9
    assert sought_priors(tissues, tissues, case_result.case) == ()


@pytest.mark.parametrize("ratio", [0.05, 0.3, 0.45, 0.4995])
def test_eta_and_the_ratio_are_each_other(ratio):
    assert ratio_of_eta(eta_of_ratio(ratio)) == pytest.approx(ratio, rel=1e-12)


@pytest.mark.parametrize(
    ("interval", "of_prior", "word"),
    [
        ((0.43, 0.47), 0.5, "identified"),
        ((0.43, 0.47), 0.8, "not identified"),
        ((0.40, 0.48), 0.5, "weak"),
        ((0.20, 0.48), 0.5, "not identified"),
    ],
)
def test_the_verdict_follows_from_the_width_and_from_what_was_believed(interval, of_prior, word):
    assert ratio_verdict(interval, settled=True, of_prior=of_prior)[0] == word
    assert ratio_verdict(interval, settled=False, of_prior=of_prior)[0] == "not identified"


def test_documents_pages_tables_and_exports_tell_ratios_from_moduli(with_ratio, tmp_path):
    document = with_ratio.to_dict()
    assert list(RESULT.iter_errors(document)) == []
    assert [item["parameter"] for item in document["estimates"]] == [
        "youngs_modulus",
        "youngs_modulus",
        "poisson_ratio",
    ]
    table = estimates_table(document).splitlines()
    assert ["prostate", "0.470", "0.440", "to", "0.490", "weak"] in [line.split() for line in table]
    page = write_case_report(with_ratio, tmp_path).read_text()
    assert "0.470" in page
    assert "Poisson's ratio of prostate" in html.unescape(page)
    model = fitted_model(with_ratio, seal="")
    assert model.covariance.shape == (2, 2)
    assert model.tissues[0].poisson_ratio == 0.47


def test_where_nothing_converged_no_ratio_is_called_found(with_ratio, tmp_path):
    error = NotConverged("it stopped")
    assert failure_document(with_ratio.case, error)["estimates"][-1]["value"] is None
    page = write_failure_report(with_ratio.case, error, tmp_path).read_text()
    assert "Poisson's ratio 0.45" in page
    assert "(found)" not in page


def test_a_ratio_outside_of_the_search_is_refused_with_what_to_do(case_result):
    case = seeking(case_result.case)
    with pytest.raises(ConfigurationError, match="lies outside: change it"):
        replace(case, tissues=(replace(case.tissues[0], poisson_ratio=-0.1), *case.tissues[1:]))


def test_how_moduli_depend_on_ratios_is_not_asked_where_these_are_sought(case_result):
    with pytest.raises(ConfigurationError, match="this case estimates them"):
        sensitivity(seeking(case_result.case))
