"""Free memory: the machine's, or less where a control group limits it."""

from __future__ import annotations

import os
import subprocess
import sys

import nibabel
import numpy as np
import pytest

from palpate import memory
from palpate.errors import ResourceError
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue
from palpate.study import refusals


@pytest.fixture
def group(tmp_path, monkeypatch):
    """A control group of 1 GB, 0.7 GB of it used, of which 0.2 GB are caches that it would give back."""
    (tmp_path / "memory.max").write_text("1000000000\n")
    (tmp_path / "memory.current").write_text("700000000\n")
    (tmp_path / "memory.stat").write_text("anon 5\ninactive_file 200000000\n")
    paths = str(tmp_path / "memory.max"), str(tmp_path / "memory.current"), "inactive_file"
    monkeypatch.setattr(memory, "CGROUPS", (paths,))
    return tmp_path


@pytest.mark.usefixtures("group")
def test_a_control_group_leaves_no_more_than_its_limit():
    assert memory.available_memory() == 5e8


def test_a_control_group_without_a_limit_leaves_what_the_machine_has(group):
    (group / "memory.max").write_text("max\n")
    assert memory.available_memory() == memory._of_machine() or memory.available_memory() > 5e8


def test_nothing_is_said_where_the_system_does_not_tell(monkeypatch):
    monkeypatch.setattr(memory, "CGROUPS", (("/nowhere/limit", "/nowhere/use", "inactive_file"),))
    monkeypatch.setattr(memory, "_of_machine", lambda: None)
    assert memory.available_memory() is None


CASE = """
[images]
before = "before.nii.gz"
after = ["after.nii.gz"]
[tissues.prostate]
label = 1
role = "estimate"
[tissues.surroundings]
label = "remaining"
role = "known"
youngs_modulus_kpa = 3.0
"""
PEAK = """
import palpate.cli
palpate.cli.main(["check", "case.toml", "--quiet"])
line = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
print("peak", line.split()[1])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the peak is read from /proc")
def test_check_takes_ten_bytes_a_voxel_of_an_empty_pair(tmp_path):
    size = 300
    for name in ("before", "after"):
        image = nibabel.Nifti1Image(np.zeros((size,) * 3, dtype=np.uint8), np.diag([0.5, 0.5, 0.5, 1.0]))
        nibabel.save(image, tmp_path / f"{name}.nii.gz")
    (tmp_path / "case.toml").write_text(CASE)
    environment = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    command = [sys.executable, "-c", PEAK]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert "has no voxel in 'before' and 'after'" in done.stderr
    peak = 1024.0 * float(done.stdout.split("peak")[1])
    assert peak < 3e8 + 13.0 * size**3  # the program itself takes 0.25 GB


def test_images_that_this_machine_cannot_hold_are_refused_with_the_numbers(monkeypatch):
    index = np.zeros((40, 40, 40), dtype=np.int16)
    index[10:30, 10:30, 10:30] = 1
    tissues = (Tissue("rest", Role.VOID), Tissue("organ", Role.ESTIMATE, (1,)))
    image = Segmentation(index, VoxelGrid((40, 40, 40), np.eye(4)), tissues)
    refusals.refuse_large(image, "before.nii.gz")
    monkeypatch.setattr(refusals, "machine_memory_gb", lambda: 0.005)
    with pytest.raises(ResourceError, match=r"40 x 40 x 40 voxels.*0\.0 GB of memory.*crop the images"):
        refusals.refuse_large(image, "before.nii.gz")
