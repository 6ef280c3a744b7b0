"""The command line: exit codes by class of error, one JSON document on stdout, progress on stderr, no traceback."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import re
import subprocess
import sys
import time
import warnings

import pytest

from case_texts import ORGAN, REST, case_text
from palpate import errors
from palpate.cli import main
from palpate.cli.parser import EXAMPLES, make_parser
from palpate.images.readers import ImageFormat
from palpate.images.readers.registry import register
from palpate.progress import Line
from palpate.study import run
from palpate.study.earlier import strange_files

CASE = case_text({"prostate": ORGAN, "surroundings": REST})


@pytest.fixture
def case_file(tmp_path):
    path = tmp_path / "sub-01.toml"
    path.write_text(CASE)
    return path


TOLD = []  # what happens when an image of the format below is read


def read_told(_):
    return TOLD[-1]()


register(ImageFormat("Told", (".told",), read_told))


@pytest.fixture
def when_read(tmp_path):
    """Gives a case in whose images' place a function is called, as that of a reader that another package brings."""
    for name in ("before", "after"):
        (tmp_path / f"{name}.told").write_text("an image")
    (tmp_path / "told.toml").write_text(
        CASE.replace(".nii.gz", ".told") + '[tissues.rectum]\nlabel = 3\nrole = "driver"\n'
    )

    def put(function):
        TOLD.append(function)
        return tmp_path / "told.toml"

    yield put
    TOLD.clear()


@pytest.fixture
def runner(monkeypatch, case_result):
    """Put a function in the place of the one that computes; it gets the case and the progress callback."""

    def estimate(_, *, progress, truth):
        assert truth is None
        progress(Line("working"))
        progress("a detail")
        return case_result

    def install(function):
        monkeypatch.setattr(run, "estimate", function)

    install(estimate)
    return install


@pytest.mark.usefixtures("runner")
def test_an_estimate_writes_all_its_files(case_file, tmp_path, capfd):
    assert main(["estimate", str(case_file), "--output", str(tmp_path / "out")]) == 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    out, err = capfd.readouterr()
    files = json.loads((tmp_path / "out" / "result.json").read_text())["files"]
    assert names == {*files, "result.json", "log.txt"}
    assert strange_files(tmp_path / "out", files) == []
    (tmp_path / "out" / "mesh.vtu").write_text("of another run")
    assert strange_files(tmp_path / "out", files) == ["mesh.vtu"]
    assert "58.9 kPa" in out
    assert "47.1 to 73.6 kPa" in out
    assert "warning (example): a warning to be shown" in out
    assert out.splitlines()[-1] == f"open {tmp_path / 'out' / 'report.html'}"
    assert "working" in err
    assert "a detail" not in err
    assert all(said in (tmp_path / "out" / "log.txt").read_text() for said in ("working", "a detail"))


@pytest.mark.usefixtures("runner")
def test_files_of_an_earlier_run_are_named(case_file, tmp_path, capfd):
    (tmp_path / "mesh_7.vtu").write_text("of a run with seven pairs")
    assert main(["estimate", str(case_file), "--output", str(tmp_path), "--json", "--quiet"]) == 0
    out, err = capfd.readouterr()
    assert err == ""
    assert json.loads(out) == json.loads((tmp_path / "result.json").read_text())
    (warning,) = [w for w in json.loads(out)["warnings"] if w["code"] != "example"]
    assert warning["code"] == "earlier-files"
    assert "mesh_7.vtu in the output folder" in warning["message"]


def test_open_ends_and_ratios_stand_in_the_table(case_file, tmp_path, runner, case_result, capfd):
    first, second = case_result.estimation.estimates
    open_end = dataclasses.replace(first, interval95=(47.1, None))
    ratio = dataclasses.replace(second, value=None, interval95=None, ratio=3.12, ratio_interval95=(2.0, 5.0))
    estimation = dataclasses.replace(case_result.estimation, estimates=(open_end, ratio))
    runner(lambda *_, **__: dataclasses.replace(case_result, estimation=estimation))
    assert main(["estimate", str(case_file), "--output", str(tmp_path)]) == 0
    out = capfd.readouterr().out
    assert "> 47.1 kPa" in out
    assert "2.00 to 5.00 (ratio)" in out


def test_a_label_table_beside_a_case_is_refused_not_ignored(case_file, tmp_path, capfd):
    arguments = ["estimate", str(case_file), "--labels", "names.json", "--output", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert "--labels goes with images" in capfd.readouterr().err


def test_with_json_stdout_is_result_json_and_nothing_else(tmp_path, when_read, capfd):
    def noisy():
        os.write(1, b"a C library talks\n")
        warnings.warn("a library warns", stacklevel=1)
        raise errors.NotConverged("it stopped")

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(["estimate", str(when_read(noisy)), "--output", str(tmp_path), "--json", "--quiet"]) == 5
    out, err = capfd.readouterr()
    assert json.loads(out) == json.loads((tmp_path / "result.json").read_text())
    assert err == "palpate: it stopped\n"
    log = (tmp_path / "log.txt").read_text()
    assert "a C library talks" in log
    assert "a library warns" in log


@pytest.mark.usefixtures("runner")
def test_quiet_leaves_nothing_but_errors_and_the_log_is_let_go_of(case_file, tmp_path, capfd):
    assert main(["estimate", str(case_file), "--output", str(tmp_path), "--quiet"]) == 0
    assert capfd.readouterr() == ("", "")
    handlers = logging.getLogger("palpate").handlers
    assert not [handler for handler in handlers if isinstance(handler, logging.StreamHandler)]


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.ConfigurationError, 2),
        (errors.InputDataError, 3),
        (errors.GeometryError, 4),
        (errors.MeshQualityError, 4),
        (errors.SolverError, 5),
        (errors.NotConverged, 5),
        (errors.ResourceError, 6),
        (MemoryError, 6),
        (KeyboardInterrupt, 130),
        (ZeroDivisionError, 1),
    ],
)
def test_every_class_of_error_has_its_exit_code_and_no_traceback(tmp_path, when_read, capfd, error, code):
    def fail():
        raise error("the organ is gone")

    (tmp_path / "stiffness.nii.gz").write_text("earlier")
    assert main(["estimate", str(when_read(fail)), "--output", str(tmp_path), "--json", "--quiet"]) == code
    out, err = capfd.readouterr()
    document = json.loads(out)
    assert "Traceback" not in err
    assert err.startswith("palpate: ")
    assert len(err.strip().splitlines()) == 1
    assert document["schema"] == ("palpate.result/1" if code == 5 else "palpate.error/1")
    assert (tmp_path / "stiffness.nii.gz").read_text() == "earlier"


@pytest.mark.parametrize(("error", "status"), [(errors.NotConverged, "not converged"), (errors.SolverError, "failed")])
def test_an_estimate_without_result_still_writes_its_file(tmp_path, when_read, error, status):
    def fail():
        raise error("stopped after 40 steps")

    (tmp_path / "mesh.vtu").write_text("earlier")
    assert main(["estimate", str(when_read(fail)), "--output", str(tmp_path), "--quiet"]) == 5
    document = json.loads((tmp_path / "result.json").read_text())
    assert set(document["files"]) == {"report.html", "report-data.npz", "case.toml"}
    assert [warning["code"] for warning in document["warnings"]] == ["earlier-files"]
    assert "mesh.vtu" in document["warnings"][0]["message"]
    assert (document["status"], document["reason"]) == (status, "stopped after 40 steps")
    assert [estimate["value"] for estimate in document["estimates"]] == [None]
    assert "stopped after 40 steps" in (tmp_path / "report.html").read_text()


def test_a_result_that_did_not_converge_ends_with_5(case_file, tmp_path, runner, case_result, capfd):
    estimation = dataclasses.replace(case_result.estimation, status="not converged", reason="it stopped")
    result = dataclasses.replace(case_result, estimation=estimation)
    runner(lambda *_, **__: result)
    assert main(["estimate", str(case_file), "--output", str(tmp_path)]) == 5
    out, err = capfd.readouterr()
    assert "58.9" not in out
    assert "not converged: it stopped" in err
    assert json.loads((tmp_path / "result.json").read_text())["estimates"][0]["value"] is None


def test_a_bug_is_reported_with_the_place_of_its_log(tmp_path, when_read, capfd):
    def fail():
        raise ZeroDivisionError("division by zero")

    assert main(["estimate", str(when_read(fail)), "--output", str(tmp_path)]) == 1
    assert str(tmp_path / "log.txt") in capfd.readouterr().err
    assert "Traceback" in (tmp_path / "log.txt").read_text()


def test_the_demo_is_written_like_an_estimate(tmp_path, monkeypatch, case_result, capfd):
    noted = dataclasses.replace(case_result, note="The later state is simulated.")
    monkeypatch.setattr("palpate.demo.run_demo", lambda *_: noted)
    assert main(["demo", "--output", str(tmp_path)]) == 0
    out = capfd.readouterr().out
    assert "The later state is simulated." in out
    assert "60.0" in out  # the truth beside the estimate
    assert (tmp_path / "report.html").exists()


@pytest.mark.parametrize("arguments", [[], ["estimat"], ["estimate"], ["simulate", "x.toml", "--steps", "0"]])
def test_wrong_usage_ends_with_2(arguments):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2


def test_help_is_quick():
    heavy = {"numpy", "scipy", "matplotlib"}
    code = f"import sys, palpate.cli as c; sys.exit(bool({heavy} & set(sys.modules)) or c.main(['--help']))"
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert time.monotonic() - began < 5.0
    assert done.returncode == 0
    for command in ("demo", "init", "check", "mesh", "simulate", "estimate", "report"):
        assert command in done.stdout


def test_the_help_of_every_command_has_examples_that_its_parser_takes(capsys):
    parser = make_parser()
    names = re.findall(r"^    ([a-z-]+) ", parser.format_help(), flags=re.MULTILINE)
    assert {"verify", "reproduce"} | set(EXAMPLES) == set(names)
    for name in names:
        with pytest.raises(SystemExit, match="0"):
            parser.parse_args([name, "--help"])
        examples = [line.strip() for line in capsys.readouterr().out.partition("examples:")[2].splitlines() if line]
        assert 2 <= len(examples) <= 3
        for example in examples:
            words = example.split(" > ")[0].split()
            assert words[:2] == ["palpate", name]
            assert parser.parse_args(words[1:]).command is not None


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_completion_of_a_shell_is_printed(shell, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--print-completion", shell])
    assert stop.value.code == 0
    assert "palpate" in capsys.readouterr().out


@pytest.mark.parametrize(("line", "words"), [("palpate est", {"estimate"}), ("palpate init --la", {"--labels"})])
def test_a_shell_is_told_what_could_stand_at_the_end_of_its_line(tmp_path, line, words):
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_IFS": "\n"}
    command = f"{sys.executable} -m palpate 8> {tmp_path / 'said'}"  # where argcomplete answers
    subprocess.run(["bash", "-c", command], env=os.environ | asked, check=False, timeout=60)
    assert {word.strip() for word in (tmp_path / "said").read_text().split("\n")} == words


def test_the_package_runs_as_a_module():
    command = [sys.executable, "-m", "palpate", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()[0]) == (0, "palpate")
