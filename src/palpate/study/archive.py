"""Dataclasses with arrays in one .npz file: arrays as they are, the rest as JSON, nothing pickled."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import math
import types
import typing
import zipfile
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.errors import InputDataError
from palpate.images.named_labels import printable
from palpate.study.outputs import no_constant, read_regular, write_bytes

T = TypeVar("T")

MAY_BE_NAN = {"may be": "NaN"}  # metadata of a field
LARGEST_FILE = 1 << 30  # bytes
MOST_BYTES = 1 << 30  # of all arrays together, unpacked
MOST_ARRAYS = 4096


def write_archive(value: Any, path: Path, *, version: str) -> None:
    """Write a dataclass instance to `path`; `version`: name and number of the format, "palpate.model/1" for example.

    Raises `ResourceError` when the disk refuses, `TypeError` for a value that JSON does not know.
    """
    arrays: dict[str, NDArray[Any]] = {}
    plain = {"format": version, "value": _encode(value, arrays)}
    text = json.dumps(plain, ensure_ascii=False, allow_nan=False).encode()
    memory = io.BytesIO()
    np.savez_compressed(memory, allow_pickle=False, json=np.frombuffer(text, dtype=np.uint8), **arrays)
    write_bytes(path, memory.getvalue())


def read_archive(kind: type[T], path: Path, *, version: str, sha256: str | None = None, finite: bool = False) -> T:
    """The instance of dataclass `kind` in `path`, as `write_archive` wrote it under the same `version`.

    finite: whether numbers that are NaN or infinite are refused; fields with the metadata `MAY_BE_NAN` may hold NaN.
    Raises `InputDataError` when there is none to be had, or when the file has another SHA-256 than it should.
    """
    content = read_regular(path, most_bytes=LARGEST_FILE)
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise InputDataError(
            f"{path} is not of the run that the result beside it tells of (its SHA-256 is another): run the estimate"
            " again, or work where its files came from"
        )
    try:
        arrays = _arrays(content)
        plain = json.loads(arrays["json"].tobytes(), parse_constant=no_constant)
        if plain["format"] != version:
            raise ValueError(f"its format is {str(plain['format'])[:40]!r}, not '{version}'")
        return typing.cast("T", _decode(kind, plain["value"], arrays, finite or None))
    except MemoryError:
        raise
    except Exception as error:  # any error of reading means that the file is not one of ours
        raise InputDataError(
            f"{path} does not hold the data of a run ({type(error).__name__}: {printable(str(error)[:200])}); run"
            " the estimate again"
        ) from error


def _arrays(content: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of the file, after what it declares was found to fit the file and our limits."""
    found: dict[str, NDArray[Any]] = {}
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = archive.infolist()
        if len(members) > MOST_ARRAYS or sum(member.file_size for member in members) > MOST_BYTES:
            raise ValueError("it declares more data than a result has")
        for member in members:
            with archive.open(member) as file:
                # its header must not ask for more memory than the file has bytes
                version = np.lib.format.read_magic(file)
                if version != (1, 0):
                    raise ValueError("an array has an unknown version")
                shape, _, dtype = np.lib.format.read_array_header_1_0(file)
                if dtype.hasobject or math.prod(shape) * dtype.itemsize > member.file_size or min(shape, default=0) < 0:
                    raise ValueError("an array does not fit its file")
            with archive.open(member) as file:
                found[member.filename.removesuffix(".npy")] = np.lib.format.read_array(file, allow_pickle=False)
    return found


def _encode(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """`value` in JSON's types; its arrays go to `arrays` under a number."""
    if isinstance(value, np.ndarray):
        for name, stored in arrays.items():
            if stored is value:  # an array in two places is kept once
                return name
        name = f"a{len(arrays)}"
        arrays[name] = value
        return name
    if dataclasses.is_dataclass(value):
        return {f.name: _encode(getattr(value, f.name), arrays) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _encode(item, arrays) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_encode(item, arrays) for item in value]
    return (value if math.isfinite(value) else None) if isinstance(value, float) else value


def _decode(hint: Any, value: Any, arrays: Mapping[str, NDArray[Any]], finite: bool | None) -> Any:
    """`value` as the type `hint`; finite: None where numbers may be anything, False where they may be NaN."""
    origin, arms = typing.get_origin(hint), typing.get_args(hint)
    if origin is types.UnionType:
        inner = next(arm for arm in arms if arm is not types.NoneType)
        return None if value is None else _decode(inner, value, arrays, finite)
    if origin is np.ndarray:
        array = arrays[value]
        dtype = np.dtype(typing.get_args(arms[1])[0])
        if array.dtype != dtype:
            raise ValueError(f"an array holds {array.dtype} where {dtype} belongs")
        if finite is not None and (np.isinf(array).any() or (finite and np.isnan(array).any())):
            raise ValueError("an array holds numbers that are NaN or infinite")
        array.setflags(write=False)
        return array
    if origin is tuple:
        inners = (arms[0],) * len(value) if arms[1:] == (...,) else arms
        return tuple(_decode(inner, item, arrays, finite) for inner, item in zip(inners, value, strict=True))
    if dataclasses.is_dataclass(hint):
        hints = typing.get_type_hints(hint)
        lax = {f.name for f in dataclasses.fields(hint) if f.metadata == MAY_BE_NAN}
        known = {key: _decode(hints[key], item, arrays, finite and key not in lax) for key, item in value.items()}
        return typing.cast("type", hint)(**known)
    if origin is not None:  # a mapping
        return {key: _decode(arms[1], item, arrays, finite) for key, item in value.items()}
    if finite and hint is float and value is None:
        raise ValueError("a number is missing")
    return _scalar(hint, value)


def _scalar(hint: Any, value: Any) -> Any:
    if hint is float:
        return math.nan if value is None else float(value)
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return hint(value)
    if hint in (str, int, bool) and not isinstance(value, hint):
        raise ValueError(f"{str(value)[:40]!r} is no {hint.__name__}")
    return value
