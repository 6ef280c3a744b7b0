"""Poisson's ratios sought beside the moduli: belief, verdict, and that they reach result, report and exports."""

from __future__ import annotations

import html
import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
import referencing

from palpate.cli import main
from palpate.cli.outcome import estimates_table
from palpate.errors import ConfigurationError, NotConverged
from palpate.export.fitted_model import fitted_model
from palpate.images.readers import write_label_image
from palpate.mechanics.linear_model import linear_model
from palpate.report.case_report import write_case_report, write_failure_report
from palpate.study.case import Estimate, Mechanics
from palpate.study.case_file import read_case
from palpate.study.json_schema import SCHEMAS
from palpate.study.poisson_ratios import PoissonRatioEstimate, ratio_verdict, with_found_ratios, with_stated_priors
from palpate.study.result import failure_document
from palpate.study.sensitivity import sensitivity
from palpate.uncertainty import Covariance
from palpate.unknowns import eta_of_ratio, parameter_map, ratio_of_eta, unit_blocks
from scenes import coarse_balls

CASE = """
[images]
before = "before.nii.gz"
after = ["after.nii.gz"]

[tissues.core]
label = 1
role = "estimate"

[tissues.shell]
label = 2
role = "estimate"
poisson_ratio = 0.4
poisson_ratio_sd = 0.01

[tissues.frame]
label = 3
role = "driver"

[tissues.surroundings]
label = "remaining"
role = "known"
youngs_modulus_kpa = 10.0

[mechanics]
law = "linear"
element = "P1"

[mesh]
edge_length_mm = 12.0

[driver]
modes = 8

[discrepancy]
layer_sd = 0.0

[estimate]
parameters = ["youngs_modulus", "poisson_ratio"]
start_ratios = [3.0]
"""
FILES = [json.loads(path.read_text(encoding="utf-8")) for path in SCHEMAS.iterdir() if path.name.endswith(".json")]
REGISTRY = referencing.Registry().with_contents([(schema["$id"], schema) for schema in FILES])
RESULT = jsonschema.Draft202012Validator(REGISTRY.contents("result.schema.json"), registry=REGISTRY)
BOTH = Estimate(parameters=("youngs_modulus", "poisson_ratio"))


def seeking(case):
    return replace(case, estimate=BOTH, mechanics=Mechanics(law="linear"))


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
    found = PoissonRatioEstimate(
        "prostate", 0.47, (0.44, None), "profile", "not identified", "it is open", {"noise": 1}
    )
    noise = np.diag([0.01, 0.06, 0.3])
    covariance = Covariance(noise, *np.zeros((3, *noise.shape)))
    estimation = replace(estimation, poisson_ratios=(found,), covariance=covariance)
    space = with_found_ratios(case_result.space, estimation.poisson_ratios)
    return replace(case_result, case=seeking(case_result.case), estimation=estimation, space=space)


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


def test_the_case_beside_the_result_says_what_was_sought_and_believed(outputs):
    case = read_case(outputs / "case.toml")
    assert case.estimate.seeks_poisson_ratios
    believed = {tissue.name: tissue.poisson_ratio_sd for tissue in case.tissues}
    assert believed == {"core": 0.03, "shell": 0.01, "frame": None, "surroundings": None}


def test_what_is_believed_is_normal_in_eta_with_the_width_stated_of_the_ratio(twin, case_result):
    """To the first order: eta one standard deviation off is the ratio one of its own off."""
    space = twin.model.space
    model = linear_model(space, twin.model.constraint, open_poisson=("gland",))
    mapping = parameter_map(space.mesh.tissues, model.regions, unit_blocks(model.n_modes), open_poisson=("gland",))
    case = seeking(case_result.case)
    tissues = tuple(replace(t, name="gland", poisson_ratio_sd=1e-4) for t in case.tissues[:1])
    stated = with_stated_priors(mapping, replace(case, tissues=tissues))
    open_ = stated.poisson[0]
    sd = stated.prior_precision[open_.column, open_.column] ** -0.5
    centre = stated.prior_mean[open_.column]
    assert ratio_of_eta(centre) == pytest.approx(open_.given)
    assert ratio_of_eta(centre + sd) - open_.given == pytest.approx(1e-4, rel=1e-2)
    assert not np.delete(np.diag(stated.prior_precision), open_.column).any()


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
        ((0.45, None), 0.0, "not identified"),
        ((None, 0.45), 0.0, "not identified"),
    ],
)
def test_the_verdict_follows_from_the_width_and_from_what_was_believed(interval, of_prior, word):
    assert ratio_verdict(interval, at_bound=False, of_prior=of_prior)[0] == word
    assert ratio_verdict(interval, at_bound=True, of_prior=of_prior)[0] == "not identified"


def test_documents_pages_tables_and_exports_tell_ratios_from_moduli(with_ratio, tmp_path):
    document = with_ratio.to_dict()
    assert list(RESULT.iter_errors(document)) == []
    assert [item["parameter"] for item in document["estimates"]] == [
        "youngs_modulus",
        "youngs_modulus",
        "poisson_ratio",
    ]
    table = estimates_table(document).splitlines()
    assert ["prostate", "0.470", ">", "0.440", "not", "identified"] in [line.split() for line in table]
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
        replace(case, tissues=(replace(case.tissues[0], poisson_ratio=0.4998), *case.tissues[1:]))


def test_how_moduli_depend_on_ratios_is_not_asked_where_these_are_sought(case_result):
    with pytest.raises(ConfigurationError, match="this case estimates them"):
        sensitivity(seeking(case_result.case))
