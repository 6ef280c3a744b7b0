"""Nothing that a header says of a person reaches an output: identifiers are planted, and every file is searched."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK

from case_texts import BALLS, LINEAR, case_text
from dicom_files import ct_slices, save_contours, save_segmentation, save_series, traced
from palpate.cli import main
from palpate.images.label_image import LabelImage
from scenes import coarse_balls

PLANTED = "Meyer^Erika"
DATE = "19520229"
NAMED = {"core": "core of it", "shell": "shell", "frame": "frame"}
CASE = case_text(
    BALLS | {tissue: BALLS[tissue] | {"label": name} for tissue, name in NAMED.items()},
    id="balls",
    before="before.seg.nrrd",
    images={"intensities_before": "grey.mha", "names": "labels.txt"},
    mesh={"edge_length_mm": 9.0},
    mechanics=LINEAR,
    noise={"surface_sd_mm": 0.5},
    discrepancy={"layer_sd": 0.0},
    driver={"modes": 8},
    estimate={"start_ratios": [2.0]},
)
NAMES = {1: ("core of it", "#804020"), 2: ("shell", "#20c040"), 3: ("frame", "#4060ff")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("identifiers")
    scene = coarse_balls()
    write_segmentation(folder / "before.seg.nrrd", scene.before)
    write_nifti(folder / "after.nii.gz", scene.after)
    grey = SimpleITK.GetImageFromArray(scene.before.labels.T.astype(np.int16))
    grey.SetMetaData("PatientName", PLANTED)
    grey.SetMetaData("Comment", f"born {DATE}")
    SimpleITK.WriteImage(grey, str(folder / "grey.mha"))
    lines = [f'{k} {" ".join(map(str, bytes.fromhex(c[1:])))} 1 1 1 "{name}"' for k, (name, c) in NAMES.items()]
    (folder / "labels.txt").write_text(f"# {PLANTED} {DATE}\n" + "\n".join(lines) + "\n")
    (folder / "case.toml").write_text(CASE)
    return folder


def write_segmentation(path: Path, image: LabelImage) -> None:
    lps = np.diag([-1.0, -1.0, 1.0]) @ image.grid.affine[:3]
    fields: dict[str, object] = {
        "space": "left-posterior-superior",
        "space directions": lps[:, :3].T,
        "space origin": lps[:, 3],
        "encoding": "gzip",
        "content": f"{PLANTED} {DATE}",
        "PatientName": PLANTED,
        "DICOM.PatientBirthDate": DATE,
        "Segmentation_ConversionParameters": PLANTED,
    }
    labels = np.where(image.labels <= 3, image.labels, 0).astype(np.uint8)
    for k, (name, colour) in enumerate(NAMES.values()):
        rgb = " ".join(f"{part / 255:.6f}" for part in bytes.fromhex(colour[1:]))
        fields |= {f"Segment{k}_Name": name, f"Segment{k}_Color": rgb, f"Segment{k}_LabelValue": k + 1}
        fields |= {
            f"Segment{k}_ID": f"{PLANTED}_{k}",
            f"Segment{k}_Tags": f"Patient:{PLANTED}|",
            f"Segment{k}_Layer": 0,
        }
    nrrd.write(str(path), labels, fields)


def write_nifti(path: Path, image: LabelImage) -> None:
    labels = np.where(image.labels <= 3, image.labels, 0).astype(np.uint8)
    nifti = nibabel.Nifti1Image(labels, image.grid.affine)
    nifti.header["descrip"] = f"{PLANTED} {DATE}".encode()
    nifti.header["aux_file"] = PLANTED.encode()
    nifti.header["db_name"] = PLANTED.encode()
    nifti.header["intent_name"] = PLANTED.encode()
    nifti.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", f"{PLANTED} {DATE}".encode()))
    rows = "".join(f'<Label Key="{k}"><![CDATA[{name}]]></Label>' for k, (name, _) in NAMES.items())
    free = f"<MetaData><MD><Name>PatientName</Name><Value>{PLANTED}</Value></MD></MetaData><Date>{DATE}</Date>"
    table = f"<CaretExtension>{free}<VolumeInformation>{free}<LabelTable>{free}{rows}</LabelTable></VolumeInformation>"
    nifti.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, f"{table}</CaretExtension>".encode()))
    nibabel.save(nifti, path)


def contents(path: Path) -> list[bytes]:
    """What can be read in a file, and what is packed in it: chance alone spells a name of five letters in base64."""
    plain = path.read_bytes()
    unpacked = [gzip.decompress(plain)] if plain[:2] == b"\x1f\x8b" else []
    packed = [base64.b64decode(text + b"=" * (-len(text) % 4)) for text in re.findall(rb"[A-Za-z0-9+/]{40,}", plain)]
    inner = [gzip.decompress(part) for part in packed if part[:3] == b"\x1f\x8b\x08"]
    readable = re.sub(rb"[A-Za-z0-9+/]{200,}", b"", plain)
    return [readable, *unpacked, *packed, *inner]


def planted_in(path: Path) -> bool:
    traces = [trace.encode() for trace in (PLANTED, DATE, "Meyer", "Erika")]
    return any(trace.lower() in content.lower() for content in contents(path) for trace in traces)


@pytest.fixture(scope="module")
def dicom_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dicom")
    scene = coarse_balls()
    before, after = (image.labels.transpose(2, 1, 0) for image in (scene.before, scene.after))
    slices = ct_slices(before.shape, (2.5, 2.5, 2.5), (0.0, 0.0, 0.0))
    save_series(folder / "ct", slices)
    save_segmentation(folder / "before.dcm", slices, "BINARY", NAMES, {k: before == k for k in NAMES})
    save_contours(folder / "after.dcm", slices, NAMES, {k: traced(after == k, 0.5) for k in NAMES})
    lines = [line for line in CASE.splitlines() if not line.startswith(("names", "intensities"))]
    text = "\n".join(lines).replace("before.seg.nrrd", "before.dcm").replace("after.nii.gz", "after.dcm")
    (folder / "case.toml").write_text(text)
    return folder


def test_no_identifier_of_dicom_is_in_any_output(
    dicom_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert all(planted_in(path) for path in dicom_folder.rglob("*.dcm"))
    output = tmp_path / "out"
    assert main(["estimate", str(dicom_folder / "case.toml"), "--output", str(output)]) == 0
    files = [path for path in output.rglob("*") if path.is_file()]
    assert [path.name for path in files if planted_in(path)] == []
    spoken = capfd.readouterr()
    assert "Meyer" not in spoken.out + spoken.err
    assert sorted(json.loads((output / "result.json").read_text())["inputs"]) == [
        "after[0]",
        "after[0].series",
        "before",
        "before.series",
    ]
    assert "1,core,128,64,32,255" in (output / "labels.csv").read_text()


def test_the_search_finds_what_was_planted(folder: Path) -> None:
    assert all(planted_in(folder / name) for name in ("before.seg.nrrd", "after.nii.gz", "labels.txt"))


@pytest.fixture(scope="module")
def outputs(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, str]]:
    """What `estimate` and `mesh` write and say, by command; on one thread, as a cohort's row: more round otherwise."""
    done = {}
    for command in ("estimate", "mesh"):
        output, spoken = tmp_path_factory.mktemp(command), io.StringIO()
        with redirect_stdout(spoken), redirect_stderr(spoken), pytest.MonkeyPatch.context() as patch:
            patch.setenv("OMP_NUM_THREADS", "1")
            assert main([command, str(folder / "case.toml"), "--output", str(output)]) == 0
        done[command] = output, spoken.getvalue()
    return done


@pytest.mark.parametrize("command", ["estimate", "mesh"])
def test_no_identifier_of_a_header_is_in_any_output(outputs: dict[str, tuple[Path, str]], command: str) -> None:
    output, spoken = outputs[command]
    files = [path for path in output.rglob("*") if path.is_file()]
    assert len(files) >= 5
    assert [path.name for path in files if planted_in(path)] == []
    assert len(spoken) > 100
    assert "Meyer" not in spoken
    table = (output / "labels.csv").read_text()
    assert "1,core,128,64,32,255" in table
    assert "3,frame,64,96,255,255" in table


def test_no_identifier_of_a_header_is_in_any_output_of_a_cohort(
    folder: Path, outputs: dict[str, tuple[Path, str]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A row that is estimated, and one that fails over its image; one case has one result, alone and as a row."""
    table = folder / "cohort.csv"
    broken = (folder / "before.seg.nrrd").read_bytes()[:600]
    (folder / "broken.seg.nrrd").write_bytes(broken)
    assert planted_in(folder / "broken.seg.nrrd")
    rows = ("good,P,2,before.seg.nrrd,after.nii.gz", "bad,Q,1,broken.seg.nrrd,after.nii.gz")
    table.write_text("\n".join(["id,patient,stage,before,after", *rows]) + "\n")
    output = tmp_path / "study"
    arguments = ["--template", str(folder / "case.toml"), "--output", str(output), "--workers", "1"]
    assert main(["cohort", str(table), *arguments]) == 0
    files = [path for path in output.rglob("*") if path.is_file()]
    assert {path.parent.name for path in files} >= {"study", "good", "bad"}
    assert [str(path) for path in files if planted_in(path)] == []
    marks = [json.loads((output / f"cases/{row}/done.json").read_text()) for row in ("good", "bad")]
    assert [(mark["state"], mark["failure_class"]) for mark in marks] == [("done", ""), ("failed", "input")]
    alone, row = (
        json.loads((place / "result.json").read_text()) for place in (outputs["estimate"][0], output / "cases/good")
    )
    same = ("status", "estimates", "correlation", "fit", "starts", "outer_loop", "counts", "mesh")
    assert {key: row[key] for key in same} == {key: alone[key] for key in same}
    assert (output / "cases/good/report.html").exists()
    assert "cases/good/report.html" in (output / "cohort.html").read_text()
    assert main(["status", str(output)]) == 0
    spoken = capfd.readouterr()
    assert "2 rows: 1 done, 1 failed (1 input), 0 running, 0 waiting" in spoken.out
    assert "Meyer" not in spoken.out + spoken.err
    assert main(["statistics", str(output), "--json"]) == 0
    document = json.loads(capfd.readouterr().out)
    assert document["rows"] == {"in": 2, "done": 1, "failed": 1, "waiting": 0}
    assert main(["cohort", str(table), *arguments]) == 2
