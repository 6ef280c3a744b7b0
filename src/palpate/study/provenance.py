"""What a result was made from: digests of the inputs, versions of the software."""

from __future__ import annotations

import hashlib
import platform
from importlib import metadata
from pathlib import Path

from palpate.errors import InputDataError
from palpate.study.case import Case

__all__ = ["input_digests", "software_versions"]

PACKAGES = ("palpate", "numpy", "scipy", "mmgpy", "libigl", "nibabel", "pyamg", "pymetis", "matplotlib")


def input_digests(case: Case) -> dict[str, str]:
    """SHA-256 (hexadecimal) of every input file of the case, by its key: before, after[0], names, ...

    Raises `InputDataError` when a file cannot be read.
    """
    images = case.images
    if images is None:
        return {}
    files = {"before": images.before} | {f"after[{i}]": path for i, path in enumerate(images.after)}
    for number, pair in enumerate(case.pairs):
        files |= {f"pairs[{number}].before": pair.before}
        files |= {f"pairs[{number}].after[{i}]": path for i, path in enumerate(pair.after)}
    files |= {"names": images.names} if images.names else {}
    files |= {"intensities_before": images.intensities_before} if images.intensities_before else {}
    files |= {f"intensities_after[{i}]": path for i, path in enumerate(images.intensities_after)}
    return {key: _sha256(path) for key, path in files.items()}


def software_versions() -> dict[str, str]:
    """Version of Python, of Palpate and of each installed library that takes part in the computation."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputDataError(f"cannot read {path}: {error.strerror or error}; check the path in the case") from error
