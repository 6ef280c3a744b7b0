"""The data of a report come back from their file as they were, and a bad file is refused."""

from __future__ import annotations

import dataclasses
import io
import zipfile

import numpy as np
import pytest

from palpate.errors import InputDataError, NotConverged
from palpate.report.collect import collect, collect_failure
from palpate.report.report_data import ReportData


@pytest.fixture(scope="module")
def data(case_result):
    return collect(case_result)


def same(a, b):
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif dataclasses.is_dataclass(a):
        assert type(a) is type(b)
        for field in dataclasses.fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            same(a[key], b[key])
    elif isinstance(a, tuple | list):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            same(one, other)
    else:
        assert a == b


def test_everything_comes_back(data, tmp_path):
    data.save(tmp_path / "a.npz")
    same(data, ReportData.load(tmp_path / "a.npz"))


def test_the_data_of_a_failure_come_back(case_result, tmp_path):
    data = collect_failure(case_result.case, NotConverged("stopped"))
    data.save(tmp_path / "a.npz")
    same(data, ReportData.load(tmp_path / "a.npz"))


def test_nothing_is_pickled(data, tmp_path):
    data.save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert all(arrays[name].dtype.kind in "iuf" for name in arrays)


def member(array, **kwargs):
    memory = io.BytesIO()
    np.lib.format.write_array(memory, array, **kwargs)
    return memory.getvalue()


HUGE = member(np.zeros(4)).replace(b"(4,)", b"(9999999999,)").replace(b" " * 11, b"", 1)


@pytest.mark.parametrize(
    "members",
    [
        {},
        {"json.npy": b"not an array"},
        {"json.npy": member(np.frombuffer(b"{}", np.uint8))},
        {"json.npy": member(np.frombuffer(b'{"format": "other/1", "value": {}}', np.uint8))},
        {"json.npy": member(np.frombuffer(b"[" * 100_000, np.uint8))},
        {"json.npy": member(np.array([object()]), allow_pickle=True)},
        {"json.npy": HUGE},
    ],
    ids=["empty", "garbage", "no format", "other format", "deep", "pickle", "huge"],
)
def test_a_file_of_something_else_is_refused(tmp_path, members):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as file:
        for name, content in members.items():
            file.writestr(name, content)
    with pytest.raises(InputDataError, match="does not hold the data of a run"):
        ReportData.load(path)


def test_a_truncated_file_is_refused(data, tmp_path):
    data.save(tmp_path / "a.npz")
    content = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputDataError):
        ReportData.load(tmp_path / "a.npz")


def test_more_than_a_report_has_is_refused(data, tmp_path):
    """One array of it is said to be of nearly four gigabytes, which the compressed bytes could be."""
    data.save(tmp_path / "a.npz")
    content = bytearray((tmp_path / "a.npz").read_bytes())
    listed = content.index(b"PK\x01\x02")  # where its table of contents begins
    content[listed + 24 : listed + 28] = b"\xf0\xff\xff\xff"
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(InputDataError, match="more data"):
        ReportData.load(tmp_path / "a.npz")


def test_a_missing_file_is_said_to_be_missing(tmp_path):
    with pytest.raises(InputDataError, match="there is no"):
        ReportData.load(tmp_path / "a.npz")
