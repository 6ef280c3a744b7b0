"""Small pictures: the reports' tests look at what is drawn, not at how finely."""

from __future__ import annotations

import pytest

from palpate.report import pictures


@pytest.fixture(autouse=True, scope="session")
def small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "WIDTH", 124)
        patch.setattr(pictures, "HEIGHT", 92)
        yield
