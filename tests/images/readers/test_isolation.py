"""A process of its own reads each image: what goes wrong there is a sentence here, and no code comes back."""

from __future__ import annotations

import json
import os
import resource
import signal
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import nibabel
import numpy as np
import pytest

from children import in_a_child
from palpate.errors import InputDataError, ResourceError
from palpate.images.readers import ReadLimits, isolation, nifti, read_intensities, read_label_image
from palpate.images.readers.registry import ImageFormat

AFFINE = np.diag([1.0, 2.0, 3.0, 1.0])
needs_limits = pytest.mark.skipif(sys.platform != "linux", reason="address space is limited on Linux only")


def saved(path: Path, shape: tuple[int, ...] = (4, 5, 6)) -> Path:
    values = np.random.default_rng(3).integers(0, 5, shape, dtype=np.uint8)
    nibabel.save(nibabel.Nifti1Image(values, AFFINE), path)
    return path


@pytest.fixture
def first(first_place: Path) -> Callable[[str], None]:
    """Says which Python code the reading process runs before ours: Python imports `sitecustomize` when it starts."""

    def put(code: str) -> None:
        (first_place / "sitecustomize.py").write_text(f"import os, sys, time\n{code}\n", encoding="utf-8")

    return put


def reading(code: str) -> str:
    """Code that has the process run `code` where it looks the reader of a file up."""
    return (
        "from palpate.images.readers import registry\n"
        f"plain = registry.own_format\ndef looked_up(name):\n    {code}\n    return plain(name)\n"
        "registry.own_format = looked_up"
    )


def greet(answer: object, tail: str = "os._exit(0)") -> str:
    line = json.dumps(answer).encode() + b"\n"
    return f"sys.stdout.buffer.write({line!r}); sys.stdout.buffer.flush(); {tail}"


def test_the_process_gives_the_same_image_as_reading_here(tmp_path: Path) -> None:
    path = saved(tmp_path / "a b 'c' ü.nii.gz")
    there, here = read_label_image(path), read_label_image(path, limits=None)
    assert np.array_equal(there.labels, here.labels)
    assert np.array_equal(there.grid.affine, here.grid.affine)
    (values, _), (same, _) = read_intensities(path), read_intensities(path, limits=None)
    assert np.array_equal(values, same)


def test_names_and_colours_come_through_the_pipe(tmp_path: Path) -> None:
    head = (
        "NRRD0004\ntype: uchar\ndimension: 3\nspace: RAS\nsizes: 2 2 2\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n"
        "encoding: raw\nSegment0_Name:=Blase ü\nSegment0_Color:=1 0 0\nSegment0_LabelValue:=3\n\n"
    )
    (tmp_path / "a.seg.nrrd").write_bytes(head.encode() + b"\3" * 8)
    image = read_label_image(tmp_path / "a.seg.nrrd")
    assert image.names == {3: "Blase ü"}
    assert image.colours == {3: "#ff0000"}


def test_a_refusal_there_is_the_same_refusal_here(tmp_path: Path) -> None:
    path = tmp_path / "a.nii.gz"
    path.write_bytes(saved(tmp_path / "b.nii.gz").read_bytes()[:40])
    texts = []
    for limits in (ReadLimits(), None):
        with pytest.raises(InputDataError) as caught:
            read_label_image(path, limits=limits)
        texts.append(str(caught.value))
    assert texts[0] == texts[1]


@pytest.mark.parametrize("name", ["SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE"])
def test_a_crash_is_a_sentence_that_names_the_file(tmp_path: Path, first: Callable[[str], None], name: str) -> None:
    path = saved(tmp_path / "a.nii")
    for begin in ("", greet({"shape": [4, 5, 6], "dtype": "|u1", "affine": AFFINE.tolist(), "names": []}, "pass")):
        first(f"{begin}\nos.kill(os.getpid(), {int(getattr(signal, name))})")
        with pytest.raises(InputDataError, match=rf"a\.nii' crashed \({name}\)"):
            read_label_image(path)


def test_a_reader_killed_by_the_system_is_short_of_memory(tmp_path: Path, first: Callable[[str], None]) -> None:
    first("os.kill(os.getpid(), 9)")
    with pytest.raises(ResourceError, match=r"a\.nii'.*memory"):
        read_label_image(saved(tmp_path / "a.nii"))


def test_a_reader_that_hangs_is_stopped(tmp_path: Path, first: Callable[[str], None]) -> None:
    path = saved(tmp_path / "a.nii")
    first(reading("time.sleep(60)"))
    with pytest.raises(ResourceError, match=r"a\.nii' took more than"):
        read_label_image(path, limits=ReadLimits(wall_seconds=0.5))


def test_a_process_that_cannot_start_is_a_resource_error(tmp_path: Path, first: Callable[[str], None]) -> None:
    path = saved(tmp_path / "a.nii")
    first("os._exit(1)")
    with pytest.raises(ResourceError, match="did not start"):
        read_label_image(path)

    def without_files_left() -> int:
        resource.setrlimit(resource.RLIMIT_NOFILE, (4, 4))
        with pytest.raises(ResourceError, match="did not start"):
            read_label_image(path)
        return 0

    assert in_a_child(without_files_left) == 0


@pytest.mark.parametrize(
    "answer",
    [
        [],
        {"shape": [4, 5]},
        {"shape": [4, 5, -6], "dtype": "|u1", "affine": AFFINE.tolist(), "names": []},
        {"shape": [4, 5, 2**40], "dtype": "|u1", "affine": AFFINE.tolist(), "names": []},
        {"shape": [4, 5, 6], "dtype": "|O8", "affine": AFFINE.tolist(), "names": []},
        {"shape": [4, 5, 6], "dtype": "u1,O", "affine": AFFINE.tolist(), "names": []},
        {"shape": [4, 5, 6], "dtype": "|u1", "affine": [[1, 2]], "names": []},
        {"shape": [4, 5, 6], "dtype": "|u1", "affine": AFFINE.tolist(), "names": [["a"]]},
        {"shape": [4, 5, 6], "dtype": 3, "affine": AFFINE.tolist(), "names": []},
        {"shape": [4, 5, 6], "dtype": "(f8", "affine": AFFINE.tolist(), "names": []},
        {"shape": [4, 5, 6], "dtype": "|u1", "affine": AFFINE.tolist(), "names": [], "digests": {"": "é" * 64}},
        {"error": "SystemExit", "message": "\u001b[2J"},
        {"error": 3},
    ],
)
def test_an_answer_of_a_process_gone_wrong_is_not_believed(
    tmp_path: Path, first: Callable[[str], None], answer: object
) -> None:
    first(greet(answer))
    with pytest.raises(InputDataError) as caught:
        read_label_image(saved(tmp_path / "a.nii"))
    assert str(caught.value).isprintable()


@needs_limits
def test_memory_beyond_the_limit_is_a_resource_error(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.nii")
    content = bytearray(path.read_bytes())
    struct.pack_into("<3h", content, 42, 512, 1024, 1024)
    path.write_bytes(content)
    os.truncate(path, 352 + 2**29)  # a hole: the file is that long, but takes no room
    with pytest.raises(ResourceError, match=r"a\.nii' needs more memory than a reader may use"):
        read_label_image(path, limits=ReadLimits(memory_bytes=2**29))


@needs_limits
def test_processor_time_beyond_the_limit_is_a_resource_error(tmp_path: Path, first: Callable[[str], None]) -> None:
    path = saved(tmp_path / "a.nii")
    first(reading("while True: pass"))
    with pytest.raises(ResourceError, match=r"a\.nii' took more than"):
        read_label_image(path, limits=ReadLimits(cpu_seconds=1))


@needs_limits
def test_the_process_can_write_no_file(tmp_path: Path, first: Callable[[str], None]) -> None:
    path, place = saved(tmp_path / "a.nii"), tmp_path / "written"
    ignored = "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)"
    first(reading(f"{ignored}; open({str(place)!r}, 'wb', buffering=0).write(b'x')"))
    with pytest.raises(InputDataError, match="File too large"):
        read_label_image(path)
    assert place.stat().st_size == 0


def test_modules_in_the_working_folder_are_not_imported(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.nii")
    for module in ("numpy", "nibabel", "json", "palpate"):
        (tmp_path / f"{module}.py").write_text("import pathlib; pathlib.Path('trapped').touch()")

    def read() -> int:
        os.chdir(tmp_path)
        sys.path.insert(0, "")
        return 0 if read_label_image(path.name).labels.shape == (4, 5, 6) else 1

    assert in_a_child(read) == 0
    assert not (tmp_path / "trapped").exists()


def test_what_a_library_prints_does_not_reach_the_answer(tmp_path: Path, first: Callable[[str], None]) -> None:
    path = saved(tmp_path / "a.nii")
    first(reading("os.write(1, b'noise'); print('noise', flush=True)"))
    assert read_label_image(path).labels.shape == (4, 5, 6)


def test_a_flaw_of_a_reader_is_a_sentence(tmp_path: Path, first: Callable[[str], None]) -> None:
    path = saved(tmp_path / "a.nii")
    first(reading("raise ZeroDivisionError('by zero')"))
    with pytest.raises(InputDataError, match=r"reader of '.*a\.nii' failed \(ZeroDivisionError: by zero\)"):
        read_label_image(path)


def children() -> set[str]:
    """Processes that this one has started, other tests' among them."""
    listed = Path(f"/proc/self/task/{os.getpid()}/children")
    if not listed.exists():
        pytest.skip("this system does not list the children of a process")
    return set(listed.read_text().split())


def test_no_process_stays_behind(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.nii")
    before = children()
    read_label_image(path)
    assert children() <= before


def test_formats_of_other_programs_are_read_in_their_own_process(tmp_path: Path) -> None:
    def reader(path: Path):
        return nifti.read_nifti(path)

    stored = isolation.read_stored(
        saved(tmp_path / "a.nii"), "labels", ImageFormat("Ours", (".ours",), reader), ReadLimits()
    )
    assert stored.values.shape == (4, 5, 6)
