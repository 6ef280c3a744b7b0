"""A format is added by registering it, and can take no other's ending."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from children import in_a_child
from palpate.errors import ConfigurationError, InputDataError
from palpate.images.readers import read_label_image
from palpate.images.readers.registry import ImageFormat, StoredImage, format_of, register


def ones(path: Path) -> StoredImage:
    value = np.int16(path.read_text())
    return StoredImage(np.full((2, 3, 4), value), np.diag([-1.0, -1.0, 1.0, 1.0]))


def test_a_registered_format_is_read_without_touching_the_core(tmp_path: Path) -> None:
    (tmp_path / "a.ones").write_text("1")

    def read() -> int:
        register(ImageFormat("Ones", (".ones",), ones))
        image = read_label_image(tmp_path / "a.ones")
        assert image.labels.sum() == 24
        np.testing.assert_allclose(image.grid.affine[:3, 3], [-1.0, -2.0, 0.0])
        return 0

    assert in_a_child(read) == 0  # what is registered there is forgotten with it


def test_no_format_takes_the_ending_of_another() -> None:
    with pytest.raises(ConfigurationError, match="belongs to NIfTI"):
        register(ImageFormat("Ones", (".nii",), ones))


def test_an_unknown_ending_is_refused_with_the_known_ones() -> None:
    assert format_of(Path("a.NII.gz")).name == "NIfTI"
    with pytest.raises(InputDataError, match=r"\.nii\.gz"):
        format_of(Path("a.tiff"))
