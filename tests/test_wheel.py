"""The wheel holds all that runs need: taken apart, it works away from the repository."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hatchling.builders.wheel import WheelBuilder

from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory) -> Path:
    """The folder with what the wheel holds."""
    folder = tmp_path_factory.mktemp("wheel")
    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(folder / "dist"), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


def run(unpacked: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python in an empty folder, where the unpacked wheel stands before the repository."""
    environment = os.environ | {"PYTHONPATH": str(unpacked)}
    command = [sys.executable, "-P", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_a_case_is_made_from_the_wheel(unpacked, tmp_path):
    """With the demo's names: how images of that size are read is no matter of the wheel."""
    done = run(unpacked, tmp_path, "-c", "import palpate; print(palpate.__file__)")
    assert Path(done.stdout.strip()) == unpacked / "palpate" / "__init__.py"
    names = unpacked / "palpate" / "demo" / "data" / "labels.json"
    images = [str(tmp_path / f"{state}.nii.gz") for state in ("before", "after")]
    places = np.stack(np.meshgrid(*[np.arange(16.0)] * 3, indexing="ij"), axis=-1)
    for path, radius in zip(images, (3.0, 4.0), strict=True):
        labels = (np.linalg.norm(places - 8.0, axis=-1) < radius).astype(np.int32)
        write_label_image(Path(path), LabelImage(labels, VoxelGrid((16, 16, 16), np.eye(4))))
    done = run(unpacked, tmp_path, "-m", "palpate", "init", *images, "--labels", str(names), "--quiet")
    assert (done.returncode, done.stderr) == (0, "")
    assert "[tissues.prostate]" in (tmp_path / "palpate-output" / "case.toml").read_text()


def test_the_commands_beside_the_package_come_with_the_wheel(unpacked, tmp_path):
    done = run(unpacked, tmp_path, "-m", "palpate", "verify", "--help")
    assert "--quick" in done.stdout
    done = run(unpacked, tmp_path, "-c", "import palpate_validation.verify as v; print(v.__file__)")
    assert Path(done.stdout.strip()) == unpacked / "palpate_validation" / "verify.py"


def test_every_file_of_the_package_is_in_the_wheel(unpacked):
    def files(package: Path) -> set[Path]:
        """Those of a package, but for what Python keeps of the modules that it compiled."""
        found = (path for path in package.rglob("*") if path.is_file() and path.parent.name != "__pycache__")
        return {path.relative_to(package) for path in found}

    assert files(unpacked / "palpate") == files(ROOT / "src" / "palpate")
    assert files(unpacked / "palpate_validation") == files(ROOT / "validation" / "palpate_validation")
    assert files(unpacked / "multifrontal") == files(ROOT / "packages" / "multifrontal" / "src" / "multifrontal")
    licences = {path.name for path in next(unpacked.glob("*.dist-info/licenses")).rglob("*") if path.is_file()}
    assert {"LICENSE", "NOTICE", "gel_beads.LICENSE.txt", "three.LICENSE.txt"} <= licences
