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
    makers: dict[str, Callable[[Ledger, Path], Reproduction]] = {
        "table1": lambda ledger, path: _table1(chosen.table1, ledger, path, progress),
        "table2": lambda ledger, path: _table2(chosen.table2, ledger, path, progress),
        "figure4": lambda ledger, path: _figure4(chosen.figure4, ledger, path, progress),
        "staging": lambda ledger, path: _staging(chosen.staging, ledger, path, progress),
    }
    if experiment not in makers:
        raise ConfigurationError(f"the experiment is '{experiment}'; it must be one of {list(EXPERIMENTS)}")
    ledger = Ledger(folder / f"{experiment}.parts.jsonl", sha256(repr(chosen).encode()).hexdigest()[:16])
    result = makers[experiment](ledger, folder / f"{experiment}.svg")
    write_json(folder / f"{experiment}.json", result.document)
    return result


def _table1(settings: Table1Settings, ledger: Ledger, path: Path, progress: Progress) -> Reproduction:
    table = table1(settings, ledger, progress=progress)
    draw_table(table, path)
    return Reproduction(table.to_dict(), table.text(), path)


def _table2(settings: Table2Settings, ledger: Ledger, path: Path, progress: Progress) -> Reproduction:
    table = table2(settings, ledger, progress=progress)
    draw_table(table, path)
    return Reproduction(table.to_dict(), table.text(), path)


def _figure4(settings: Figure4Settings, ledger: Ledger, path: Path, progress: Progress) -> Reproduction:
    result = figure4(settings, ledger, progress=progress)
    draw_figure4(result, path)
    return Reproduction(result.to_dict(), result.text(), path)


def _staging(settings: CohortSettings, ledger: Ledger, path: Path, progress: Progress) -> Reproduction:
    result = staging(settings, ledger, progress=progress)
    draw_staging(result, path)
    return Reproduction(result.to_dict(), result.text(), path)
