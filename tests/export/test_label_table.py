"""labels.csv says which number is which tissue, with the colours of the case's own table."""

from __future__ import annotations

from pathlib import Path

from palpate.export.case_files import write_label_table
from palpate.images.label_table import read_label_table
from palpate.images.segmentation import first_labels
from palpate.images.tissue import Role, Tissue, tissue_colours

TISSUES = (
    Tissue("prostate", Role.ESTIMATE, (4, 2), colour="#ff8000"),
    Tissue("left hip", Role.RIGID, (0,)),
    Tissue("rest", Role.KNOWN, youngs_modulus_kpa=10.0),
)


def test_no_meshed_or_rigid_tissue_is_the_background() -> None:
    assert first_labels(TISSUES).tolist() == [2, 1, 3]


def test_air_is_the_background_and_a_second_void_is_not() -> None:
    air, outside = Tissue("air", Role.VOID, (0,)), Tissue("outside", Role.VOID)
    assert first_labels((air, outside)).tolist() == [0, 1]
    assert first_labels((outside, *TISSUES)).tolist() == [0, 2, 1, 3]


def test_the_table_is_read_back_with_a_colour_of_every_tissue_and_no_background(tmp_path: Path) -> None:
    tissues = (*TISSUES, Tissue("air", Role.VOID))
    table = read_label_table(write_label_table(tmp_path / "labels.csv", tissues))
    assert dict(table) == {1: "left hip", 2: "prostate", 3: "rest"}
    assert table.colours == dict(zip([2, 1, 3], tissue_colours(tissues)[:3], strict=True))
    assert table.colours[2] == "#ff8000"
