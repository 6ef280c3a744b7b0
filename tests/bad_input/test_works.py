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


def shown(done: dict) -> list[tuple[str, str]]:
    """Codes and sentences of all that a check warns of or refuses."""
    return [(problem["code"], problem["message"]) for problem in json.loads(done["out"])["problems"]]


@pytest.fixture(scope="module")
def warned(good, palpate, tmp_path_factory) -> dict:
    """What a check says of organs that touch, reach the border and have islands, with moduli in another unit."""
    folder = Path(shutil.copytree(good, tmp_path_factory.mktemp("warned") / "case"))
    both(folder, lambda labels: islands(to_the_border(touching(labels))))
    changed(folder, "kpa = 10.0", "kpa = 100000.0")
    changed(folder, "edge_length_mm = 6.0", "edge_length_mm = 4.5")  # at 6 mm a second mesh is needed
    return palpate("check", "case.toml", "--json", "--quiet", cwd=folder)


@pytest.fixture(scope="module")
def warned_later(good, palpate, tmp_path_factory) -> dict:
    """What a check says of a later image in which hardly anything moves, and of one of masks that overlap."""
    folder = Path(shutil.copytree(good, tmp_path_factory.mktemp("warned_later") / "case"))
    masks(folder, wide=2.0)
    save(folder / "still.nii.gz", islands(anatomy()))
    changed(folder, '["after"]', '["still.nii.gz", "after"]')
    return palpate("check", "case.toml", "--json", "--quiet", cwd=folder)


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("cut-by-border", "'prostate' reaches the border"),
        ("islands", "'prostate'"),
        ("touching", "'prostate'"),
        ("units", "100000"),
    ],
)
def test_what_is_warned_of_is_not_refused(warned, code, words):
    assert warned["code"] == 0
    assert any(code == found and words in sentence for found, sentence in shown(warned)), shown(warned)


@pytest.mark.parametrize(("code", "words"), [("overlap", "'after[2]'"), ("motion-below-noise", "'after[1]'")])
def test_what_is_warned_of_in_later_images_is_not_refused(warned_later, code, words):
    assert warned_later["code"] == 0
    assert any(code == found and words in sentence for found, sentence in shown(warned_later)), shown(warned_later)


def test_voxels_in_metres_are_warned_of(folder, palpate):
    """8: and then refused, for no organ is large enough."""
    for name, options in (("before", {}), ("after", {"radius": 6.0, "shift": 0.8})):
        save(folder / f"{name}.nii.gz", anatomy(**options), np.diag([1.5e-3, 1.5e-3, 1.5e-3, 1.0]))
    done = palpate("check", "case.toml", "--json", "--quiet", cwd=folder)
    assert "voxel-size" in [code for code, _ in shown(done)]


WORKS = {
    "good": (lambda _: None, "after.nii.gz"),
    "9 labels of 0.9999": (lambda f: as_floats(f, 0.9999), "after.nii.gz"),
    "17 another grid": (other_grid, "after.nii.gz"),
    "13 masks": (masks, "after"),
    "13 layers without overlap": (
        lambda f: nrrd(f, "after.seg.nrrd", LAYERS, layers(*(anatomy(shift=0.8, radius=6.0) == i for i in (1, 2)))),
        "after.seg.nrrd",
    ),
}


@pytest.fixture(scope="module")
def read(good, palpate, tmp_path_factory) -> dict[str, dict[str, float]]:
    """Volumes (ml) by tissue of each of these, later images of one case, from a check that refuses nothing.

    The number of threads is no plain number there, and is taken for none.
    """
    folder = Path(shutil.copytree(good, tmp_path_factory.mktemp("works") / "case"))
    paths = []
    for number, (spoil, name) in enumerate(WORKS.values()):
        own = Path(shutil.copytree(good, folder / str(number)))
        spoil(own)
        paths.append(f"{number}/{name}")
    changed(folder, '["after.nii.gz"]', json.dumps(paths))
    changed(folder, "label = 1", 'label = "prostate"')
    changed(folder, "label = 2", 'label = "rectum"')
    changed(folder, "[images]", '[images]\nnames = "names.json"')
    (folder / "names.json").write_text('{"prostate": 1, "rectum": 2}')
    done = palpate("check", "case.toml", "--json", "--quiet", cwd=folder, env={"OMP_NUM_THREADS": "\u00b2"})
    assert (done["code"], done["err"]) == (0, ""), done["out"]
    rows = {row["tissue"]: row["volume_ml"] for row in json.loads(done["out"])["organs"]}
    return {name: {t: row[f"after[{i}]"] for t, row in rows.items()} for i, name in enumerate(WORKS)}


@pytest.mark.parametrize("name", WORKS)
def test_what_must_work_works(name, read):
    assert read[name]["prostate"] == pytest.approx(4.19, abs=0.06)
    assert read[name]["rectum"] == pytest.approx(4.4, abs=0.2)


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


def test_a_full_disk_ends_with_6_and_leaves_earlier_files_whole(estimated, palpate, tmp_path):
    export = ("export", str(estimated[0] / "out put"), "--format", "csv", "--output", "out", "--quiet")
    assert palpate(*export, cwd=tmp_path)["code"] == 0
    earlier = {path.name: path.read_bytes() + b"earlier" for path in (tmp_path / "out").iterdir()}
    for name, content in earlier.items():
        (tmp_path / "out" / name).write_bytes(content)
    assert "free some space" in sentence(palpate(*export, cwd=tmp_path, file_mb=0.01), 6)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == earlier


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


def test_two_runs_in_one_folder_are_refused(estimated, folder, palpate):
    export = ("export", str(estimated[0] / "out put"), "--format", "csv")
    (folder / "out").mkdir()
    with folder_lock(folder / "out"):
        found = [palpate(*c, "--output", "out", "--quiet", cwd=folder) for c in (("mesh", "case.toml"), export)]
    for done in found:
        assert f"another run of palpate (process {os.getpid()})" in sentence(done, 6)
    assert palpate(*export, "--output", "out", "--quiet", cwd=folder)["code"] == 0


def test_a_body_of_two_cubes_that_share_an_edge_is_meshed_or_refused(folder, palpate):
    """24: an edge where four faces meet is no manifold; the level set rounds it off."""
    both(folder, two_cubes)
    changed(folder, "edge_length_mm = 6.0", "edge_length_mm = 4.5")  # at 6 mm a second mesh is needed
    done = palpate("mesh", "case.toml", "--output", "out", "--json", "--quiet", cwd=folder)
    assert done["code"] in (0, 4), done["err"]
    assert "Traceback" not in done["err"]


def test_a_report_is_drawn_again_from_the_files_and_names_what_is_of_no_run(estimated, palpate, tmp_path):
    out = Path(shutil.copytree(estimated[0] / "out put", tmp_path / "out put"))
    page = out / "report.html"
    size = page.stat().st_size
    page.unlink()
    (out / "mesh.vtu").write_text("of another run")
    done = palpate("report", "out put", "--json", "--quiet", cwd=tmp_path)
    document = json.loads(done["out"])
    assert (done["code"], document["strange_files"]) == (0, ["mesh.vtu"])
    assert page.stat().st_size == pytest.approx(size, rel=0.01)


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
