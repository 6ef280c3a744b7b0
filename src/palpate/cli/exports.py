"""The sub-commands that hand a result on: export to another program, view in a browser."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from palpate.cli.console import tell
from palpate.cli.outcome import Outcome, listed
from palpate.errors import ConfigurationError

if TYPE_CHECKING:
    from palpate.study.outputs import OutputFolder


def export(arguments: argparse.Namespace, _: None, outputs: OutputFolder, progress: Callable[[str], None]) -> Outcome:
    """Write what an estimate left for another program."""
    from palpate.export.folder import export_into
    from palpate.export.formats import Options
    from palpate.export.model_file import read_model

    if outputs.same_files([""], [arguments.result]):
        raise ConfigurationError(f"{outputs.path} is the folder of the result itself: choose another --output")
    progress("reading the result")
    model = read_model(arguments.result)
    progress(f"writing for {arguments.format}")
    export_into(outputs, model, arguments.format, Options(arguments.linear, arguments.source))
    document = {"schema": "palpate.export/1", "format": arguments.format, "files": list(outputs.written)}
    return Outcome(document, listed(outputs))


def view(arguments: argparse.Namespace, _: None, outputs: None, progress: Callable[[str], None]) -> Outcome:
    """Show the report in a browser until an interrupt ends it."""
    from palpate.steps.viewing import viewing

    del outputs  # it writes nothing
    found = viewing(arguments.result)
    progress("the report is at the address below, for this machine alone; Ctrl-C ends it")
    tell(found.report, sys.stderr)
    if not arguments.no_browser:
        webbrowser.open(found.report)
    with suppress(KeyboardInterrupt):
        found.serve()
    return Outcome({"schema": "palpate.view/1", "url": found.url, "report": found.report}, "")
