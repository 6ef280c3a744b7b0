"""The sub-commands `palpate verify` and `palpate reproduce`, which Palpate finds by their entry points."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from palpate.cli.outcome import Outcome, columns
from palpate.errors import EstimationError

if TYPE_CHECKING:
    from palpate.study import OutputFolder

__all__ = ["add_reproduce", "add_verify"]

Progress = Callable[[str], None]

PROCESSES = 2  # each holds a mesh in memory


def add_reproduce(command: Callable[..., argparse.ArgumentParser]) -> None:
    """The sub-command reproduce; `command`: see `palpate.cli.parser`."""
    parser = command(
        "reproduce",
        reproduce,
        what="repeat one of the paper's experiments beside its numbers; an interrupted run continues",
        folder="palpate-reproduce",
        examples=("palpate reproduce table1", "palpate reproduce figure4 --output figure4"),
    )
    parser.add_argument("experiment", choices=("table1", "table2", "figure4", "staging"))


def add_verify(command: Callable[..., argparse.ArgumentParser]) -> None:
    """The sub-command verify; `command`: see `palpate.cli.parser`."""
    parser = command(
        "verify",
        verify,
        what="compute problems with known answers and compare the results",
        folder="palpate-verification",
        examples=("palpate verify --quick", "palpate verify --output verification"),
    )
    parser.add_argument("--quick", action="store_true", help="leave out the slow problems")


def reproduce(arguments: argparse.Namespace, _: Any, outputs: OutputFolder, progress: Progress) -> Outcome:
    """One of the paper's experiments, our numbers beside its own."""
    from palpate.parallel import processors
    from palpate_validation.reproduce import reproduce as run

    name = arguments.experiment
    found = run(name, outputs.path, progress=progress, workers=min(processors(), PROCESSES))
    document = found.to_dict()
    notes = "\n".join(document["notes"])
    return Outcome(document, f"{columns(found.text())}\n{notes}\nwritten to {outputs.path}: {name}.json, {name}.svg")


def verify(arguments: argparse.Namespace, _: Any, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Compute the problems with known answers and compare the results with them; exit code 5 when one is missed."""
    from palpate_validation.verify import PROBLEMS, verification

    problems = [problem for problem in PROBLEMS if problem.quick or not arguments.quick]
    found = verification(problems).written(outputs.path, progress=progress)
    document = found.to_dict()
    text = f"{columns(found.text())}\n{document['passed']} checks passed, {document['failed']} failed\n"
    files = "verification.json, verification.md"
    complaint = f"outside of their tolerance: {', '.join(found.failed)}" if found.failed else ""
    code = EstimationError.exit_code if found.failed else 0
    return Outcome(document, f"{text}written to {outputs.path}: {files}", code, complaint)
