"""The sub-command that writes a result for another program: export."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from palpate.cli.outcome import Outcome, listed
from palpate.errors import ConfigurationError

if TYPE_CHECKING:
    from palpate.study.outputs import OutputFolder

__all__ = ["export"]


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
