"""What a result was made from: names and digests of the inputs, versions of the software."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

from palpate.case.case import Case
from palpate.errors import InputDataError
from palpate.images.input_file import open_input

PACKAGES = (
    "palpate",
    "numpy",
    "scipy",
    "mmgpy",
    "libigl",
    "nibabel",
    "pyamg",
    "pymetis",
    "matplotlib",
    "pydicom",
    "highdicom",
)


def input_digests(case: Case, *pairs: Mapping[str, str]) -> dict[str, str]:
    """SHA-256 (hexadecimal) of the input files, by key: before, after[0], names, pairs[0].before, ...

    `pairs`: those of each pair's files, of the bytes that were read; "before.voxels" is of the file beside a header.
    Grey images, which only the report reads, are digested here, and held against this when they are read.
    Raises `InputDataError` when a file cannot be read, or was changed between two readings.
    """
    found: dict[str, str] = {}
    for digests in pairs:
        for key, digest in digests.items():
            if found.setdefault(key, digest) != digest:
                raise InputDataError(f"the file of '{key}' was changed while the case was read; run the command again")
    images = case.images
    if images is None:
        return found
    grey = {"intensities_before": images.intensities_before} if images.intensities_before else {}
    grey |= {f"intensities_after[{i}]": path for i, path in enumerate(images.intensities_after)}
    return found | {key: file_digest(path) for key, path in grey.items()}


def software_versions() -> dict[str, str]:
    """Version of Python, of Palpate and of each installed library that takes part in the computation."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def file_digest(path: Path) -> str:
    """SHA-256 (hexadecimal) of the file at `path`; raises `InputDataError` when it cannot be read."""
    try:
        with open_input(path) as file:
            return file.sha256()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputDataError(f"cannot read {path}: {reason}; check the path in the case") from error


def image_names(case: Case) -> list[str]:
    """A name for each later image of the case, pair after pair, as in `pair_names`."""
    return [name for _, later in pair_names(case) for name in later]


def pair_names(case: Case) -> list[tuple[str, tuple[str, ...]]]:
    """Names of the images of each pair, the reference state's and the later ones': their files', no two alike."""
    if case.body is not None:
        return [("body", tuple(f"state {number}" for number in range(1, case.n_states + 1)))]
    if case.images is None:
        return [("before", ("after",))]
    paths = [path for pair in case.image_pairs for path in pair.paths.values()]
    names = [path.name for path in paths]
    for depth in range(2, max(len(path.parts) for path in paths) + 1):  # folders, to tell two of one name apart
        alike = [name for name in names if names.count(name) > 1]
        deeper = ["/".join(path.parts[-depth:]) for path in paths]
        names = [longer if name in alike else name for name, longer in zip(names, deeper, strict=True)]
    left = iter(names)
    return [(next(left), tuple(next(left) for _ in pair.after)) for pair in case.image_pairs]
