"""One of the paper's experiments by its name: computed or continued, its JSON and its figure in a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from palpate.errors import ConfigurationError
from palpate_validation.paper.figure4 import Figure4Settings, figure4
from palpate_validation.paper.staging import CohortSettings, staging
from palpate_validation.paper.table1 import Table1Settings, table1
from palpate_validation.paper.table2 import Table2Settings, table2
from palpate_validation.scenes import Found, Progress, Scenes

__all__ = ["Settings", "reproduce"]


@dataclass(frozen=True, slots=True)
class Settings:
    """Those of every experiment; the defaults are what the docs state."""

    table1: Table1Settings = field(default_factory=Table1Settings)
    table2: Table2Settings = field(default_factory=Table2Settings)
    figure4: Figure4Settings = field(default_factory=Figure4Settings)
    staging: CohortSettings = field(default_factory=CohortSettings)


def reproduce(
    experiment: str, folder: Path, *, progress: Progress, settings: Settings | None = None, workers: int = 1
) -> Found:
    """Compute table1, table2, figure4 or staging, or what is left of it: see `Scenes.written`.

    Raises `ConfigurationError` for another name.
    """
    chosen = settings or Settings()
    makers: dict[str, Callable[[], Scenes[Any]]] = {
        "table1": lambda: table1(chosen.table1),
        "table2": lambda: table2(chosen.table2),
        "figure4": lambda: figure4(chosen.figure4),
        "staging": lambda: staging(chosen.staging),
    }
    if experiment not in makers:
        raise ConfigurationError(f"the experiment is '{experiment}'; it must be one of {list(makers)}")
    found: Found = makers[experiment]().written(folder, progress=progress, workers=workers)
    return found
