"""Damage files at random and read them: a reader may only raise its own errors, not crash or take much memory.

    python benchmarks/fuzz_readers.py --runs 1000000 --output fuzz.json

Each run takes one of the small valid files below, changes one to six places of it (bits, bytes, numbers, words, lines,
length) and reads it in this process, under an address-space limit and with warnings as errors. The seed is fixed.
Prints JSON: runs, seconds, outcomes by class, findings with the input that caused them, peak memory.
"""

from __future__ import annotations

import argparse
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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import nibabel
import numpy as np

from palpate.errors import PalpateError
from palpate.images import read_intensities, read_label_image, read_label_table

MEMORY_BYTES = 2 * 2**30
MOST_FINDINGS = 20
LONGEST_SENTENCE = 2000
SLOW_SECONDS = 2.0  # of processor time
NUMBERS = [b"-1", b"0", b"2", b"32767", b"4294967296", b"9" * 5000, b"1e308", b"nan", b"-inf", b"1e-320", b"1_0"]
WORDS = [*NUMBERS, b"none", b"(", b",", b'"', b"#", b":=", b"\n\n", b"%s%n", b"LIST", b"LOCAL", b"../../x", b"null"]
WORDS += [b"/etc/passwd", b"gzip", b"ascii", b"\0", b"\xff\xfe", b"\xc3\x28", b"\x1b[2J", b"A" * 70000, b"{", b"]]>"]
WORDS += [b"<!DOCTYPE x [", b"&a;", b"[" * 2000, b"Segment0_LabelValue:=", b"Segment99999_Name:=", b"\xc2\xb2"]
TABLE = (
    b'<?xml version="1.0"?><CaretExtension><VolumeInformation Index="0"><LabelTable><Label Key="1" Red="1" Green="0.5"'
    b' Blue="0" Alpha="1"><![CDATA[prostate]]></Label></LabelTable></VolumeInformation></CaretExtension>'
)
TABLES = {
    ".json": '{"labels": {"1": "prostate", "2": "bladder"}}',
    ".txt": '# labels\n0 0 0 0 0 0 0 "Clear Label"\n1 255 0 0 1 1 1 "prostate"\n2 0 255 0 0.5 1 1 "bladder"\n',
    ".ctbl": "# colours\n0 background 0 0 0 0\n1 prostate 255 0 0 255\n2 bladder 0 255 0 255\n",
    ".csv": "LabelValue,Name,Color_R,Color_G,Color_B,Color_A\n1,prostate,255,0,0,255\n2,bladder,0,255,0,255\n",
    ".tsv": "index\tname\tabbreviation\tcolor\n1\tprostate\tP\t#ff0000\n2\tbladder\tB\tn/a\n",
}


@dataclass(frozen=True, slots=True)
class Target:
    """A valid file: its ending, its bytes, how many of them are its header, how they are packed after the damage."""

    ending: str
    content: bytes
    header: int
    pack: Callable[[bytes], bytes] = bytes

    def read(self, path: Path) -> object:
        """As an estimate reads a file of this kind, but in this process; an image as the report does, too."""
        if self.ending in TABLES:
            return read_label_table(path)
        return read_label_image(path, limits=None), read_intensities(path, limits=None)


def targets() -> list[Target]:
    """One small label image, and one label table, in every form that a reader knows."""
    labels = np.random.default_rng(1).integers(0, 3, (4, 5, 6), dtype=np.uint8)
    raw, affine = labels.tobytes(order="F"), np.diag([1.0, 2.0, 3.0, 1.0])
    written, packed = " ".join(map(str, raw)).encode(), partial(gzip.compress, compresslevel=1, mtime=0)
    nifti1, nifti2 = (of(labels, affine).to_bytes() for of in (nibabel.Nifti1Image, nibabel.Nifti2Image))
    named = nibabel.Nifti1Image(labels, affine)
    named.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, TABLE))
    found = [
        Target(".nii", nifti1, 352),
        Target(".nii.gz", nifti1, 352, packed),
        Target(".nii.gz", packed(nifti1), 200),
    ]
    found += [Target(".nii", nifti2, 544), Target(".nii", named.to_bytes(), 360 + len(TABLE))]
    layers = np.stack([labels == 1, labels == 2]).astype(np.uint8).tobytes(order="F")
    lists = nrrd("2 4 5 6", "raw", kinds="list domain domain domain", directions="none ")[:-1] + segments() + b"\n"
    for ending, head, body in (
        (".nrrd", nrrd("4 5 6", "raw"), raw),
        (".nrrd", nrrd("4 5 6", "gzip"), packed(raw)),
        (".nrrd", nrrd("4 5 6", "bzip2"), bz2.compress(raw)),
        (".nrrd", nrrd("4 5 6", "ascii"), written),
        (".seg.nrrd", lists, layers),
        (".nhdr", nrrd("4 5 6", "raw")[:-1] + b"data file: voxels.raw\n", b""),
        (".mha", meta("False", "LOCAL"), raw),
        (".mha", meta("True", "LOCAL"), zlib.compress(raw)),
        (".mha", meta("False", "LOCAL", binary="False"), written),
        (".mhd", meta("False", "voxels.raw"), b""),
    ):
        found.append(Target(ending, head + body, len(head)))
    return found + [Target(ending, text.encode(), len(text)) for ending, text in TABLES.items()]


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
    return "".join([*keys, "Segmentation_ReferenceImageExtentOffset:=2 2 2\n"]).encode()


def meta(compressed: str, data: str, *, binary: str = "True") -> bytes:
    """Header of a MetaImage file."""
    return (
        f"ObjectType = Image\nNDims = 3\nBinaryData = {binary}\n0008|0060 = CT\nBinaryDataByteOrderMSB = False\n"
        f"CompressedData = {compressed}\nTransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 1 2 3\n"
        f"CenterOfRotation = 0 0 0\nAnatomicalOrientation = RAI\nElementSpacing = 1 2 3\n"
        f"DimSize = 4 5 6\nElementType = MET_UCHAR\nElementDataFile = {data}\n"
    ).encode()


def damaged(content: bytes, header: int, rng: random.Random) -> bytes:
    """The bytes with one to six changes, most of them in the header."""
    spoilt = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        reach = header if rng.random() < 0.9 else len(spoilt)
        change(spoilt, rng.randrange(max(1, min(reach, len(spoilt)))), rng)
    return bytes(spoilt)


def change(content: bytearray, place: int, rng: random.Random) -> None:
    """A bit, some bytes, a word, a number, a line, or the length."""
    kind = rng.choice(("bit", "bit", "bytes", "bytes", "word", "number", "number", "line", "cut"))
    if kind == "bit":
        content[place : place + 1] = bytes(b ^ (1 << rng.randrange(8)) for b in content[place : place + 1])
    elif kind == "bytes":
        n = rng.choice((1, 2, 4, 8))
        content[place : place + n] = rng.choice((b"\xff" * n, b"\0" * n, b"\x7f" + b"\xff" * (n - 1), rng.randbytes(n)))
    elif kind == "word":
        content[place : place + rng.randrange(8)] = rng.choice(WORDS)
    elif kind == "number":
        digits = [k for k in range(place, len(content)) if 48 <= content[k] <= 57]
        begin = digits[0] if digits else len(content)
        end = next((k for k in range(begin, len(content)) if not 48 <= content[k] <= 57), len(content))
        content[begin:end] = rng.choice((*NUMBERS, str(rng.randrange(1000)).encode()))
    elif kind == "line":
        begin, end = content.rfind(b"\n", 0, place) + 1, content.find(b"\n", place) + 1 or len(content)
        line = bytes(content[begin:end])
        if rng.random() < 0.7:
            del content[begin:end]
        if rng.random() < 0.7:
            spot = content.find(b"\n", rng.randrange(len(content) + 1)) + 1
            content[spot:spot] = line
    else:
        del content[place : len(content) if rng.random() < 0.3 else place + rng.randrange(1, 40)]


def outcome(read: Callable[[], object], codes: set[int] | None = None) -> tuple[str, str]:
    """Class name of what comes out of reading, and what should not have been; codes: those that a refusal may have."""
    began, flaw = time.thread_time(), ""
    try:
        read()
        kind = "read"
    except PalpateError as error:
        kind, sentence = type(error).__name__, str(error)
        if "bug" in sentence or not sentence.isprintable() or len(sentence) > LONGEST_SENTENCE:
            flaw = f"{len(sentence)} letters: {sentence[:300]!r}"
        if codes is not None and error.exit_code not in codes:
            flaw = f"exit code {error.exit_code}: {sentence}"
    except Exception as error:
        kind, flaw = f"foreign {type(error).__name__}", traceback.format_exc(limit=-3)[-2000:]
    slow = time.thread_time() - began > SLOW_SECONDS
    return kind, flaw or ("slow" if slow else "")


def one_run(every: list[Target], rng: random.Random, folder: Path) -> tuple[str, str, str, bytes]:
    """Read one damaged file: its ending, what came out, what should not have been, its bytes."""
    target = rng.choice(every)
    content = target.pack(damaged(target.content, target.header, rng))
    path = folder / f"damaged{target.ending}"
    path.write_bytes(content)
    return target.ending, *outcome(lambda: target.read(path)), content


Run = Callable[[random.Random, Path], tuple[str, str, str, bytes]]


def counted(runs: Sequence[Run], seed: int, folder: Path) -> dict[str, object]:
    """The outcomes of all runs by their kind, and the first findings."""
    rng, began, findings = random.Random(seed), time.perf_counter(), list[dict[str, str]]()
    kinds: dict[str, Counter[str]] = {}
    for number, run in enumerate(runs):
        kind, came, flaw, content = run(rng, folder)
        kinds.setdefault(kind, Counter())[came] += 1
        if flaw and len(findings) < MOST_FINDINGS and flaw not in {finding["flaw"] for finding in findings}:
            shown = content[:4096].decode("utf-8", errors="backslashreplace")
            findings.append({"kind": kind, "run": str(number), "flaw": flaw, "input": shown})
    return {
        "runs": len(runs),
        "seed": seed,
        "seconds": round(time.perf_counter() - began, 1),
        "outcomes": {kind: dict(sorted(counts.items())) for kind, counts in sorted(kinds.items())},
        "findings": findings,  # a crash ends this process; then there is no document
        "peak_memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 2**10,
    }


def campaign(runs: int, seed: int, folder: Path) -> dict[str, object]:
    """All runs; the document to be printed."""
    (folder / "voxels.raw").write_bytes(bytes(4 * 5 * 6))
    document = counted([partial(one_run, targets())] * runs, seed, folder)
    files: dict[str, dict[str, int]] = document["outcomes"]  # type: ignore[assignment]
    total = sum((Counter(of) for of in files.values()), Counter[str]())
    return document | {
        "outcomes": dict(sorted(total.items())),
        "files": {end: sum(of.values()) for end, of in files.items()},
    }


def limited(asked: argparse.Namespace, work: Callable[[Path], dict[str, object]]) -> int:
    """A campaign under limits, printed; exit code 1 when something was found."""
    faulthandler.enable()
    warnings.simplefilter("error")
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    memory_disk = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory_disk if memory_disk.is_dir() else None) as folder:
        document = work(Path(folder))
    text = json.dumps(document, indent=1)
    if asked.output:
        asked.output.write_text(text + "\n", encoding="utf-8")
    print(text)
    return 1 if document["findings"] else 0


def parser_of(text: str) -> argparse.ArgumentParser:
    """What every campaign is asked for."""
    parser = argparse.ArgumentParser(description=text.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--output", type=Path)
    return parser


def main() -> int:
    """Run the campaign."""
    asked = parser_of(__doc__ or "").parse_args()
    return limited(asked, lambda folder: campaign(asked.runs, asked.seed, folder))


if __name__ == "__main__":
    sys.exit(main())
