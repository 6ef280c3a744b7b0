"""labels.csv says which number is which tissue, with the colours of the case's own table."""

from __future__ import annotations

from pathlib import Path

from palpate.export.label_table import write_label_table
from palpate.images.label_table import read_label_table
from palpate.images.segmentation import first_labels
from palpate.images.tissue import Role, Tissue

TISSUES = (
    Tissue("prostate", Role.ESTIMATE, (4, 2), colour="#ff8000"),
    Tissue("left hip", Role.RIGID, (0,)),
    Tissue("rest", Role.KNOWN, youngs_modulus_kpa=10.0),
)


def test_the_remaining_tissue_gets_the_smallest_free_number() -> None:
    assert first_labels(TISSUES).tolist() == [2, 0, 1]


def test_the_table_is_read_back_with_names_and_colours(tmp_path: Path) -> None:
    table = read_label_table(write_label_table(tmp_path / "labels.csv", TISSUES))
    assert dict(table) == {0: "left hip", 1: "rest", 2: "prostate"}
    assert table.colours == {2: "#ff8000"}
