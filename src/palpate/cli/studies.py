"""The sub-commands that compute whole studies: sensitivity of a case, reproduce."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from palpate.cli.outcome import Outcome, columns, listed, warning_lines

if TYPE_CHECKING:
    from palpate.study.case import Case
    from palpate.study.outputs import OutputFolder

__all__ = ["SENSITIVITY_TARGETS", "reproduce", "sensitivity"]

SENSITIVITY_TARGETS = ("sensitivity.json", "sensitivity.html")

PROCESSES = 2  # more would need the memory of as many meshes


def reproduce(
    arguments: argparse.Namespace, _: None, outputs: OutputFolder, progress: Callable[[str], None]
) -> Outcome:
    """One of the paper's experiments, our numbers beside its own."""
    from palpate.experiments.reproduce.run import reproduce as run
    from palpate.parallel import processors

    workers = min(processors(), PROCESSES)
    result = run(arguments.experiment, outputs.path, progress=progress, workers=workers)
    notes = "\n".join(result.document["notes"])
    files = ", ".join((f"{arguments.experiment}.json", result.figure.name))
    return Outcome(result.document, f"{columns(result.rows)}\n{notes}\nwritten to {outputs.path}: {files}")


def sensitivity(
    arguments: argparse.Namespace, case: Case, outputs: OutputFolder, progress: Callable[[str], None]
) -> Outcome:
    """How each modulus depends on what it rests on, the largest effect first."""
    from palpate.report.tornado import sensitivity_table
    from palpate.steps.saving import save_sensitivity
    from palpate.study.sensitivity import Kept
    from palpate.study.sensitivity import sensitivity as vary

    found = vary(case, kept=Kept(outputs), sobol=arguments.sobol, progress=progress)
    document = save_sensitivity(found, outputs)
    text = f"{columns(sensitivity_table(document))}\n{warning_lines(document)}{listed(outputs)}"
    return Outcome(document, text)
