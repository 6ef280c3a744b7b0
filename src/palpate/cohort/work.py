"""The work on one row, in a process that may end at any moment: the estimate, its files, its done mark."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from palpate.cohort.plan import held_soon, read_mark, write_mark
from palpate.cohort.resolve import case_of, row_key
from palpate.cohort.task import Outcome, Task, failure_class_of
from palpate.errors import EstimationError, InputDataError, PalpateError
from palpate.images.named_labels import printable
from palpate.processes import peak_memory_gb
from palpate.steps.saving import save_estimate, save_failure
from palpate.study import run
from palpate.study.cost import ExpectedCost
from palpate.study.earlier import refuse_other_case
from palpate.study.edge_length import edge_length_of
from palpate.study.outputs import OutputFolder
from palpate.study.read import read_states

LOGGER = logging.getLogger(__name__)

Tell = Callable[[float, float], None]  # is told the predicted memory (GB) and time (s), before they are taken


class RoomError(Exception):
    """The case needs more memory than it may count on here; nothing was computed. `args[0]`: how much it needs, GB."""


def estimate_row(task: Task, tell: Tell) -> Outcome:
    """Estimate the case of a row into its folder, as `palpate estimate` does, and leave the done mark.

    Whatever goes wrong is an outcome, too; the failure's mark is left to whoever decides on another attempt.
    """
    try:
        return _attempt(task, tell)
    except RoomError as error:
        return replace(Outcome.failed(task, "resources", "", cause="room"), expected_gb=float(error.args[0]))
    except MemoryError:
        LOGGER.exception("memory is short")
        return Outcome.failed(task, "resources", "memory was short for this case", cause="memory")
    except PalpateError as error:
        LOGGER.error("%s: %s", type(error).__name__, error)
        return Outcome.failed(task, failure_class_of(error), printable(str(error)))
    except Exception as error:
        LOGGER.exception("unexpected error")
        sentence = printable(
            f"unexpected {type(error).__name__}: {error}. This is a bug; please report it with log.txt"
        )
        return Outcome.failed(task, "crash", sentence)


def _attempt(task: Task, tell: Tell) -> Outcome:
    folder = Path(task.folder)
    case = case_of(task.row, task.overrides)
    key = row_key(task.row, task.overrides)
    outputs, expected = OutputFolder(folder, overwrite=True), list[float]()  # the cohort owns the folder

    def condition(cost: ExpectedCost) -> None:
        """Say what the estimate will take, and leave it when that is not there."""
        if task.room_gb is not None and cost.memory_gb > task.room_gb:
            raise RoomError(cost.memory_gb)
        expected.append(cost.memory_gb)
        tell(cost.memory_gb, cost.seconds)

    with held_soon(folder):
        earlier = read_mark(folder)
        if earlier is not None and earlier.key == key and earlier.state == "done":
            return earlier  # somebody else was quicker
        refuse_other_case(case, outputs)
        if task.coarser > 1.0:  # which the result tells as an override
            edge = case.mesh.edge_length_mm
            if edge is None:  # the images choose it
                states = read_states(case)
                edge = edge_length_of(case, states.before, states.after).mm
            edge = round(edge * task.coarser, 3)
            overrides = (*case.overrides, f"mesh.edge_length_mm={edge}")
            case = replace(case, mesh=replace(case.mesh, edge_length_mm=edge), overrides=overrides)
        began = time.monotonic()
        try:
            result = run.estimate(case, progress=LOGGER.info, condition=condition)
        except EstimationError as error:
            save_failure(case, error, outputs)
            raise
        document = save_estimate(result, outputs, progress=LOGGER.info)
        if row_key(task.row, task.overrides) != key:
            raise InputDataError("an input was changed while it was used; run the cohort again, with --resume")
        if document["status"] != "converged":
            return Outcome.failed(task, "solver", f"{document['status']}: {printable(document['reason'])}")
        outcome = Outcome(task.row.id, "done", key, message="; ".join(task.remarks), attempts=task.attempt)
        took = outcome.took(
            time.monotonic() - began, expected_gb=expected[0] if expected else None, peak_gb=peak_memory_gb()
        )
        return write_mark(folder, took)
