"""What is warned of or must work, of docs/bad-input.md, and what the machine does to a run."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from bad_inputs import (
    LAYERS,
    anatomy,
    as_floats,
    both,
    changed,
    islands,
    layers,
    masks,
    nrrd,
    other_grid,
    save,
    sentence,
    to_the_border,
    touching,
    two_cubes,
)

from palpate.study.lock import folder_lock

WARNED = {
    "20 an organ at the border": (lambda f: both(f, to_the_border), "cut-by-border"),
    "13 masks that overlap": (lambda f: masks(f, wide=2.0), "overlap"),
    "22 islands": (lambda f: both(f, islands), "islands"),
    "23 organs that touch": (lambda f: both(f, touching), "touching"),
    "26 motion below the noise": (
        lambda f: save(f / "after.nii.gz", islands(anatomy())),
        "motion-below-noise",
    ),
    "31 units that slipped": (lambda f: changed(f, "kpa = 10.0", "kpa = 100000.0"), "units"),
    "8 voxels in metres": (
        lambda f: [save(f / f"{n}.nii.gz", anatomy(**o), np.diag([1.5e-3, 1.5e-3, 1.5e-3, 1.0]))
                   for n, o in (("before", {}), ("after", {"radius": 6.0, "shift": 0.8}))],
        "voxel-size",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WARNED)
def test_what_is_warned_of_is_not_refused(name, folder, palpate):
    spoil, code = WARNED[name]
    spoil(folder)
    done = palpate("check", "case.toml", "--json", "--quiet", cwd=folder)
    document = json.loads(done["out"])
    refused = [problem for problem in document["problems"] if problem["exit_code"]]
    assert code in [problem["code"] for problem in document["problems"]]
    assert name.startswith("8") or (done["code"], refused) == (0, [])


@pytest.mark.parametrize(
    "name", ["good", "9 labels of 0.9999", "17 another grid", "13 layers without overlap", "13 masks"]
)
def test_what_must_work_works(name, folder, palpate):
    spoil = {
        "good": lambda _: None,
        "9 labels of 0.9999": lambda f: as_floats(f, 0.9999),
        "17 another grid": other_grid,
        "13 masks": masks,
        "13 layers without overlap": lambda f: (
            nrrd(f, "after.seg.nrrd", LAYERS, layers(*(anatomy(shift=0.8, radius=6.0) == i for i in (1, 2)))),
            changed(f, "label = 1", 'label = "prostate"'),
            changed(f, "label = 2", 'label = "rectum"'),
            changed(f, "[images]", '[images]\nnames = "names.json"'),
            (f / "names.json").write_text('{"prostate": 1, "rectum": 2}'),
        ),
    }[name]
    spoil(folder)
    done = palpate("check", "case.toml", "--json", "--quiet", cwd=folder)
    assert done["code"] == 0, done["out"]
    volumes = {row["tissue"]: row["volume_ml"] for row in json.loads(done["out"])["organs"]}
    assert volumes["prostate"]["after[0]"] == pytest.approx(4.19, abs=0.06)
    assert volumes["rectum"]["after[0]"] == pytest.approx(4.4, abs=0.2)


STRANGE = "</script><img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def estimated(good, palpate, tmp_path_factory):
    """An estimate in a folder with blanks and accents, of a tissue named like an attack, without GPU and display."""
    folder = Path(shutil.copytree(good, tmp_path_factory.mktemp("x") / "two words, größer"))
    names = {"1": STRANGE, "2": "../../rectum"}
    (folder / "names.json").write_text(json.dumps(names))
    changed(folder, "[tissues.prostate]\nlabel = 1", f"[tissues.'{STRANGE}']\nlabel = '{STRANGE}'")
    changed(folder, "[tissues.rectum]\nlabel = 2", "[tissues.'../../rectum']\nlabel = '../../rectum'")
    changed(folder, "[images]", '[images]\nnames = "names.json"')
    held = ("--set", "domain.outer_boundary=fixed")  # a ball that only shifts is no stiffer than a frame that moves
    return folder, palpate("estimate", "case.toml", "--output", "out put", *held, cwd=folder)


def test_blanks_and_markup_in_names_do_no_harm(estimated, palpate):
    folder, done = estimated
    assert done["code"] == 0, done["err"]
    assert STRANGE not in (folder / "out put" / "report.html").read_text()
    assert {path.name for path in folder.iterdir()} == {
        *("before.nii.gz", "after.nii.gz", "case.toml", "names.json", "out put"),
    }
    assert palpate("mesh", "case.toml", "--output", "m", "--quiet", cwd=folder)["code"] == 0
    assert all(path.parent.name in {"m", "surfaces"} for path in (folder / "m").rglob("*.vt?"))


def test_a_report_is_drawn_again_from_the_files(estimated, palpate):
    folder, _ = estimated
    page = folder / "out put" / "report.html"
    size = page.stat().st_size
    page.unlink()
    done = palpate("report", "out put", "--json", "--quiet", cwd=folder)
    document = json.loads(done["out"])
    assert (done["code"], document["strange_files"]) == (0, [])
    assert page.stat().st_size == pytest.approx(size, rel=0.01)
    (folder / "out put" / "mesh.vtu").write_text("of another run")
    done = palpate("report", "out put", "--json", "--quiet", cwd=folder)
    assert json.loads(done["out"])["strange_files"] == ["mesh.vtu"]


def test_without_anything_known_a_ratio_is_stated_and_a_bound_leaves_no_interval(good, palpate, tmp_path):
    folder = Path(shutil.copytree(good, tmp_path / "ratio"))
    changed(folder, '"known"\nyoungs_modulus_kpa = 10.0', '"estimate"')
    changed(folder, "[1.0]", "[1.0]\nbounds_ratio = [0.98, 1.02]")
    held = ("--set", "discrepancy.heterogeneity_sd=0", "--set", "domain.outer_boundary=fixed")  # what bounds forbid
    done = palpate("estimate", "case.toml", "--output", "out", "--json", "--quiet", *held, cwd=folder)
    assert done["code"] == 0, done["err"]
    document = json.loads(done["out"])
    (item,) = document["estimates"]
    assert (item["value"], item["unit"], item["verdict"]) == (None, "ratio", "not identified")
    assert (item["ratio_interval95"], item["interval95_given_model"]) == (None, None)
    assert "ratio-only" in [warning["code"] for warning in document["warnings"]]


def test_a_full_disk_ends_with_6_and_leaves_earlier_files_whole(estimated, folder, palpate):
    out = shutil.copytree(estimated[0] / "out put", folder / "out")
    earlier = {path.name: path.read_bytes() for path in Path(out).iterdir() if path.name != "log.txt"}
    done = palpate("mesh", "case.toml", "--output", "out", "--quiet", cwd=folder, file_mb=0.01)
    assert "free some space" in sentence(done, 6)
    assert {name: (folder / "out" / name).read_bytes() for name in earlier} == earlier


def test_a_folder_that_cannot_be_written_ends_with_6(folder, palpate):
    (folder / "out").write_text("a file")
    done = palpate("estimate", "case.toml", "--output", "out", "--quiet", cwd=folder)
    assert "choose another --output" in sentence(done, 6)


def test_memory_that_runs_out_ends_with_6(folder, palpate):
    changed(folder, "edge_length_mm = 6.0", "edge_length_mm = 2.0")  # for which the mesher makes room for millions
    done = palpate("mesh", "case.toml", "--output", "out", "--quiet", cwd=folder, memory_mb=700)
    assert done["code"] == 6, done["err"]
    assert "Traceback" not in done["err"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_ends_with_130_and_leaves_earlier_files_whole(number, folder, palpate):
    (folder / "out").mkdir()
    (folder / "out" / "result.json").write_text("earlier")
    changed(folder, "edge_length_mm = 6.0", "edge_length_mm = 2.0")  # long enough to be interrupted
    done = palpate("estimate", "case.toml", "--output", "out", "--quiet", cwd=folder, interrupt=[number, 1.5])
    assert "interrupted" in sentence(done, 130)
    assert sorted(path.name for path in (folder / "out").iterdir()) == ["log.txt", "result.json"]
    assert (folder / "out" / "result.json").read_text() == "earlier"


def test_two_runs_in_one_folder_are_refused(folder, palpate):
    (folder / "out").mkdir()
    with folder_lock(folder / "out"):
        done = palpate("mesh", "case.toml", "--output", "out", "--quiet", cwd=folder)
    assert f"another run of palpate (process {os.getpid()})" in sentence(done, 6)
    assert palpate("mesh", "case.toml", "--output", "out", "--quiet", cwd=folder)["code"] == 0


def test_a_body_of_two_cubes_that_share_an_edge_is_meshed_or_refused(folder, palpate):
    """24: an edge where four faces meet is no manifold; the level set rounds it off."""
    both(folder, two_cubes)
    done = palpate("mesh", "case.toml", "--output", "out", "--json", "--quiet", cwd=folder)
    assert done["code"] in (0, 4), done["err"]
    assert "Traceback" not in done["err"]
