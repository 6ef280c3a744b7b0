"""`palpate check`: everything at once, and a cost that follows volumes and edge length."""

from __future__ import annotations

import dataclasses
import json

import pytest

from case_texts import BALLS, ORGAN, REST, case_text
from palpate.body import cost
from palpate.body.cost import expected_cost, expected_tets
from palpate.case.file import read_case
from palpate.cli import main
from palpate.errors import ResourceError
from palpate.images.readers import write_label_image
from palpate.mechanics.solvers import registry
from palpate.progress import silent
from palpate.study import check
from palpate.study.check import check_case
from palpate.study.run import estimate
from scenes import coarse_balls

FRAMED = {"core": ORGAN, "frame": BALLS["frame"], "rest": REST}


def test_every_problem_is_listed_and_the_first_is_what_an_estimate_ends_with(tmp_path, without):
    for name in ("before.nii.gz", "after.nii.gz"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "case.toml").write_text(
        case_text(
            {"prostate": ORGAN, "rest": REST | {"youngs_modulus_kpa": 1e5}},
            after=["after.nii.gz", "none.nii.gz"],
            estimate={"samples": 1000},
        )
    )
    without("h5netcdf")
    found = check_case(tmp_path / "case.toml", (), progress=silent)
    words = (
        "nothing moves this body",
        "h5netcdf, which is not installed",
        "before.nii.gz' is empty",
        "after.nii.gz' is empty",
        "there is no file",
        "Pa, wr",
    )
    assert [sum(word in problem.message for problem in found.problems) for word in words] == [1] * 6
    assert found.exit_code == 2
    assert "nothing moves this body" in found.problems[0].message
    assert found.text().splitlines()[-2].startswith("warning (units): tissue 'rest'")


def test_a_case_that_cannot_be_read_is_a_problem_with_its_code(tmp_path, capsys):
    (tmp_path / "case.toml").write_text("[images\n")
    assert main(["check", str(tmp_path / "case.toml"), "--json"]) == 2
    document = json.loads(capsys.readouterr().out)
    assert (document["schema"], document["exit_code"]) == ("palpate.check/1", 2)
    assert [problem["severity"] for problem in document["problems"]] == ["refused"]
    assert [path.name for path in tmp_path.iterdir()] == ["case.toml"]


def test_one_cause_in_many_images_and_pairs_is_one_line(tmp_path):
    """The same image eight times, and in a second pair; a finding on an organ in all of them, too."""
    write_label_image(tmp_path / "before.nii.gz", coarse_balls().before)
    again = ["before.nii.gz"]
    pairs = [{"before": "before.nii.gz", "after": 2 * again}]
    (tmp_path / "case.toml").write_text(case_text(FRAMED, after=8 * again, images={"align": "none"}, pairs=pairs))
    found = check_case(tmp_path / "case.toml", (), progress=silent)
    (same,) = (problem.message for problem in found.problems if "same label image" in problem.message)
    assert same.startswith("'before' and 'after[1]' are the same")
    assert "; also 'after[2]', 'after[3]'" in same
    assert "'after[1]' of pair 2" in same
    causes = [(problem.code, problem.message.split("'")[1:2]) for problem in found.problems if not problem.exit_code]
    assert len(set(map(str, causes))) == len(causes), causes
    assert found.text().count("each code is explained on") == bool(causes)


def test_refusals_of_one_cause_with_other_numbers_are_one_line():
    problems = check._Problems()
    for number, change in enumerate((31.0, 45.5, 60.0), start=1):
        place = f"'after[{number}]'"
        text = f"the volume of 'core' changes by {change:+.1f}% from 'before' to {place}: check its label"
        problems.add(check.Problem("InputDataError", text, 3, place))
    problems.add(
        check.Problem("InputDataError", "the volume of 'rim' changes by +31.0% from 'before' to 'after[1]'", 3)
    )
    core, rim = problems.all()
    assert core.message.endswith(": check its label; also 'after[2]', 'after[3]'")
    assert "'rim'" in rim.message


def test_half_the_edge_length_costs_about_eight_times_the_tetrahedra(case_result):
    case = case_result.case
    finer = [dataclasses.replace(case, mesh=dataclasses.replace(case.mesh, edge_length_mm=h)) for h in (4.0, 2.0)]
    coarse, fine = (expected_tets(one, case_result.before, case_result.after) for one in finer)
    assert 4.0 < fine / coarse < 10.0


def test_cost_grows_with_modes_images_and_pairs_and_shrinks_with_processors(case_result, environment):
    case, before, after = case_result.case, case_result.before, case_result.after
    plain = expected_cost(case, before, after, n_pairs=1)
    fewer = dataclasses.replace(case, driver=dataclasses.replace(case.driver, modes=10))
    assert expected_cost(fewer, before, after, n_pairs=1).memory_gb < plain.memory_gb
    assert expected_cost(case, before, (*after, *after), n_pairs=1).seconds > plain.seconds
    assert expected_cost(case, before, after, n_pairs=2).unknowns == 2 * plain.unknowns
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        environment(**{name: None})
    shared = expected_cost(case, before, after, n_pairs=1)
    environment(OMP_NUM_THREADS="1")
    alone = expected_cost(case, before, after, n_pairs=1)
    assert (shared.seconds < alone.seconds) == (shared.processors > 1)


def test_cost_is_that_of_the_solver_that_will_run(case_result, environment):
    case, before, after = case_result.case, case_result.before, case_result.after
    plain = expected_cost(case, before, after, n_pairs=1)
    asked = dataclasses.replace(case, mechanics=dataclasses.replace(case.mechanics, solver="multigrid"))
    iterated = expected_cost(asked, before, after, n_pairs=1)
    assert plain.solver.startswith("multifrontal")
    assert iterated.solver == "multigrid"
    assert iterated.seconds > plain.seconds
    environment(PALPATE_MEMORY_GB="0.001")
    assert expected_cost(case, before, after, n_pairs=1).solver != "multifrontal"


def test_what_else_runs_does_not_change_what_is_expected(case_result, monkeypatch):
    case, before, after = case_result.case, case_result.before, case_result.after
    plain = expected_cost(case, before, after, n_pairs=1)
    for module in (registry, cost):
        monkeypatch.setattr(module, "available_memory", lambda: 1e3)
    assert expected_cost(case, before, after, n_pairs=1) == plain
    assert [problem.code for problem in check.memory_problems(plain)] == ["memory-now"]


def test_an_estimate_is_refused_for_the_memory_that_a_check_refuses_it_for(tmp_path):
    for name, image in (("before", coarse_balls().before), ("after", coarse_balls().after)):
        write_label_image(tmp_path / f"{name}.nii.gz", image)
    (tmp_path / "case.toml").write_text(case_text(FRAMED, mesh={"edge_length_mm": 0.1}))
    found = check_case(tmp_path / "case.toml", (), progress=silent)
    (refused,) = (problem for problem in found.problems if problem.code == "memory")
    with pytest.raises(ResourceError, match="memory would be needed") as told:
        estimate(read_case(tmp_path / "case.toml"))
    assert str(told.value) == refused.message


@pytest.mark.parametrize(("share", "code"), [(100.0, None), (1.0, 0), (0.1, 6)])
def test_memory_that_will_not_do_is_told_before(case_result, environment, share, code):
    needed = expected_cost(case_result.case, case_result.before, case_result.after, n_pairs=1)
    environment(PALPATE_MEMORY_GB=f"{share * needed.memory_gb:.6f}")
    found = [problem.exit_code for problem in check.memory_problems(needed)]
    assert found == ([] if code is None else [code])


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        ((100.0, 110.0), "about 2 minutes"),
        ((120.0, 240.0), "2 to 4 minutes"),
        ((60.0, 120.0), "a minute to 2 minutes"),
        ((20.0, 60.0), "half a minute to a minute"),
        ((4000.0, 9000.0), "67 minutes to 2.5 hours"),
    ],
)
def test_a_range_of_times_names_its_unit_once(seconds, words):
    least, most = (cost.ExpectedCost(1, 1, 1.0, each, "multigrid", 2) for each in seconds)
    assert dataclasses.replace(least, between=(least, most)).time_words == words
