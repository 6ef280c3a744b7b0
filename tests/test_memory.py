"""Free memory, the machine's or less where a control group limits it; and memory that is kept."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import nibabel
import numpy as np
import pytest

from case_texts import ORGAN, REST, case_text
from palpate import processes
from palpate.body import refusals
from palpate.errors import ResourceError
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue


@pytest.fixture
def group(tmp_path):
    """A control group of 1 GB, 0.7 GB of it used, of which 0.2 GB are caches that it would give back."""
    (tmp_path / "memory.max").write_text("1000000000\n")
    (tmp_path / "memory.current").write_text("700000000\n")
    (tmp_path / "memory.stat").write_text("anon 5\ninactive_file 200000000\n")
    (tmp_path / "meminfo").write_text("MemTotal: 4000000 kB\nMemFree: 1 kB\nMemAvailable: 2000000 kB\n")
    paths = str(tmp_path / "memory.max"), str(tmp_path / "memory.current"), "inactive_file"
    return {"groups": (paths,), "machine": tmp_path / "meminfo"}


def test_a_control_group_leaves_no_more_than_its_limit(group):
    assert processes.available_memory(**group) == 5e8
    assert processes.total_memory(**group) == 1e9


def test_a_control_group_without_a_limit_leaves_what_the_machine_has(group, tmp_path):
    (tmp_path / "memory.max").write_text("max\n")
    assert processes.available_memory(**group) == 2e6 * 1024.0
    assert processes.total_memory(**group) == 4e6 * 1024.0


def test_nothing_is_said_where_the_system_does_not_tell(tmp_path):
    nowhere = {"groups": (("/nowhere/limit", "/nowhere/use", "inactive_file"),), "machine": tmp_path / "none"}
    assert processes.available_memory(**nowhere) is None
    assert processes.total_memory(**nowhere) is None


@pytest.mark.parametrize(("stated", "left"), [("0.25", 2.5e8), ("3", 5e8), ("-1", 5e8), ("much", 5e8), ("", 5e8)])
def test_what_the_environment_states_is_a_limit_if_it_is_a_plain_number(group, environment, stated, left):
    environment(PALPATE_MEMORY_GB=stated)
    assert processes.available_memory(**group) == left
    assert processes.total_memory(**group) == (left if stated == "0.25" else 1e9)


CASE = case_text({"prostate": ORGAN, "surroundings": REST})
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


def test_images_that_this_machine_cannot_hold_are_refused_with_the_numbers(environment):
    index = np.zeros((40, 40, 40), dtype=np.int16)
    index[10:30, 10:30, 10:30] = 1
    tissues = (Tissue("rest", Role.VOID), Tissue("organ", Role.ESTIMATE, (1,)))
    image = Segmentation(index, VoxelGrid((40, 40, 40), np.eye(4)), tissues)
    refusals.refuse_large(image, "before.nii.gz")
    environment(PALPATE_MEMORY_GB="0.005")
    with pytest.raises(ResourceError, match=r"40 x 40 x 40 voxels.*0\.0 GB of memory.*crop the images"):
        refusals.refuse_large(image, "before.nii.gz")


AGAIN = """
import resource
from palpate.cli.entry import keep_freed_memory
kept = {kept}
size = 128 * 2**20
bytearray(size)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
bytearray(size)
print(kept, (resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before) * resource.getpagesize() / size)
"""


def fresh_share(kept, **environment):
    """Whether memory is kept, and which share of a second large array's pages the system must give anew."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    run = [sys.executable, "-c", AGAIN.format(kept=kept)]
    told, share = subprocess.run(run, env=own | environment, check=True, capture_output=True, text=True).stdout.split()
    return told, float(share)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library keeps memory as it will")
def test_memory_that_an_array_left_serves_the_next_one():
    """Unless the environment already says what the C library is to do."""
    assert fresh_share("keep_freed_memory()") == ("True", pytest.approx(0.0, abs=0.01))
    assert fresh_share(None)[1] > 0.9
    assert fresh_share("keep_freed_memory()", MALLOC_ARENA_MAX="4")[0] == "False"
