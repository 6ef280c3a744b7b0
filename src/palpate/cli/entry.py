"""From the arguments of the process to its exit code."""

from __future__ import annotations

import argparse
import errno
import json
import os
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.cli.console import close_log, interruptible, log_is_open, output_folder
from palpate.cli.outcome import Outcome, printable_lines
from palpate.cli.parser import make_parser, version
from palpate.errors import ConfigurationError, InputDataError, PalpateError, ResourceError
from palpate.steps.streams import LOGGER, tell
from palpate.study.outputs import OutputFolder, make_folder

# Heavy layers are imported by the sub-command that needs them, so that `palpate --help` answers at once.
if TYPE_CHECKING:
    from palpate.case.case import Case


LARGEST = 2**31 - 1  # of mallopt
KEPT = ((-1, LARGEST), (-3, LARGEST), (-8, 1))  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD in bytes, M_ARENA_MAX; malloc.h
UNEXPECTED = 1
INTERRUPTED = 130  # as a shell has it
UNTOUCHED = "interrupted; no file was changed; give the same command again"
REPLACED = "interrupted after these files were written: {}"
SPEAKING = "interrupted while the outcome was printed; all files are written"


def run(argv: Sequence[str] | None, signals: Sequence[signal.Signals], mask: Iterable[int]) -> int:
    """Run the command of `argv` (None: of the process) and return its exit code.

    signals: those that interrupt it, blocked now; mask: the signals that stay blocked while it works.
    """
    parser = make_parser()
    if argv is None and "_ARGCOMPLETE" in os.environ:  # a shell asks what could stand at the end of the line
        import argcomplete

        argcomplete.autocomplete(parser)
    arguments = parser.parse_args(argv)
    if argv is None:
        keep_freed_memory()
    os.environ["MPLBACKEND"] = "agg"  # no window is opened, and matplotlib does not load under a name it does not know
    written: list[str] = []  # what has taken its place, which a signal cannot undo wherever in the run it comes
    outcome = None
    try:
        with interruptible(signals, mask) as came:
            outcome = _outcome(arguments, came, written)
            return _speak(outcome, arguments)
    except KeyboardInterrupt:
        if outcome is None or outcome.exit_code != INTERRUPTED:
            tell(f"palpate: {_interrupted(written) if outcome is None else SPEAKING}", sys.stderr)
        return INTERRUPTED


def keep_freed_memory() -> bool:
    """Tell the C library to keep freed memory for later arrays; whether it accepts that.

    By default glibc requests every array above 32 MB from the system, which fills it with zeros, and returns it after
    use. This took a fifth of the time on large meshes. One heap for all threads wastes the least memory. Nothing is
    changed where environment variables set up glibc, or where the C library is another one.
    """
    if "GLIBC_TUNABLES" in os.environ or any(name.startswith("MALLOC_") for name in os.environ):
        return False
    with suppress(ImportError, AttributeError, OSError, TypeError):
        import ctypes

        mallopt = ctypes.CDLL(None).mallopt
        return all(mallopt(parameter, value) == 1 for parameter, value in KEPT)
    return False


def _outcome(arguments: argparse.Namespace, came: Sequence[int], written: list[str]) -> Outcome:
    """What the command has to say, errors among it; `came`: the signals so far. Its log is closed."""
    try:
        return _run(arguments, written)
    except (Exception, KeyboardInterrupt) as error:
        if came or isinstance(error, KeyboardInterrupt):
            return _failure("Interrupted", _interrupted(written), INTERRUPTED)
        if isinstance(error, PalpateError):
            return _failure(type(error).__name__, str(error), error.exit_code)
        if isinstance(error, MemoryError):
            advice = "memory is short; make mesh.edge_length_mm larger or the images smaller"
            return _failure("ResourceError", advice, ResourceError.exit_code)
        hint = f" with {arguments.output / 'log.txt'}, which holds the details" if log_is_open() else ""
        LOGGER.error("unexpected error", exc_info=error)  # a bug: the traceback belongs into the log, not on a terminal
        sentence = f"unexpected {type(error).__name__}: {error}. This is a bug; please report it{hint}"
        return _failure(type(error).__name__, sentence, UNEXPECTED)
    finally:
        close_log()


def _interrupted(written: Sequence[str]) -> str:
    return REPLACED.format(", ".join(written)) if written else UNTOUCHED


def _run(arguments: argparse.Namespace, written: list[str]) -> Outcome:
    """Read the case, if the command has one, before anything is written; then work, with a log if it writes.

    `written` gets the names of the files that take their places.
    """
    from palpate.case.file import read_case
    from palpate.images.input_file import similar_names
    from palpate.steps.display import PATIENCE_S, progress_on_stderr

    command: Callable[..., Outcome] = arguments.command
    images = len(getattr(arguments, "inputs", ())) > 1  # in the place of a case
    path: Path | None = None if images else getattr(arguments, "inputs", [getattr(arguments, "case", None)])[0]
    case = None if path is None else read_case(path, arguments.set)
    if arguments.output is None:
        with progress_on_stderr(quiet=arguments.quiet, verbose=arguments.verbose) as progress:
            return command(arguments, case, None, progress)
    if getattr(arguments, "add", ()):
        _into_added_folder(arguments)
    if not arguments.makes_folder and not arguments.output.is_dir():
        advice = similar_names(arguments.output) or "; name the output folder of an earlier run"
        raise InputDataError(f"there is no folder {arguments.output}{advice}")
    heading = f"palpate {version()}: {' '.join(sys.argv[1:])}"
    shared = getattr(arguments, "shard", None) is not None  # with runs of other shards
    outputs = OutputFolder(arguments.output, written, getattr(arguments, "overwrite", False))
    with (
        nullcontext(make_folder(outputs.path)) if shared else output_folder(outputs, heading, logs=arguments.logs),
        progress_on_stderr(
            quiet=arguments.quiet,
            verbose=arguments.verbose,
            patience_s=getattr(arguments, "patience_s", PATIENCE_S),
        ) as progress,
    ):
        outputs.require(arguments.targets)
        _spare_inputs(arguments, case, outputs)
        return command(arguments, case, outputs, progress)


def _into_added_folder(arguments: argparse.Namespace) -> None:
    """Have an estimate of added images write into a folder of its own, in that of the estimate it builds on."""
    from palpate.statement.known_images import added_name
    from palpate.study.outputs import RESULT, read_json

    read_json(arguments.output / RESULT)  # before a folder is made
    arguments.output = arguments.output / added_name(arguments.add)


def _spare_inputs(arguments: argparse.Namespace, case: Case | None, outputs: OutputFolder) -> None:
    """Refuse to write an output in the place of an input."""
    given = () if case is not None and not arguments.set else getattr(arguments, "inputs", ())  # a case stays as it is
    named = (getattr(arguments, name, None) for name in ("labels", "table", "template"))
    inputs: list[Path | None] = [*given, *named, *getattr(arguments, "ct", ()), *getattr(arguments, "add", ())]
    if case is not None and case.images is not None:
        images = case.images
        inputs += [images.before, *images.after, images.names, images.intensities_before, *images.intensities_after]
        inputs += [path for pair in case.pairs for path in (pair.before, *pair.after)]
    for path in (outputs.path / name for name in arguments.targets):
        if _is_one_of(path, inputs):
            raise ConfigurationError(
                f"{path} is an input of this run, and would be replaced by its output of that name: choose another"
                " --output folder"
            )
    writes_images = any(name.endswith((".nii", ".nii.gz")) for name in arguments.targets)
    if writes_images and _is_one_of(outputs.path, inputs):
        raise ConfigurationError(
            f"{outputs.path} is an input of this run, a folder of masks, in which an image would be taken for one more"
            " mask: choose another --output folder"
        )


def _is_one_of(path: Path, files: Sequence[Path | None]) -> bool:
    """Whether a path leads to one of the files, of which some may not exist."""
    for file in files:
        with suppress(OSError, ValueError):
            if file is not None and path.samefile(file):
                return True
    return False


def _failure(kind: str, message: str, exit_code: int) -> Outcome:
    LOGGER.error("%s: %s", kind, message)
    document = {"schema": "palpate.error/1", "error": kind, "message": message, "exit_code": exit_code}
    return Outcome(document, "", exit_code, message)


def _speak(outcome: Outcome, arguments: argparse.Namespace) -> int:
    """The last words of a run, and its exit code; with --json, the document is all that stdout ever sees."""
    if outcome.complaint:
        tell(f"palpate: {printable_lines(outcome.complaint)}", sys.stderr)
    if not arguments.json:
        if outcome.text and not arguments.quiet:
            tell(printable_lines(outcome.text), sys.stdout)
        return outcome.exit_code
    document = json.dumps(outcome.document, indent=1, ensure_ascii=False, allow_nan=False)
    try:
        document.encode(getattr(sys.stdout, "encoding", None) or "utf-8")
    except ValueError:  # letters that the stream lacks are JSON's own escapes
        document = json.dumps(outcome.document, indent=1, ensure_ascii=True, allow_nan=False)
    refused = tell(document, sys.stdout)
    if refused is None or refused.errno == errno.EPIPE:  # a reader that has left wants no more
        return outcome.exit_code
    reason = refused.strerror or str(refused)
    where = f"; all files are written in {arguments.output}" if arguments.output else ""
    tell(f"palpate: the document of --json could not be written to standard output ({reason}){where}", sys.stderr)
    return outcome.exit_code or ResourceError.exit_code
