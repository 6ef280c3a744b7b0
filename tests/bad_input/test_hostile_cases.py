"""Cases, tables and names that no person writes by accident: the exit code of their class, one sentence, at once."""

from __future__ import annotations

import gzip
import hashlib
import json
import os

import pytest
from bad_inputs import changed, sentence

SOON = {"seconds": 5, "wall_seconds": 120}  # of processor time and by the clock, where the attack took minutes

REFUSED_VALUES = {
    "a negative seed": "seed=-1",
    "a seed of 5000 digits": "seed=" + "9" * 5000,
    "a seed of 5000 hexadecimal digits": "seed=0x" + "f" * 5000,
    "a stage of 5000 digits": "stage=" + "9" * 5000,
    "a stage of 400 digits": "stage=" + "9" * 400,
    "an edge of 401 digits": "mesh.edge_length_mm=1" + "0" * 400,
    "a margin of 401 digits": "domain.margin_mm=1" + "0" * 400,
    "a modulus of 401 digits": "tissues.surroundings.youngs_modulus_kpa=1" + "0" * 400,
    "a start of 401 digits": "estimate.start_ratios=[1.0, 1" + "0" * 400 + "]",
    "a label of 401 digits": "tissues.prostate.label=1" + "0" * 400,
    "a label of 5000 digits": "tissues.prostate.label=0x" + "f" * 5000,
    "a patient that commands a terminal": 'patient="a\\u001b[2Jb"',
    "a patient without a name": 'patient=""',
    "pairs that are no list": "pairs={}",
    "loads that are no list": "loads={}",
    "a patient with a zero byte": 'patient="a\\u0000b"',
    "a patient that turns the line": 'patient="a\\u202eb"',
    "a patient of 90 kB": f'patient="{"x" * 90_000}"',
    "60 000 brackets": "seed=" + "[" * 60_000,
    "60 000 braces": "seed=" + "{a=" * 20_000,
    "a key of 60 000 parts": "x" + ".a" * 60_000 + "=1",
    "a key of 40 000 letters": "mesh." + "a" * 40_000 + "=1",
    "a home that is not there": 'images.before="~nobody-here/before.nii.gz"',
    "a tissue's name in its own table": 'tissues.prostate.name="bladder"',
    "a tissue that a spreadsheet computes": "tissues.'=cmd()'={label=3, role=\"void\"}",
    "a tissue that one computes behind a semicolon": "tissues.'organ;=cmd()'={label=3, role=\"void\"}",
    "a tissue that one computes in wide letters": "tissues.'\uff1dcmd()'={label=3, role=\"void\"}",
    "a tissue that one computes behind a blank": "tissues.' =cmd()'={label=3, role=\"void\"}",
    "a tissue behind a blank": "tissues.' organ'={label=3, role=\"void\"}",
    "a tissue of 1800 letters": f'tissues.{"x" * 1800}={{label=3, role="void"}}',
    "a label of 1800 letters": f'tissues.prostate.label="{"x" * 1800}"',
}


@pytest.mark.parametrize("name", REFUSED_VALUES)
def test_an_impossible_value_is_refused_before_anything_is_read(name, folder, palpate):
    done = palpate(
        "estimate", "case.toml", "--set", REFUSED_VALUES[name], "--output", "out", "--quiet", cwd=folder, **SOON
    )
    code = 3 if name == "a home that is not there" else 2
    assert len(sentence(done, code)) < 1000
    assert not (folder / "out").exists()


REFUSED_FILES = {
    "a whole number of 5000 digits": (b"seed = " + b"9" * 5000, "a number in it is too long"),
    "a table of 100 000 parts": (b"[x" + b".a" * 100_000 + b"]", "over 100000 bytes"),
    "900 kB": (b"#" * 900_000, "over 100000 bytes"),
    "a line of 1000 dots": (b"x = " + b"." * 1000, "over 100 dots"),
}


@pytest.mark.parametrize("name", REFUSED_FILES)
@pytest.mark.parametrize("command", ["estimate", "check"])
def test_a_case_that_would_take_minutes_to_parse_is_refused(name, command, folder, palpate):
    content, words = REFUSED_FILES[name]
    (folder / "case.toml").write_bytes(content)
    done = palpate(command, "case.toml", "--quiet", cwd=folder, **SOON)
    assert words in sentence(done, 2)


@pytest.mark.parametrize("kind", ["a device", "a pipe"])
@pytest.mark.parametrize(("name", "code"), [("case.toml", 2), ("names.json", 3), ("after.nii.gz", 3)])
def test_only_regular_files_are_read(kind, name, code, folder, palpate):
    changed(folder, "[images]", '[images]\nnames = "names.json"')
    (folder / "names.json").write_text('{"prostate": 1}')
    (folder / name).unlink()
    (folder / name).symlink_to("/dev/zero") if kind == "a device" else os.mkfifo(folder / name)
    done = palpate("estimate", "case.toml", "--quiet", cwd=folder, **SOON)
    assert "a pipe, a socket or a device" in sentence(done, code)


def test_a_label_of_1800_letters_is_not_sought_among_45000_names(folder, palpate):
    changed(folder, "[images]", '[images]\nnames = "names.json"')
    changed(folder, "label = 1", f'label = "{"organ " * 300}"')
    names = {f"organ {i}": i for i in range(45_000)}
    (folder / "names.json").write_text(json.dumps(names, separators=(",", ":")))
    done = palpate("estimate", "case.toml", "--quiet", cwd=folder, **SOON)
    assert "1 to 200 characters" in sentence(done, 2)


WIDE = "".join(chr(0xFF10 + int(digit)) for digit in "10")
TABLES = {
    "underscores in JSON": ("names.json", '{"1_0": "prostate"}'),
    "wide digits in JSON": ("names.json", f'{{"{WIDE}": "prostate"}}'),
    "a sign in JSON": ("names.json", '{"+1": "prostate"}'),
    "wide digits in ITK-SNAP's": ("names.txt", f'{WIDE} 255 0 0 1 1 1 "prostate"\n'),
    "wide digits in Slicer's": ("names.ctbl", f"{WIDE} prostate 255 0 0 255\n"),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_label_is_written_in_plain_digits(name, folder, palpate):
    file, text = TABLES[name]
    changed(folder, "[images]", f'[images]\nnames = "{file}"')
    (folder / file).write_text(text, encoding="utf-8")
    sentence(palpate("estimate", "case.toml", "--quiet", cwd=folder), 3)


@pytest.mark.parametrize("number", ["1_5", WIDE])
def test_a_number_in_a_header_is_written_in_plain_digits(number, folder, palpate):
    header = "NRRD0004\ntype: uchar\ndimension: 3\nspace: RAS\nsizes: 4 5 6\nencoding: raw\n"
    header += f"space directions: ({number},0,0) (0,1,0) (0,0,1)\nspace origin: (0,0,0)\n\n"
    (folder / "a.nrrd").write_bytes(header.encode() + bytes(120))
    done = palpate("estimate", "case.toml", "--set", "images.after=['a.nrrd']", "--quiet", cwd=folder)
    assert "space directions" in sentence(done, 3)


def test_noise_that_drowns_all_motion_identifies_nothing(folder, palpate):
    done = palpate("estimate", "case.toml", "--set", "noise.surface_sd_mm=5", "--output", "out", "--quiet", cwd=folder)
    assert done["code"] == 0
    found = json.loads((folder / "out" / "result.json").read_text())["estimates"]
    assert {(of["verdict"], of["interval95"]) for of in found} == {("not identified", None)}


def test_steps_are_counted_in_plain_digits(folder, palpate):
    done = palpate("simulate", "case.toml", "--steps", "1_0", cwd=folder)
    assert (done["code"], "no whole number from 1 to 1000" in done["err"]) == (2, True)


def test_check_says_what_it_refuses_even_when_quiet(folder, palpate):
    changed(folder, "label = 2", "label = 1")
    assert "label 1 is claimed" in sentence(palpate("check", "case.toml", "--quiet", cwd=folder), 2)


def test_a_result_certifies_the_bytes_that_were_read(folder, palpate):
    """Voxels beside a header, too; every image is changed as soon as it was read."""
    header = "ObjectType = Image\nNDims = 3\nBinaryData = True\nTransformMatrix = -1 0 0 0 -1 0 0 0 1\nOffset = 0 0 0\n"
    header += "ElementSpacing = 1.5 1.5 1.5\nDimSize = 26 26 26\nElementType = MET_UCHAR\nElementDataFile = a.raw\n"
    voxels = gzip.decompress((folder / "after.nii.gz").read_bytes())[352:]
    (folder / "a.mhd").write_text(header)
    (folder / "a.raw").write_bytes(voxels)
    before = (folder / "before.nii.gz").read_bytes()
    settings = ("--set", "images.after=['a.mhd']", "--json", "--quiet")
    done = palpate("mesh", "case.toml", *settings, cwd=folder, append_after_reading=True)
    assert done["code"] == 0, done["err"]
    inputs = json.loads(done["out"])["inputs"]
    assert {name: of["sha256"] for name, of in inputs.items()} == {
        name: hashlib.sha256(content).hexdigest()
        for name, content in (("before", before), ("after[0]", header.encode()), ("after[0].voxels", voxels))
    }
    assert (folder / "before.nii.gz").read_bytes() == before + b"changed"
    assert (folder / "a.mhd").read_bytes() == header.encode() + b"changed"


def test_names_that_spreadsheets_compute_are_given_to_no_tissue_by_init(folder, palpate):
    (folder / "names.json").write_text(json.dumps({"1": "organ;=cmd()", "2": "rectum", "0": "body"}))
    images = ("before.nii.gz", "after.nii.gz", "--labels", "names.json")
    assert palpate("init", *images, "--output", "new", "--quiet", cwd=folder)["code"] == 0
    assert '[tissues."label 1"]' in (folder / "new" / "case.toml").read_text()
    done = palpate("check", "new/case.toml", "--quiet", "--set", "mesh.edge_length_mm=500", cwd=folder)
    assert done["code"] == 4, done["err"]  # over its mesh, for which the whole case was read
    assert "cannot be called" not in done["err"] + done["out"]
