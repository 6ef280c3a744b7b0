"""Outputs appear whole or not at all."""

from __future__ import annotations

import pytest

from palpate.errors import ResourceError
from palpate.study.outputs import make_folder, whole_file, write_json, write_text


def test_a_file_that_fails_half_way_leaves_the_earlier_one(tmp_path):
    path = tmp_path / "result.json"
    write_text(path, "earlier")

    def fail():
        with whole_file(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "earlier"
    assert [item.name for item in tmp_path.iterdir()] == ["result.json"]


def test_a_full_disk_is_a_resource_error(tmp_path):
    def fill():
        with whole_file(tmp_path / "mesh.vtu"):
            raise OSError(28, "No space left on device")

    with pytest.raises(ResourceError, match=r"mesh\.vtu: No space left on device; free some space"):
        fill()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_a_resource_error(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ResourceError, match="choose another --output"):
        make_folder(tmp_path / "file" / "below")


def test_json_refuses_what_is_not_json(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "x.json", {"value": float("nan")})
    assert list(tmp_path.iterdir()) == []
