"""The sub-commands whose outcome is a result with its report: estimate, demo, sensitivity, report."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from palpate.cli.outcome import Outcome, columns, estimates_table, listed
from palpate.errors import ConfigurationError, EstimationError
from palpate.progress import Line, Progress
from palpate.steps.warning_lines import warning_lines
from palpate.study.outputs import PAGE, RESULT, RESULT_FILES

if TYPE_CHECKING:
    from palpate.case.case import Case
    from palpate.statement.result import CaseResult
    from palpate.study.outputs import OutputFolder


SENSITIVITY_TARGETS = ("sensitivity.json", "sensitivity.html")
TARGETS = (RESULT, *RESULT_FILES, "case.toml")


def estimate(arguments: argparse.Namespace, case: Case | None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Estimate a case, or images for which a case is written first."""
    from palpate.case.file import read_case
    from palpate.steps import commands
    from palpate.steps.previewing import PREVIEW, write_page
    from palpate.steps.saving import save_failure
    from palpate.study.earlier import refuse_other_case
    from palpate.study.new_case import write_new_case

    if case is not None and arguments.labels is not None:
        raise ConfigurationError("--labels goes with images; a case names its label table itself, as [images] names")
    if case is None and arguments.add:
        raise ConfigurationError("--add goes with a case, whose result it adds images to; give its case.toml first")
    if case is not None and arguments.ct:
        raise ConfigurationError("--ct goes with images; a case names its CTs itself, as [images] intensities_before")
    if case is None:
        new = write_new_case(arguments.inputs, arguments.labels, outputs, cts=arguments.ct)
        for tissue in new.tissues:
            progress(Line(f"{tissue.name}: {tissue.role or '?'}; {tissue.reason}"))
        progress(Line(f"the case is written to {new.path}"))
        case = read_case(new.path, arguments.set)
    refuse_other_case(case, outputs)
    if arguments.preview:
        write_page(case, outputs, progress=progress)
        progress(Line(f"the preview is written to {outputs.path / PREVIEW}"))
    outputs.require(f"mesh_{number}.vtu" for number in range(2, len(case.pairs) + 2))
    try:
        result = commands.estimate(case, add=arguments.add, earlier=outputs.path.parent, progress=progress)
    except EstimationError as error:
        return Outcome(save_failure(case, error, outputs), "", error.exit_code, str(error))
    return _write_estimate(result, outputs, progress)


def demo(_: argparse.Namespace, case: None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Estimate the example that is installed with Palpate: a pelvis with a simulated later state."""
    from palpate.case.file import read_case
    from palpate.demo import DATA as IMAGES
    from palpate.demo import run_demo
    from palpate.study.earlier import refuse_other_case

    del case  # it has its own
    refuse_other_case(read_case(IMAGES / "demo.toml"), outputs)
    return _write_estimate(run_demo(outputs.path, progress), outputs, progress)


def sensitivity(_: argparse.Namespace, case: Case, outputs: OutputFolder, progress: Progress) -> Outcome:
    """How each modulus depends on what it rests on, the largest effect first."""
    from palpate.report.tornado import sensitivity_table
    from palpate.steps.saving import save_sensitivity
    from palpate.study.earlier import refuse_other_result
    from palpate.study.sensitivity import Kept
    from palpate.study.sensitivity import sensitivity as vary

    refuse_other_result(case, outputs.path)
    found = vary(case, kept=Kept(outputs), progress=progress)
    document = save_sensitivity(found, outputs)
    text = f"{columns(sensitivity_table(document))}\n{warning_lines(document)}{listed(outputs)}"
    return Outcome(document, text)


def report(_: argparse.Namespace, case: None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Draw the page of an estimate again from the data that it left in its output folder."""
    from palpate.steps.saving import redraw_page
    from palpate.study.earlier import strange_files

    del case
    progress(Line("drawing the report"))
    result = redraw_page(outputs)
    files = result["files"]
    path = outputs.path / PAGE
    strange = strange_files(outputs.path, files)
    text = "".join(f"warning: {outputs.path / name} is not of the run that result.json tells of\n" for name in strange)
    document = {"schema": "palpate.report/1", "id": result.get("id"), "report": str(path), "strange_files": strange}
    return Outcome(document, f"{text}open {path}")


def _write_estimate(result: CaseResult, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Put all outputs of an estimate in place."""
    from palpate.steps.saving import save_estimate

    document = save_estimate(result, outputs, progress=progress)
    converged = document["status"] == "converged"
    text = f"{estimates_table(document)}\n{warning_lines(document)}{listed(outputs)}"
    complaint = "" if converged else f"{document['status']}: {document['reason']}"
    return Outcome(document, text, 0 if converged else EstimationError.exit_code, complaint)
