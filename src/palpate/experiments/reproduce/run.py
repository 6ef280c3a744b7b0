"""One experiment by its name: computed or continued, its JSON and its figure in a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from palpate.errors import ConfigurationError
from palpate.experiments.reproduce.cohort import CohortSettings
from palpate.experiments.reproduce.figure4 import Figure4Settings, figure4
from palpate.experiments.reproduce.figures import draw_figure4, draw_staging, draw_table
from palpate.experiments.reproduce.jobs import Progress
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


def reproduce(
    experiment: str, folder: Path, *, progress: Progress, settings: Settings | None = None, workers: int = 1
) -> Reproduction:
    """Compute an experiment of `EXPERIMENTS`, or what is left of it, and write EXPERIMENT.json and EXPERIMENT.svg.

    Finished parts stand in EXPERIMENT.parts.jsonl of `folder` and are not computed again. `workers`: processes that
    share the parts; a script that asks for more than one needs the guard `if __name__ == "__main__"`: they import it.
    Raises `ConfigurationError` for another name, `PalpateError`s of meshing, solving and writing.
    """
    chosen, run = settings or Settings(), _Run(experiment, folder, workers, progress)
    makers: dict[str, Callable[[], Reproduction]] = {
        "table1": lambda: _table1(chosen.table1, run),
        "table2": lambda: _table2(chosen.table2, run),
        "figure4": lambda: _figure4(chosen.figure4, run),
        "staging": lambda: _staging(chosen.staging, run),
    }
    if experiment not in makers:
        raise ConfigurationError(f"the experiment is '{experiment}'; it must be one of {list(EXPERIMENTS)}")
    result = makers[experiment]()
    write_json(folder / f"{experiment}.json", result.document)
    return result


@dataclass(frozen=True, slots=True)
class _Run:
    """Where an experiment is written and who computes it."""

    experiment: str
    folder: Path
    workers: int
    progress: Progress

    @property
    def figure(self) -> Path:
        return self.folder / f"{self.experiment}.svg"

    def ledger(self, settings: object) -> Ledger:
        """The finished parts under exactly these settings."""
        path = self.folder / f"{self.experiment}.parts.jsonl"
        return Ledger(path, sha256(repr(settings).encode()).hexdigest()[:16])


def _table1(settings: Table1Settings, run: _Run) -> Reproduction:
    table = table1(settings, run.ledger(settings), progress=run.progress, workers=run.workers)
    draw_table(table, run.figure)
    return Reproduction(table.to_dict(), table.text(), run.figure)


def _table2(settings: Table2Settings, run: _Run) -> Reproduction:
    table = table2(settings, run.ledger(settings), progress=run.progress, workers=run.workers)
    draw_table(table, run.figure)
    return Reproduction(table.to_dict(), table.text(), run.figure)


def _figure4(settings: Figure4Settings, run: _Run) -> Reproduction:
    result = figure4(settings, run.ledger(settings), progress=run.progress, workers=run.workers)
    draw_figure4(result, run.figure)
    return Reproduction(result.to_dict(), result.text(), run.figure)


def _staging(settings: CohortSettings, run: _Run) -> Reproduction:
    result = staging(settings, run.ledger(settings), progress=run.progress, workers=run.workers)
    draw_staging(result, run.figure)
    return Reproduction(result.to_dict(), result.text(), run.figure)
