"""The problems with known answers: the quick ones are met, all are told, and a failure is a failure."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from palpate.cli import main
from palpate.errors import NotConverged
from palpate_validation.problems.beads import prediction_errors, read_beads
from palpate_validation.problems.contract import Check, Problem, rows_of
from palpate_validation.verify import PROBLEMS, Verification, page, verification

PAGE = (Path(__file__).parents[2] / "docs" / "verification.md").read_text()
KEYS = {
    *("id", "title", "quantity", "reference", "source", "value"),
    *("error_percent", "tolerance_percent", "order", "pass"),
}


@pytest.mark.parametrize("problem", [p for p in PROBLEMS if p.quick], ids=lambda problem: problem.id)
def test_every_quick_problem_is_met(problem):
    failed = [row for row in rows_of(problem) if not row["pass"]]
    assert not failed


def families_of(cell):
    """Those that a row of the page names: "B1 to B3", "B9, B10"."""
    for part in cell.split(", "):
        first, _, last = part.partition(" to ")
        yield from (f"{first[0]}{number}" for number in range(int(first[1:]), int((last or first)[1:]) + 1))


def test_the_page_tells_of_every_family_of_problems_and_no_other():
    cells = re.findall(r"^\| ([BEM]\d[^|]*) \|", PAGE, flags=re.MULTILINE)
    told = [family for cell in cells for family in families_of(cell)]
    told += re.findall(r"^(M\d+) is a record", PAGE, flags=re.MULTILINE)
    assert sorted(told) == sorted({re.match(r"[BEM]\d+", problem.id).group() for problem in PROBLEMS})
    plain = re.sub(r"<!--.*?-->", "", PAGE)
    assert f"computes {len(PROBLEMS)} problems" in plain
    assert re.search(r"All are within their\s+tolerance", PAGE)


def test_there_are_at_least_twenty_problems_of_each_family():
    ids = [problem.id for problem in PROBLEMS]
    assert len(set(ids)) == len(ids) >= 20
    families = {re.match(r"[BEM]\d+", name).group() for name in ids}
    assert {f"B{i}" for i in range(14)} | {"B16", "M1"} | {f"E{i}" for i in range(1, 7)} <= families


def made(name, *values, reference=1.0):
    """A problem whose values are given; each may err by one per cent."""
    checks = tuple(Check("length (mm)", reference, value, 1.0) for value in values)
    return Problem(name, "A rod", "a ruler", lambda: checks)


def test_the_error_is_that_of_the_scale():
    assert Check("x", -2.0, -2.1, 5.0).error_percent == pytest.approx(5.0)
    assert Check("x", 0.0, 0.1, 5.0, scale=2.0).passed
    assert not Check("x", 0.0, 0.11, 5.0, scale=2.0).passed
    assert not Check("x", 1.0, float("nan"), 5.0).passed


def test_a_row_is_json_even_without_a_value():
    (row,) = rows_of(made("B1", float("nan")))
    assert set(row) == KEYS
    assert json.loads(json.dumps(row, allow_nan=False))["value"] is None
    assert row["pass"] is False


def test_a_problem_that_cannot_be_computed_has_failed():
    def fail():
        raise NotConverged("no equilibrium beyond 30 %")

    (row,) = rows_of(replace(made("B1"), measure=fail))
    assert "no equilibrium" in row["quantity"]
    assert (row["pass"], row["value"]) == (False, None)
    assert "failed: B1" in page(Verification((row,)))


def test_an_interrupted_run_goes_on_where_it_was(tmp_path):
    computed = []

    def counted(name):
        def measure():
            computed.append(name)
            if name == "B2" and len(computed) == 2:
                raise KeyboardInterrupt
            return (Check("x", 1.0, 1.0, 1.0),)

        return replace(made(name), measure=measure)

    problems = [counted("B1"), counted("B2")]
    with pytest.raises(KeyboardInterrupt):
        verification(problems).written(tmp_path, progress=lambda _: None)
    document = verification(problems).written(tmp_path, progress=lambda _: None).to_dict()
    assert computed == ["B1", "B2", "B2"]
    assert (document["passed"], document["failed"]) == (2, 0)
    assert {path.name for path in tmp_path.iterdir() if path.suffix} == {"verification.json", "verification.md"}
    verification(problems).written(tmp_path, progress=lambda _: None)
    assert computed[3:] == ["B1", "B2"]


def interrupted(folder, problems, value):
    """A run of these problems that ended before it had said anything, the first with this value; gives their ids."""
    ids = [problem.id for problem in problems]

    def interrupt(text):
        if text.startswith(f"part {len(ids)} of"):
            raise KeyboardInterrupt

    known = [made(name, value if name == ids[0] else 1.0) for name in ids]
    with pytest.raises(KeyboardInterrupt):
        verification(known).written(folder, progress=interrupt)
    return ids


@pytest.mark.parametrize(("value", "code"), [(1.005, 0), (1.02, 5)])
def test_the_command_says_by_its_exit_code_whether_all_is_well(tmp_path, capfd, value, code):
    quick = interrupted(tmp_path, [problem for problem in PROBLEMS if problem.quick], value)
    assert main(["verify", "--json", "--quick", "--output", str(tmp_path)]) == code
    document = json.loads(capfd.readouterr().out)
    assert [row["id"] for row in document["problems"]] == quick
    assert document["failed"] == int(code == 5)
    assert document["passed"] == len(quick) - document["failed"]
    assert json.loads((tmp_path / "verification.json").read_text()) == document
    assert quick[0] in (tmp_path / "verification.md").read_text()
    ids = interrupted(tmp_path, PROBLEMS, value)
    assert main(["verify", "--output", str(tmp_path)]) == code
    out, err = capfd.readouterr()
    assert all(name in out for name in ids)
    assert (f"outside of their tolerance: {ids[0]}" in err) == (code == 5)


def test_the_document_counts_its_checks():
    rows = rows_of(made("B1", 1.0, 1.005, 2.0))
    document = Verification(tuple(rows)).to_dict()
    assert (document["passed"], document["failed"]) == (2, 1)


def test_the_beads_inside_move_as_those_around_them_say():
    """Better than a gel that shrinks: at nu = 0.3 the linear law errs by half as much again."""
    beads = read_beads()
    good, poor = (np.median(prediction_errors(beads, "linear", nu)) for nu in (0.48, 0.3))
    assert good < 0.38
    assert poor > 1.3 * good
    assert np.median(np.linalg.norm(beads.motion[beads.inside], axis=1)) > 3.0 * good
