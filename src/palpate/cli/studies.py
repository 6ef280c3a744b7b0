"""The sub-commands that compute whole experiments: reproduce."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from palpate.cli.outcome import Outcome, columns
from palpate.parallel import processors

if TYPE_CHECKING:
    from palpate.study.outputs import OutputFolder

__all__ = ["reproduce"]

PROCESSES = 2  # more would need the memory of as many meshes


def reproduce(
    arguments: argparse.Namespace, _: None, outputs: OutputFolder, progress: Callable[[str], None]
) -> Outcome:
    """One of the paper's experiments, our numbers beside its own."""
    from palpate.experiments.reproduce.run import reproduce as run

    workers = min(processors(), PROCESSES)
    result = run(arguments.experiment, outputs.path, progress=progress, workers=workers)
    notes = "\n".join(result.document["notes"])
    files = ", ".join((f"{arguments.experiment}.json", result.figure.name))
    return Outcome(result.document, f"{columns(result.rows)}\n{notes}\nwritten to {outputs.path}: {files}")
