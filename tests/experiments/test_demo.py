"""The demo's case, which the package ships: it can be read, and obeys the law of its simulated later state."""

from __future__ import annotations

from palpate.case.file import read_case
from palpate.demo import DATA, LAW
from palpate.images.tissue import Role


def test_the_demo_case_can_be_read_and_has_its_images():
    case = read_case(DATA / "demo.toml")
    assert case.mechanics.law == LAW
    assert [t.name for t in case.tissues if t.role is Role.ESTIMATE] == ["prostate", "bladder"]
    assert case.images is not None
    for path in (case.images.before, *case.images.after, case.images.names, case.images.intensities_before):
        assert path.is_file()
