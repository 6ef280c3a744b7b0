"""The widget for notebooks shows the tissues and the modulus on the grid of the first image."""

from __future__ import annotations

import gzip
import sys

import nibabel
import numpy as np
import pytest

from palpate.errors import ResourceError
from palpate.export.notebook import notebook_viewer


def test_the_widget_holds_tissues_and_moduli_on_the_image(case_result):
    pytest.importorskip("ipyniivue")
    under, over = notebook_viewer(case_result).volumes
    for volume, expected in ((under, case_result.before.index), (over, None)):
        image = nibabel.Nifti1Image.from_bytes(gzip.decompress(volume.data))
        np.testing.assert_allclose(image.affine, case_result.before.grid.affine, atol=1e-5)
        values = np.asarray(image.dataobj)
        if expected is not None:
            np.testing.assert_array_equal(values, expected)
        else:
            np.testing.assert_allclose(np.unique(values), [0.0, 10.0, 31.2, 58.9], rtol=1e-6)
    assert under.colormap_label.labels == [tissue.name for tissue in case_result.tissues]
    assert (over.cal_min, over.cal_max) == (pytest.approx(5.0), pytest.approx(58.9))


def test_without_its_library_a_sentence_says_what_to_install(case_result, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipyniivue", None)
    with pytest.raises(ResourceError, match=r"pip install 'palpate\[notebook\]'"):
        notebook_viewer(case_result)
