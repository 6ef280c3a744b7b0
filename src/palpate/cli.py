"""The command `palpate`."""

from __future__ import annotations

import argparse
import ctypes
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from palpate.errors import EstimationError, PalpateError, ResourceError

# Heavy layers are imported by the sub-command that needs them, so that `palpate --help` answers at once.
if TYPE_CHECKING:
    from palpate.study.case import Case
    from palpate.study.result import CaseResult

__all__ = ["main"]

LOGGER = logging.getLogger("palpate")
LOGGER.addHandler(logging.NullHandler())  # before there is a log file, messages reach the user as sentences only
INTERRUPTED = 130
UNEXPECTED = 1


@dataclass(frozen=True, slots=True)
class _Outcome:
    """What a command has to say: a JSON document, the same for people, and its exit code."""

    document: Mapping[str, Any]
    text: str
    exit_code: int = 0
    complaint: str = ""


@dataclass(frozen=True, slots=True)
class _Console:
    """How a run talks while it works: progress on stderr, unless it was asked to be quiet."""

    quiet: bool
    began: float = field(default_factory=time.monotonic)

    def progress(self, message: str) -> None:
        """Tell what happens now, with the seconds since the start."""
        LOGGER.info(message)
        if not self.quiet:
            print(f"[{time.monotonic() - self.began:6.1f} s] {message}", file=sys.stderr, flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `palpate` with the arguments `argv` (default: those of the process) and return its exit code."""
    arguments = _parser().parse_args(argv)
    try:
        outcome = _run(arguments)
    except PalpateError as error:
        outcome = _failure(type(error).__name__, str(error), error.exit_code)
    except MemoryError:
        advice = "memory is short; make mesh.edge_length_mm larger or the images smaller"
        outcome = _failure("ResourceError", advice, ResourceError.exit_code)
    except KeyboardInterrupt:
        outcome = _failure("Interrupted", "interrupted; files that were already there are as they were", INTERRUPTED)
    except Exception as error:  # a bug: the traceback belongs into the log, not on the terminal
        LOGGER.exception("unexpected error")
        sentence = f"unexpected {type(error).__name__}: {error}. This is a bug; please report it{_log_hint(arguments)}"
        outcome = _failure(type(error).__name__, sentence, UNEXPECTED)
    finally:
        _close_log()
    _speak(outcome, arguments)
    return outcome.exit_code


def _run(arguments: argparse.Namespace) -> _Outcome:
    """Read the case, if the command has one, before anything is written; then work with a log in the output folder."""
    case = _case(arguments) if "case" in arguments else None
    folder: Path = arguments.output
    from palpate.study.outputs import make_folder

    make_folder(folder)
    _open_log(folder / "log.txt")
    LOGGER.info("palpate %s: %s", _version(), " ".join(sys.argv[1:]))
    command: Callable[..., _Outcome] = arguments.command
    with _stdout_kept_free(folder / "log.txt"):
        return command(arguments, case, _Console(arguments.quiet).progress)


def _estimate(arguments: argparse.Namespace, case: Case, progress: Callable[[str], None]) -> _Outcome:
    from palpate.study import run

    try:
        result = run.estimate(case, progress=progress)
    except EstimationError as error:
        return _estimation_failed(case, error, arguments.output)
    return _write_estimate(result, arguments.output, progress)


def _demo(arguments: argparse.Namespace, _: None, progress: Callable[[str], None]) -> _Outcome:
    from palpate.experiments.demo import run_demo

    return _write_estimate(run_demo(arguments.output, progress), arguments.output, progress)


def _mesh(arguments: argparse.Namespace, case: Case, progress: Callable[[str], None]) -> _Outcome:
    from palpate.export.case_files import write_mesh_files
    from palpate.study import run
    from palpate.study.outputs import write_json

    result = run.mesh(case, progress=progress)
    progress("writing the mesh")
    write_mesh_files(result, arguments.output)
    document = result.to_dict()
    write_json(arguments.output / "mesh.json", document)
    summary = result.mesh_summary
    text = (
        f"{summary.nodes} nodes, {summary.tets} tetrahedra, {summary.dofs} unknowns; dihedral angles: smallest"
        f" {summary.min_dihedral_deg:.1f} degrees, 5th percentile {summary.p5_dihedral_deg:.1f}"
    )
    return _Outcome(
        document, f"{text}\n{_warnings(document)}written to {arguments.output}: mesh.vtu, surfaces, mesh.json"
    )


def _simulate(arguments: argparse.Namespace, case: Case, progress: Callable[[str], None]) -> _Outcome:
    from palpate.export.case_files import write_simulation_files
    from palpate.study import run
    from palpate.study.outputs import write_json

    result = run.simulate(case, progress=progress, steps=arguments.steps)
    progress("writing the simulated state")
    write_simulation_files(result, arguments.output)
    document = result.to_dict()
    write_json(arguments.output / "simulation.json", document)
    names = "before.nii.gz, after.nii.gz, mesh.vtu, surfaces, simulation.json" + (
        ", mesh.pvd" if arguments.steps > 1 else ""
    )
    moved = f"the largest displacement is {document['largest_displacement_mm']:.2f} mm"
    return _Outcome(document, f"{moved}\n{_warnings(document)}written to {arguments.output}: {names}")


def _write_estimate(result: CaseResult, folder: Path, progress: Callable[[str], None]) -> _Outcome:
    """Write all outputs of an estimate, result.json last: where it is, the others are whole."""
    from palpate.export.case_files import write_estimate_files
    from palpate.study.outputs import write_json

    progress("writing mesh and stiffness map")
    write_estimate_files(result, folder)
    progress("drawing the report")
    document = result.to_dict()
    document["warnings"] += _write_report(lambda: _case_report(result, folder))
    write_json(folder / "result.json", document)
    converged = document["status"] == "converged"
    files = "result.json, report.html, mesh.vtu, stiffness.nii.gz, log.txt"
    text = f"{_table(document)}\n{_warnings(document)}written to {folder}: {files}"
    complaint = "" if converged else f"{document['status']}: {document['reason']}"
    return _Outcome(document, text, 0 if converged else EstimationError.exit_code, complaint)


def _estimation_failed(case: Case, error: EstimationError, folder: Path) -> _Outcome:
    """A result file that says that there is no result."""
    from palpate.report.case_report import write_failure_report
    from palpate.study.outputs import write_json
    from palpate.study.result import failure_document

    LOGGER.error("%s", error, exc_info=error)
    document = failure_document(case, error)
    document["warnings"] += _write_report(lambda: write_failure_report(case, error, folder))
    write_json(folder / "result.json", document)
    return _Outcome(document, "", error.exit_code, str(error))


def _case_report(result: CaseResult, folder: Path) -> Path:
    from palpate.report.case_report import write_case_report

    return write_case_report(result, folder)


def _write_report(write: Callable[[], Path]) -> list[dict[str, str]]:
    """Warnings on a report that could not be written; a drawing never costs the estimate."""
    try:
        write()
    except Exception as error:
        LOGGER.exception("the report could not be written")
        return [{"code": "report", "message": f"report.html could not be written ({error}); the numbers are unharmed"}]
    return []


def _table(document: Mapping[str, Any]) -> str:
    """The estimates as aligned columns."""
    from palpate.report.rows import number

    rows = [["tissue", "Young's modulus", "95 % interval", "ratio", "verdict", "truth"]]
    for item in document["estimates"]:
        interval, ratio = item["interval95"], number(item["ratio"])
        rows.append(
            [
                item["tissue"],
                number(item["value"]) + (" kPa" if item["value"] is not None else ""),
                f"{number(interval[0])} to {number(interval[1])} kPa" if interval else "–",
                f"{ratio} to {item['relative_to']}" if item["ratio"] is not None else "–",
                item["verdict"],
                number(item["truth"]),
            ]
        )
    if all(row[-1] == "–" for row in rows[1:]):
        rows = [row[:-1] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    note = [document["note"]] if document.get("note") else []
    return "\n".join([*lines, *note])


def _warnings(document: Mapping[str, Any]) -> str:
    return "".join(f"warning: {warning['message']}\n" for warning in document["warnings"])


def _failure(kind: str, message: str, exit_code: int) -> _Outcome:
    LOGGER.error("%s: %s", kind, message)
    document = {"schema": "palpate.error/1", "error": kind, "message": message, "exit_code": exit_code}
    return _Outcome(document, "", exit_code, message)


def _speak(outcome: _Outcome, arguments: argparse.Namespace) -> None:
    """The last words of a run; with --json, the document is all that stdout ever sees."""
    if outcome.complaint:
        print(f"palpate: {_printable(outcome.complaint)}", file=sys.stderr)
    if arguments.json:
        print(json.dumps(outcome.document, indent=1, ensure_ascii=False, allow_nan=False))
    elif outcome.text and not arguments.quiet:
        print(_printable(outcome.text))


def _printable(text: str) -> str:
    """`text` without control characters, which names in files could use to command a terminal."""
    return "".join(letter if letter.isprintable() or letter == "\n" else "?" for letter in text)


def _case(arguments: argparse.Namespace) -> Case:
    from palpate.study.case_file import read_case

    return read_case(arguments.case, arguments.set)


def _open_log(path: Path) -> None:
    """Send what the library logs, and warnings of others, to `path`, after what stands there."""
    try:
        handler = logging.FileHandler(path, encoding="utf-8")
    except OSError as error:
        raise ResourceError(f"cannot write {path}: {error.strerror}; choose another --output folder") from error
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.captureWarnings(capture=True)
    for logger in (LOGGER, logging.getLogger("py.warnings")):
        logger.addHandler(handler)
        logger.propagate = False
    LOGGER.setLevel(logging.INFO)


def _close_log() -> None:
    logging.captureWarnings(capture=False)
    for logger in (LOGGER, logging.getLogger("py.warnings")):
        for handler in [handler for handler in logger.handlers if isinstance(handler, logging.FileHandler)]:
            logger.removeHandler(handler)
            handler.close()
        logger.propagate = True


@contextmanager
def _stdout_kept_free(log: Path) -> Iterator[None]:
    """While a command works, what C libraries print on the process's standard output goes to the log."""
    sys.stdout.flush()
    saved = os.dup(1)
    try:
        with log.open("ab") as file:
            os.dup2(file.fileno(), 1)
            yield
    finally:
        with suppress(OSError, AttributeError, TypeError):  # no C library to ask: nothing of it is buffered either
            ctypes.CDLL(None).fflush(None)
        os.dup2(saved, 1)
        os.close(saved)


def _log_hint(arguments: argparse.Namespace) -> str:
    log = arguments.output / "log.txt"
    return f" with {log}, which holds the details" if log.exists() else ""


def _version() -> str:
    try:
        return metadata.version("palpate")
    except metadata.PackageNotFoundError:
        return "(not installed)"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="palpate",
        description="How stiff each organ is, from segmented images of the same body in two or more states.",
        epilog="Exit codes: 0 done, 2 usage or configuration, 3 input data, 4 geometry or meshing, 5 solver or"
        " estimation, 6 resources, 130 interrupted. For research only; not a medical device.",
    )
    parser.add_argument("--version", action="version", version=f"palpate {_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    demo = _command(commands, "demo", _demo, what="the whole way on the pelvis that Palpate brings along")
    demo.set_defaults(output=Path("palpate-demo"))
    for name, function, what in (
        ("mesh", _mesh, "make the tetrahedra of a case and write them"),
        ("simulate", _simulate, "deform the organs of a case with given moduli and write the later state"),
        ("estimate", _estimate, "find the Young's modulus of each organ of a case"),
    ):
        command = _command(commands, name, function, what=what)
        command.add_argument("case", type=Path, metavar="CASE.TOML", help="the case: images, tissues, roles")
        command.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="KEY.PATH=VALUE",
            help="replace a value of the case; repeatable",
        )
        if name == "simulate":
            command.add_argument("--steps", type=_count, default=1, metavar="N", help="write N steps to animate")
    return parser


def _command(commands: Any, name: str, function: Callable[..., _Outcome], *, what: str) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = commands.add_parser(
        name, help=what, description=what[0].upper() + what[1:] + "."
    )
    command.add_argument(
        "--output", type=Path, default=Path("palpate-output"), metavar="DIR", help="default: %(default)s"
    )
    command.add_argument("--json", action="store_true", help="print one JSON document on stdout, and nothing else")
    command.add_argument("--quiet", action="store_true", help="no progress, no table")
    command.set_defaults(command=function)
    return command


def _count(text: str) -> int:
    value = int(text)
    if not 1 <= value <= 1000:
        raise argparse.ArgumentTypeError(f"{value} is not between 1 and 1000")
    return value
