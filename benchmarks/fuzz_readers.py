"""Damage files at random and read them: a reader may only raise its own errors, not crash or take much memory.

    python benchmarks/fuzz_readers.py --runs 1000000 --output fuzz.json

Mutational, with a fixed seed: each run takes one of the small valid files below, changes one to six places of it (bits,
bytes, numbers, words, lines, length) and reads it in this process, under an address-space limit and with warnings as
errors. Prints JSON: runs, seconds, outcomes by class, findings with the input that caused them, peak memory.
"""

from __future__ import annotations

import argparse
import base64
import bz2
import faulthandler
import gzip
import json
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import nibabel
import numpy as np

from palpate.errors import PalpateError
from palpate.images import read_intensities, read_label_image, read_label_table

SHAPE = (4, 5, 6)
MEMORY_BYTES = 2 * 2**30
MOST_FINDINGS = 20
SLOW_SECONDS = 5.0
WORDS = (
    *(b"-1", b"0", b"1", b"2", b"32767", b"65536", b"4294967296", b"99999999999999999999", b"9" * 5000, b"1e308"),
    *(b"nan", b"inf", b"-inf", b"1e-320", b"none", b"(", b")", b",", b'"', b"#", b":", b":=", b"=", b"\n", b"\n\n"),
    *(b"%d", b"%s%n", b"LIST", b"LOCAL", b"../../x", b"/etc/passwd", b"x.raw", b"gzip", b"raw", b"ascii", b"block"),
    *(b"True", b"False", b"\0", b"\xff\xfe", b"\xc3\x28", b"\x1b[2J", "\u202e".encode(), b"A" * 70000, b"\t", b"\r"),
    *(b"<Label ", b"<!DOCTYPE x [", b"]]>", b"&a;", b"</"),
    *(b"Segment0_LabelValue:=", b"Segment99999_Name:=", b"list", b"{", b"[" * 2000, b"null", b"1_0", "²".encode()),
)

TABLE = (
    b'<?xml version="1.0"?><CaretExtension><VolumeInformation Index="0"><LabelTable><Label Key="1" Red="1" Green="0.5"'
)
TABLE += b' Blue="0" Alpha="1"><![CDATA[prostate]]></Label></LabelTable></VolumeInformation></CaretExtension>'


@dataclass(frozen=True, slots=True)
class Target:
    """A valid file, its ending, how its bytes are packed after the damage, and the function that reads it."""

    ending: str
    content: bytes
    header: int
    pack: Callable[[bytes], bytes]
    read: Callable[[Path], object]


def plain(content: bytes) -> bytes:
    """Not packed."""
    return content


def zipped(content: bytes) -> bytes:
    """Packed by gzip."""
    return gzip.compress(content, compresslevel=1, mtime=0)


def image_targets() -> list[Target]:
    """One small label image in every form that a reader knows."""
    labels = np.random.default_rng(1).integers(0, 3, SHAPE, dtype=np.uint8)
    raw = labels.tobytes(order="F")
    written = " ".join(map(str, raw)).encode()
    nifti1 = nibabel.Nifti1Image(labels, np.diag([1.0, 2.0, 3.0, 1.0])).to_bytes()
    nifti2 = nibabel.Nifti2Image(labels, np.diag([1.0, 2.0, 3.0, 1.0])).to_bytes()
    named = nibabel.Nifti1Image(labels, np.diag([1.0, 2.0, 3.0, 1.0]))
    named.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, TABLE))
    table = named.to_bytes()
    layers = np.stack([labels == 1, labels == 2]).astype(np.uint8).tobytes(order="F")
    lists = nrrd("2 4 5 6", "raw", kinds="list domain domain domain", directions="none ")
    heads = [
        (".nii", nifti1, 352, plain),
        (".nii.gz", nifti1, 352, zipped),
        (".nii.gz", zipped(nifti1), 200, plain),
        (".nii", nifti2, 544, plain),
        (".nii", table, 352 + 8 + len(TABLE), plain),
        *(
            (ending, head + body, len(head), plain)
            for ending, head, body in (
                (".nrrd", nrrd("4 5 6", "raw"), raw),
                (".nrrd", nrrd("4 5 6", "gzip"), zipped(raw)),
                (".nrrd", nrrd("4 5 6", "bzip2"), bz2.compress(raw)),
                (".nrrd", nrrd("4 5 6", "ascii"), written),
                (".seg.nrrd", lists[:-1] + segments() + b"\n", layers),
                (".nhdr", nrrd("4 5 6", "raw")[:-1] + b"data file: voxels.raw\n", b""),
                (".mha", meta("False", "LOCAL"), raw),
                (".mha", meta("True", "LOCAL"), zlib.compress(raw)),
                (".mha", meta("False", "LOCAL", binary="False"), written),
                (".mhd", meta("False", "voxels.raw"), b""),
            )
        ),
    ]
    return [Target(*head, read) for head in heads for read in (label_image, intensities)]


def label_image(path: Path) -> object:
    """As an estimate reads it, but in this process."""
    return read_label_image(path, limits=None)


def intensities(path: Path) -> object:
    """As the report reads it, but in this process."""
    return read_intensities(path, limits=None)


def nrrd(sizes: str, encoding: str, *, kinds: str = "domain domain domain", directions: str = "") -> bytes:
    """Header of an NRRD file with its blank line."""
    return (
        f"NRRD0004\n# made\ntype: unsigned char\ndimension: {len(sizes.split())}\nspace: left-posterior-superior\n"
        f"sizes: {sizes}\nspace directions: {directions}(1,0,0) (0,2,0) (0,0,3)\nkinds: {kinds}\nendian: little\n"
        f'encoding: {encoding}\nspace units: "mm" "mm" "mm"\nspace origin: (1,2,3)\npatient:=somebody\n\n'
    ).encode()


def segments() -> bytes:
    """Keys of two segments in two layers, cropped out of a larger image."""
    keys = [
        f"Segment{k}_{key}:={value}\n"
        for k, name in enumerate(("prostate", "bladder"))
        for key, value in (("ID", name), ("Name", name), ("Color", "0.5 0.2 1"), ("LabelValue", 1), ("Layer", k))
    ]
    geometry = "-1;0;0;1;0;-2;0;2;0;0;3;-3;0;0;0;1;0;9;0;10;0;11;"
    keys.append(f"Segmentation_ConversionParameters:=a|1|b&Reference image geometry|{geometry}|c&\n")
    keys.append("Segmentation_ReferenceImageExtentOffset:=2 2 2\n")
    return "".join(keys).encode()


def meta(compressed: str, data: str, *, binary: str = "True") -> bytes:
    """Header of a MetaImage file."""
    return (
        f"ObjectType = Image\nNDims = 3\nBinaryData = {binary}\n0008|0060 = CT\nBinaryDataByteOrderMSB = False\n"
        f"CompressedData = {compressed}\n"
        "TransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 1 2 3\nCenterOfRotation = 0 0 0\nAnatomicalOrientation = RAI\n"
        f"ElementSpacing = 1 2 3\nDimSize = 4 5 6\nElementType = MET_UCHAR\nElementDataFile = {data}\n"
    ).encode()


def table_targets() -> list[Target]:
    """One label table in every form that a reader knows."""
    tables = {
        ".json": '{"labels": {"1": "prostate", "2": "bladder"}}',
        ".txt": '# labels\n0 0 0 0 0 0 0 "Clear Label"\n1 255 0 0 1 1 1 "prostate"\n2 0 255 0 0.5 1 1 "bladder"\n',
        ".ctbl": "# colours\n0 background 0 0 0 0\n1 prostate 255 0 0 255\n2 bladder 0 255 0 255\n",
        ".csv": "LabelValue,Name,Color_R,Color_G,Color_B,Color_A\n1,prostate,255,0,0,255\n2,bladder,0,255,0,255\n",
        ".tsv": "index\tname\tabbreviation\tcolor\n1\tprostate\tP\t#ff0000\n2\tbladder\tB\tn/a\n",
    }
    return [
        Target(ending, text.encode(), len(text.encode()), plain, read_label_table) for ending, text in tables.items()
    ]


def damaged(target: Target, rng: random.Random) -> bytes:
    """The target's file with one to six changes, most of them in its header."""
    content = bytearray(target.content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        reach = target.header if rng.random() < 0.9 else len(content)
        place = rng.randrange(max(1, min(reach, len(content))))
        rng.choice(CHANGES)(content, place, rng)
    return target.pack(bytes(content))


def flip_bit(content: bytearray, place: int, rng: random.Random) -> None:
    """One bit."""
    content[place : place + 1] = bytes(b ^ (1 << rng.randrange(8)) for b in content[place : place + 1])


def put_bytes(content: bytearray, place: int, rng: random.Random) -> None:
    """One, two, four or eight bytes, extreme or at random."""
    n = rng.choice((1, 2, 4, 8))
    content[place : place + n] = rng.choice((b"\xff" * n, b"\0" * n, b"\x7f" + b"\xff" * (n - 1), rng.randbytes(n)))


def put_word(content: bytearray, place: int, rng: random.Random) -> None:
    """A word that has meant trouble elsewhere, in place of some bytes."""
    content[place : place + rng.randrange(8)] = rng.choice(WORDS)


def change_number(content: bytearray, place: int, rng: random.Random) -> None:
    """The next run of digits becomes another number."""
    while place < len(content) and not 48 <= content[place] <= 57:
        place += 1
    end = place
    while end < len(content) and 48 <= content[end] <= 57:
        end += 1
    content[place:end] = rng.choice((*WORDS[:17], str(rng.randrange(1000)).encode()))


def move_line(content: bytearray, place: int, rng: random.Random) -> None:
    """The line at `place` is taken out, doubled or put elsewhere."""
    begin, end = content.rfind(b"\n", 0, place) + 1, content.find(b"\n", place) + 1
    line = bytes(content[begin : end or len(content)])
    if rng.random() < 0.7:
        del content[begin : begin + len(line)]
    if rng.random() < 0.7:
        spot = content.find(b"\n", rng.randrange(len(content) + 1)) + 1
        content[spot:spot] = line


def cut(content: bytearray, place: int, rng: random.Random) -> None:
    """The file ends early, or a part is missing."""
    del content[place : len(content) if rng.random() < 0.3 else place + rng.randrange(1, 40)]


CHANGES = (flip_bit, flip_bit, put_bytes, put_bytes, put_word, change_number, change_number, move_line, cut)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Class name of what came out, seconds, and the traceback of what should not have."""

    kind: str
    seconds: float
    flaw: str = ""


def outcome(target: Target, path: Path) -> Outcome:
    """Read one damaged file."""
    began = time.perf_counter()
    try:
        target.read(path)
    except PalpateError as error:
        kind, flaw = type(error).__name__, "" if str(error).isprintable() else f"control characters: {error!r}"
    except Exception as error:
        kind, flaw = f"foreign {type(error).__name__}", traceback.format_exc(limit=-2)
    else:
        kind, flaw = "read", ""
    return Outcome(kind, time.perf_counter() - began, flaw)


def campaign(runs: int, seed: int, folder: Path) -> dict[str, object]:
    """All runs; the document to be printed."""
    rng = random.Random(seed)
    targets = image_targets() + table_targets()
    (folder / "voxels.raw").write_bytes(bytes(4 * 5 * 6))
    kinds: Counter[str] = Counter()
    by_ending: Counter[str] = Counter()
    findings: list[dict[str, str]] = []
    slowest, began, before = 0.0, time.perf_counter(), peak_mebibytes()
    for _ in range(runs):
        target = rng.choice(targets)
        content = damaged(target, rng)
        path = folder / f"damaged{target.ending}"
        path.write_bytes(content)
        result = outcome(target, path)
        kinds[result.kind] += 1
        by_ending[target.ending] += 1
        slowest = max(slowest, result.seconds)
        flaw = result.flaw or ("slow" if result.seconds > SLOW_SECONDS else "")
        if flaw and len(findings) < MOST_FINDINGS and flaw not in {f["flaw"] for f in findings}:
            findings.append({"file": path.name, "flaw": flaw, "base64": base64.b64encode(content[:4096]).decode()})
    return {
        "runs": runs,
        "seed": seed,
        "seconds": round(time.perf_counter() - began, 1),
        "outcomes": dict(sorted(kinds.items())),
        "files": dict(sorted(by_ending.items())),
        "crashes": 0,  # a crash ends this process; then there is no document
        "findings": findings,
        "slowest_seconds": round(slowest, 3),
        "memory_limit_mib": MEMORY_BYTES // 2**20,
        "peak_memory_mib": peak_mebibytes(),
        "memory_before_mib": before,
    }


def peak_mebibytes() -> int:
    """Largest resident size of this process so far, MiB."""
    scale = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // scale


def main() -> int:
    """Run the campaign; exit code 1 when something was found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    faulthandler.enable()
    warnings.simplefilter("error")
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, hard))
    memory_disk = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory_disk if memory_disk.is_dir() else None) as folder:
        document = campaign(arguments.runs, arguments.seed, Path(folder))
    text = json.dumps(document, indent=1)
    if arguments.output:
        arguments.output.write_text(text + "\n", encoding="utf-8")
    print(text)
    return 1 if document["findings"] else 0


if __name__ == "__main__":
    sys.exit(main())
