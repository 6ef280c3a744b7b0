"""`palpate report` of a folder that somebody else has made: drawn, or refused with 3 and a sentence."""

from __future__ import annotations

import hashlib
import io
import json
import os
import random
import subprocess
import sys

import numpy as np
import pytest

from palpate.cli import main
from palpate.report.case_report import write_case_report
from palpate.study.outputs import write_json

NAMES = ("report.html", "report-data.npz")


@pytest.fixture(scope="module")
def folder(case_result, tmp_path_factory):
    folder = tmp_path_factory.mktemp("result")
    write_case_report(case_result, folder)
    seal(folder, case_result.to_dict())
    return folder


@pytest.fixture
def copy(folder, tmp_path):
    for name in ("result.json", *NAMES):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    return tmp_path


def seal(folder, document) -> None:
    """Let the result vouch for what lies beside it, whoever wrote it."""
    files = {name: {"sha256": hashlib.sha256((folder / name).read_bytes()).hexdigest()} for name in NAMES}
    write_json(folder / "result.json", document | {"files": files})


def tampered(folder, change_arrays=lambda _: None, change_value=lambda _: None) -> None:
    """Change the data of the report, and vouch for them."""
    with np.load(folder / "report-data.npz") as stored:
        arrays = dict(stored)
    plain = json.loads(arrays.pop("json").tobytes())
    change_arrays(arrays)
    change_value(plain["value"])
    arrays["json"] = np.frombuffer(json.dumps(plain).encode(), dtype=np.uint8)
    memory = io.BytesIO()
    np.savez_compressed(memory, **arrays)
    (folder / "report-data.npz").write_bytes(memory.getvalue())
    seal(folder, json.loads((folder / "result.json").read_text()))


def refused(folder, capsys) -> str:
    """The sentence of a refusal, which leaves the page as it was."""
    page = (folder / "report.html").read_bytes()
    capsys.readouterr()
    assert main(["report", str(folder), "--quiet"]) == 3
    assert (folder / "report.html").read_bytes() == page
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "bug" not in line
    return line


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{", '{"files": []}', '{"files": {"report-data.npz": []}}', '{"files": {"mesh.vtu": {"sha256": 1}}}',
     '{"a": NaN}', '{"a": 1e999}', "[" * 100_000, '{"files": {}}', '"x"', "\x00", "null"],
)  # fmt: skip
def test_a_result_that_is_none_is_refused(copy, capsys, text):
    (copy / "result.json").write_text(text)
    assert "result.json" in refused(copy, capsys)


@pytest.mark.parametrize("name", ["result.json", "report-data.npz"])
@pytest.mark.parametrize("kind", ["missing", "folder", "pipe"])
def test_a_file_that_is_none_is_refused(copy, capsys, name, kind):
    (copy / name).unlink()
    {"missing": lambda _: None, "folder": os.mkdir, "pipe": os.mkfifo}[kind](copy / name)
    code = main(["report", str(copy), "--quiet"])
    assert code == (6 if (name, kind) in (("result.json", "folder"), ("result.json", "pipe")) else 3)
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert name in line


def test_a_folder_that_is_not_there_is_refused_and_not_made(tmp_path, capsys):
    assert main(["report", str(tmp_path / "nowhere"), "--quiet"]) == 3
    assert "there is no folder" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("key", ["document", "tissues", "references", "later", "measured", "mesh"])
@pytest.mark.parametrize("value", [None, [], {}, 3, "x", [[]], [{}]])
def test_data_without_a_part_are_drawn_without_it_or_refused(copy, capsys, key, value):
    tampered(copy, change_value=lambda whole: whole.update({key: value}))
    code = main(["report", str(copy), "--quiet"])
    err = capsys.readouterr().err.strip()
    assert code in (0, 3), err
    assert ("report-data.npz" in err and len(err.splitlines()) == 1) if code else not err


def test_a_result_whose_numbers_were_edited_is_refused(copy, capsys):
    document = json.loads((copy / "result.json").read_text())
    document["estimates"][0]["value"] = 12.3
    (copy / "result.json").write_text(json.dumps(document))
    assert "one was changed since" in refused(copy, capsys)


def test_a_display_of_matplotlib_that_is_not_there_harms_no_page(copy):
    tampered(copy, change_value=lambda whole: whole.update({"later": []}))  # whose pictures take the time
    command = [sys.executable, "-m", "palpate", "report", str(copy), "--quiet"]
    environment = os.environ | {"MPLBACKEND": "nonsense"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_data_with_numbers_that_are_none_are_refused(copy, capsys):
    with np.load(copy / "report-data.npz") as stored:
        arrays = [name for name, array in stored.items() if array.dtype.kind == "f" and np.isfinite(array).all()]
    kept = {name: (copy / name).read_bytes() for name in ("result.json", *NAMES)}
    for name in (arrays[0], arrays[-1]):
        for number in (np.nan, np.inf):
            tampered(copy, change_arrays=lambda found, n=name, x=number: found.update({n: np.full_like(found[n], x)}))
            assert "NaN or infinite" in refused(copy, capsys)
            for file, content in kept.items():
                (copy / file).write_bytes(content)
    tampered(copy, change_value=lambda whole: whole["tissues"][0].update({"poisson_ratio": np.nan}))
    assert "NaN is no number" in refused(copy, capsys)


@pytest.mark.parametrize("number", [-1, 10**4, 2**31 - 1])
def test_indices_out_of_range_do_no_harm(copy, capsys, number):
    def change(arrays):
        for name, array in arrays.items():
            if array.dtype.kind == "i":
                arrays[name] = np.full_like(array, min(number, np.iinfo(array.dtype).max))

    tampered(copy, change_arrays=change)
    assert main(["report", str(copy), "--quiet"]) in (0, 3)
    assert "bug" not in capsys.readouterr().err


def damage(rng: random.Random, content: bytearray) -> None:
    """Change, cut or double some bytes."""
    place = rng.randrange(len(content))
    kind = rng.randrange(3)
    if kind == 0:
        content[place] ^= 1 << rng.randrange(8)
    elif kind == 1:
        del content[place : place + rng.randrange(1, 200)]
    else:
        content[place:place] = content[place : place + rng.randrange(1, 200)]


def test_damaged_data_are_refused(copy, capsys):
    """Bytes of the archive, and those of the words in it."""
    rng = random.Random(5)
    whole, document = (copy / "report-data.npz").read_bytes(), json.loads((copy / "result.json").read_text())
    with np.load(copy / "report-data.npz") as stored:
        arrays = dict(stored)
    for turn in range(180):
        content = bytearray(whole if turn % 6 else arrays["json"].tobytes())
        damage(rng, content)
        if turn % 6 == 0:
            memory = io.BytesIO()
            np.savez(memory, **arrays | {"json": np.frombuffer(bytes(content), dtype=np.uint8)})
            content = bytearray(memory.getvalue())
        (copy / "report-data.npz").write_bytes(content)
        seal(copy, document)
        assert main(["report", str(copy), "--quiet"]) in (0, 3)
        err = capsys.readouterr().err
        assert "bug" not in err
        assert "Traceback" not in err
