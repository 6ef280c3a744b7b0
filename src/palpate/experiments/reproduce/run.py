"""One experiment by its name: computed or continued, its JSON and its figure in a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from palpate.errors import ConfigurationError
from palpate.experiments.reproduce.cohort import CohortSettings
from palpate.experiments.reproduce.columns import Progress
from palpate.experiments.reproduce.figure4 import Figure4Settings, figure4
from palpate.experiments.reproduce.figures import draw_figure4, draw_staging, draw_table
from palpate.experiments.reproduce.ledger import Ledger
from palpate.experiments.reproduce.staging import staging
from palpate.experiments.reproduce.table1 import Table1Settings, table1
from palpate.experiments.reproduce.table2 import Table2Settings, table2
from palpate.study.outputs import write_json

__all__ = ["EXPERIMENTS", "Reproduction", "Settings", "reproduce"]

EXPERIMENTS = ("table1", "table2", "figure4", "staging")


@dataclass(frozen=True, slots=True)
class Settings:
    """Those of every experiment; the defaults are what the docs state."""

    table1: Table1Settings = field(default_factory=Table1Settings)
    table2: Table2Settings = field(default_factory=Table2Settings)
    figure4: Figure4Settings = field(default_factory=Figure4Settings)
    staging: CohortSettings = field(default_factory=CohortSettings)


@dataclass(frozen=True, slots=True)
class Reproduction:
    """What an experiment says: its JSON document, the same as rows of cells, and where its figure is."""

    document: dict[str, Any]
    rows: list[list[str]]
    figure: Path


def reproduce(experiment: str, folder: Path, *, progress: Progress, settings: Settings | None = None) -> Reproduction:
    """Compute an experiment of `EXPERIMENTS`, or what is left of it, and write EXPERIMENT.json and EXPERIMENT.svg.

    Finished parts stand in EXPERIMENT.parts.jsonl of `folder` and are not computed again. Raises `ConfigurationError`
    for another name, `PalpateError`s of meshing, solving and writing.
    """
    chosen = settings or Settings()
    makers: dict[str, Callable[[], Reproduction]] = {
        "table1": lambda: _table1(chosen.table1, folder, progress),
        "table2": lambda: _table2(chosen.table2, folder, progress),
        "figure4": lambda: _figure4(chosen.figure4, folder, progress),
        "staging": lambda: _staging(chosen.staging, folder, progress),
    }
    if experiment not in makers:
        raise ConfigurationError(f"the experiment is '{experiment}'; it must be one of {list(EXPERIMENTS)}")
    result = makers[experiment]()
    write_json(folder / f"{experiment}.json", result.document)
    return result


def _ledger(folder: Path, experiment: str, settings: object) -> Ledger:
    """The finished parts under exactly these settings."""
    return Ledger(folder / f"{experiment}.parts.jsonl", sha256(repr(settings).encode()).hexdigest()[:16])


def _table1(settings: Table1Settings, folder: Path, progress: Progress) -> Reproduction:
    table = table1(settings, _ledger(folder, "table1", settings), progress=progress)
    draw_table(table, folder / "table1.svg")
    return Reproduction(table.to_dict(), table.text(), folder / "table1.svg")


def _table2(settings: Table2Settings, folder: Path, progress: Progress) -> Reproduction:
    table = table2(settings, _ledger(folder, "table2", settings), progress=progress)
    draw_table(table, folder / "table2.svg")
    return Reproduction(table.to_dict(), table.text(), folder / "table2.svg")


def _figure4(settings: Figure4Settings, folder: Path, progress: Progress) -> Reproduction:
    result = figure4(settings, _ledger(folder, "figure4", settings), progress=progress)
    draw_figure4(result, folder / "figure4.svg")
    return Reproduction(result.to_dict(), result.text(), folder / "figure4.svg")


def _staging(settings: CohortSettings, folder: Path, progress: Progress) -> Reproduction:
    result = staging(settings, _ledger(folder, "staging", settings), progress=progress)
    draw_staging(result, folder / "staging.svg")
    return Reproduction(result.to_dict(), result.text(), folder / "staging.svg")
