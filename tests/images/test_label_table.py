"""Label tables: three ways to write one table, and a sentence for each that is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.errors import InputDataError
from palpate.images.label_table import read_label_table


@pytest.mark.parametrize(
    "text",
    [
        '{"labels": {"2": "bladder", "1": "prostate"}, "volumes_mL": {"prostate": 14.8}}',
        '{"1": "prostate", "2": "bladder"}',
        '{"bladder": 2, "prostate": 1}',
        '\ufeff{"1": " prostate ", "2": "bladder"}',
    ],
)
def test_every_spelling_gives_the_same_table(tmp_path: Path, text: str) -> None:
    path = tmp_path / "labels.json"
    path.write_text(text, encoding="utf-8")
    assert list(read_label_table(path).items()) == [(1, "prostate"), (2, "bladder")]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "not JSON"),
        (b"{", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[1, 2]", "names no label"),
        (b"{}", "names no label"),
        (b'{"1": "a", "1": "b"}', "twice"),
        (b'{"1": "a", "2": "a"}', "twice"),
        (b'{"-1": "a"}', "from 0"),
        (b'{"70000": "a"}', "from 0"),
        (b'{"a": "b"}', "from 0"),
        (b'{"1": ""}', "characters"),
        (b'{"1": {"name": "a"}}', "characters"),
        (b'{"1": "a\\u001b[31m"}', "control characters"),
        (b'{"1": "\xff"}', "UTF-8"),
        (b" " * (2**20 + 1), "larger than"),
    ],
)
def test_a_bad_table_is_refused_with_its_reason(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "labels.json"
    path.write_bytes(content)
    with pytest.raises(InputDataError, match=words):
        read_label_table(path)


def test_a_missing_table_or_an_unknown_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="cannot be read"):
        read_label_table(tmp_path / "labels.json")
    with pytest.raises(InputDataError, match=r"\.json"):
        read_label_table(tmp_path / "labels.doc")
