"""From the arguments of the process to its exit code."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.cli.console import LOGGER, Console, close_log, interruptible, output_folder
from palpate.cli.outcome import Outcome, printable_lines
from palpate.cli.parser import make_parser, version
from palpate.errors import PalpateError, ResourceError

# Heavy layers are imported by the sub-command that needs them, so that `palpate --help` answers at once.
if TYPE_CHECKING:
    from palpate.study.case import Case

__all__ = ["main"]

INTERRUPTED = 130
UNEXPECTED = 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run `palpate` with the arguments `argv` (default: those of the process) and return its exit code."""
    arguments = make_parser().parse_args(argv)
    try:
        with interruptible():
            outcome = _run(arguments)
    except PalpateError as error:
        outcome = _failure(type(error).__name__, str(error), error.exit_code)
    except MemoryError:
        advice = "memory is short; make mesh.edge_length_mm larger or the images smaller"
        outcome = _failure("ResourceError", advice, ResourceError.exit_code)
    except KeyboardInterrupt:
        sentence = "interrupted; files that were already there are as they were; the same command starts anew"
        outcome = _failure("Interrupted", sentence, INTERRUPTED)
    except Exception as error:  # a bug: the traceback belongs into the log, not on the terminal
        LOGGER.exception("unexpected error")
        sentence = f"unexpected {type(error).__name__}: {error}. This is a bug; please report it{_log_hint(arguments)}"
        outcome = _failure(type(error).__name__, sentence, UNEXPECTED)
    finally:
        close_log()
    _speak(outcome, arguments)
    return outcome.exit_code


def _run(arguments: argparse.Namespace) -> Outcome:
    """Read the case, if the command has one, before anything is written; then work, with a log if it writes."""
    case = _case(arguments)
    progress = Console(arguments.quiet).progress
    if not arguments.logs:
        return _outcome(arguments, case, progress)
    with output_folder(arguments.output, f"palpate {version()}: {' '.join(sys.argv[1:])}"):
        return _outcome(arguments, case, progress)


def _outcome(arguments: argparse.Namespace, case: Case | None, progress: Callable[[str], None]) -> Outcome:
    command: Callable[..., Outcome] = arguments.command
    return command(arguments, case, progress)


def _case(arguments: argparse.Namespace) -> Case | None:
    """The case that a command begins with; None where it has none, or images instead."""
    from palpate.study.case_file import read_case

    images = len(getattr(arguments, "inputs", ())) > 1
    path: Path | None = None if images else getattr(arguments, "inputs", [getattr(arguments, "case", None)])[0]
    return None if path is None else read_case(path, arguments.set)


def _failure(kind: str, message: str, exit_code: int) -> Outcome:
    LOGGER.error("%s: %s", kind, message)
    document = {"schema": "palpate.error/1", "error": kind, "message": message, "exit_code": exit_code}
    return Outcome(document, "", exit_code, message)


def _speak(outcome: Outcome, arguments: argparse.Namespace) -> None:
    """The last words of a run; with --json, the document is all that stdout ever sees."""
    if outcome.complaint:
        print(f"palpate: {printable_lines(outcome.complaint)}", file=sys.stderr)
    if arguments.json:
        text = json.dumps(outcome.document, indent=1, ensure_ascii=False, allow_nan=False)
        print(text.encode("utf-8", errors="replace").decode("utf-8"))
    elif outcome.text and not arguments.quiet:
        print(printable_lines(outcome.text))


def _log_hint(arguments: argparse.Namespace) -> str:
    log = arguments.output / "log.txt" if arguments.logs else None
    return f" with {log}, which holds the details" if log and log.exists() else ""
