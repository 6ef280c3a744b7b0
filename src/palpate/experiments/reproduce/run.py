"""One experiment by its name: computed or continued, its JSON and its figure in a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, Protocol, TypeVar

from palpate.errors import ConfigurationError
from palpate.experiments.reproduce.cohort import CohortSettings
from palpate.experiments.reproduce.figure4 import Figure4Settings, figure4
from palpate.experiments.reproduce.figures import draw_figure4, draw_staging, draw_table
from palpate.experiments.reproduce.jobs import Progress
from palpate.experiments.reproduce.ledger import Ledger
from palpate.experiments.reproduce.staging import staging
from palpate.experiments.reproduce.table1 import Table1Settings, table1
from palpate.experiments.reproduce.table2 import Table2Settings, table2
from palpate.study import staged, write_json

__all__ = ["EXPERIMENTS", "Reproduction", "Settings", "reproduce"]

ResultT = TypeVar("ResultT", bound="_Result")
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
        "table1": lambda: _reproduced(table1, draw_table, chosen.table1, run),
        "table2": lambda: _reproduced(table2, draw_table, chosen.table2, run),
        "figure4": lambda: _reproduced(figure4, draw_figure4, chosen.figure4, run),
        "staging": lambda: _reproduced(staging, draw_staging, chosen.staging, run),
    }
    if experiment not in makers:
        raise ConfigurationError(f"the experiment is '{experiment}'; it must be one of {list(EXPERIMENTS)}")
    result = makers[experiment]()
    with staged(folder) as new:
        write_json(new.area / f"{experiment}.json", result.document)
        new.commit()
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
        """The picture's file."""
        return self.folder / f"{self.experiment}.svg"

    def ledger(self, settings: object) -> Ledger:
        """The finished parts under exactly these settings."""
        path = self.folder / f"{self.experiment}.parts.jsonl"
        return Ledger(path, sha256(repr(settings).encode()).hexdigest()[:16])


class _Result(Protocol):
    """What every experiment gives."""

    def to_dict(self) -> dict[str, Any]:
        """What `--json` prints."""
        ...

    def text(self) -> list[list[str]]:
        """The rows of the printed table, its heads first."""
        ...


def _reproduced(
    experiment: Callable[..., ResultT], draw: Callable[[ResultT, Path], None], settings: object, run: _Run
) -> Reproduction:
    result = experiment(settings, run.ledger(settings), progress=run.progress, workers=run.workers)
    draw(result, run.figure)
    return Reproduction(result.to_dict(), result.text(), run.figure)
