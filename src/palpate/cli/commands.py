"""The sub-commands around an estimate: init, check, noise, voxelise, mesh, simulate, export, figures, view."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from palpate.cli.outcome import Outcome, columns, listed
from palpate.progress import Line, Progress
from palpate.steps.streams import tell
from palpate.steps.warning_lines import warning_lines

if TYPE_CHECKING:
    from palpate.case.case import Case
    from palpate.study.outputs import OutputFolder


BESIDE = Path()  # the preview of a case lies beside it, under its usual name
MESH_TARGETS = ("mesh.json", "mesh.vtu", "labels.csv", "labels.nii.gz")
SURFACE_TARGETS = ("surfaces.nii.gz", "labels.json")
SIMULATION_TARGETS = ("simulation.json", "mesh.vtu", "labels.csv", "mesh.pvd", "before.nii.gz", "after.nii.gz")


def init(arguments: argparse.Namespace, _: None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Write a case for images; an earlier case.toml is never replaced."""
    from palpate.steps.previewing import PREVIEW, new_case_with_page

    progress(Line("reading the images"))
    case = new_case_with_page(arguments.images, arguments.labels, outputs, cts=arguments.ct, progress=progress)
    rows = [["tissue", "role", "why"]]
    rows += [[tissue.name, str(tissue.role or "?"), tissue.reason] for tissue in case.tissues]
    questions = "".join(f"question: {question}\n" for question in case.questions)
    page = f"\nopen {outputs.path / PREVIEW}" if PREVIEW in outputs.written else ""
    text = f"{columns(rows)}\n{questions}written to {case.path}: correct it, then: palpate check {case.path}{page}"
    return Outcome(case.to_dict() | {"case": str(case.path)}, text)


def check(arguments: argparse.Namespace, _: None, outputs: None, progress: Progress) -> Outcome:
    """List every problem of a case."""
    from palpate.steps import commands
    from palpate.steps.previewing import PREVIEW

    del outputs  # it has no folder
    page = arguments.html
    if page == BESIDE:
        page = arguments.case_file.with_name(PREVIEW)
    found = commands.check(arguments.case_file, arguments.set, html=page, progress=progress)
    refused = "\n".join(problem.message for problem in found.problems if problem.exit_code)
    complaint = refused if arguments.quiet else ""  # what is refused is said even then, as by any other command
    shown = f"\nopen {page}" if page else ""
    return Outcome(found.to_dict(), f"{found.text()}{shown}", found.exit_code, complaint)


def noise(arguments: argparse.Namespace, _: None, outputs: None, progress: Progress) -> Outcome:
    """Say how well surfaces are drawn, from two segmentations of one state."""
    from palpate.steps import commands

    del outputs  # it writes nothing
    found = commands.noise(
        arguments.first, arguments.second, labels=arguments.labels, align=arguments.align, progress=progress
    )
    rows = [["organ", "sd of one drawing, mm", "correlation length, mm", "second larger by, mm", "95 % interval"]]
    for each in found.organs:
        low, high = each.offset_interval95
        numbers = (f"{each.surface_sd_mm:.3g}", f"{each.correlation_length_mm:.2g}", f"{each.offset_mm:+.2f}")
        rows.append([each.organ, *numbers, f"{low:+.2f} to {high:+.2f}"])
    document = found.to_dict()
    left = f"left out: {', '.join(found.left_out)}\n" if found.left_out else ""
    return Outcome(document, f"{columns(rows)}\n{left}{warning_lines(document)}\n{found.toml}")


def voxelise(arguments: argparse.Namespace, _: None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Make a label image of closed surfaces."""
    from palpate.images.readers import write_label_image
    from palpate.steps import commands
    from palpate.study.outputs import write_json

    found = commands.voxelise(
        *arguments.surfaces,
        spacing_mm=arguments.spacing,
        margin_mm=arguments.margin,
        axes=arguments.axes,
        scale=arguments.scale,
        like=arguments.like,
        progress=progress,
    )
    document = found.to_dict()
    with outputs.new_files() as area:
        write_label_image(area / "surfaces.nii.gz", found.image)
        write_json(area / "labels.json", {"labels": document["labels"]})
    rows = [["label", "organ", "volume of the surface, mL", "of its voxels, mL"]]
    for label, name in found.image.names.items():
        rows.append([str(label), name, *(f"{volume / 1000.0:.4g}" for volume in found.volumes_mm3[name])])
    return Outcome(document, f"{columns(rows)}\n{warning_lines(document)}{listed(outputs)}")


def mesh(_: argparse.Namespace, case: Case, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Make a mesh and write it."""
    from palpate.export.case_files import write_mesh_files
    from palpate.steps.saving import write_document
    from palpate.study.earlier import refuse_other_result
    from palpate.study.run import make_mesh

    refuse_other_result(case, outputs.path)
    result = make_mesh(case, progress=progress)
    progress(Line("writing the mesh"))
    document = result.to_dict()
    with outputs.new_files() as area:
        write_mesh_files(result, area)
        write_document(document, "mesh.json", outputs, area)
    summary = result.mesh_summary
    text = (
        f"{summary.nodes} nodes, {summary.tets} tetrahedra, {summary.dofs} unknowns; dihedral angles: smallest"
        f" {summary.min_dihedral_deg:.1f} degrees, 5th percentile {summary.p5_dihedral_deg:.1f}"
    )
    return Outcome(document, f"{text}\n{warning_lines(document)}{listed(outputs)}")


def simulate(arguments: argparse.Namespace, case: Case, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Simulate a later state and write it."""
    from palpate.export.case_files import write_simulation_files
    from palpate.steps.saving import write_document
    from palpate.study.earlier import refuse_other_result
    from palpate.study.simulate import simulate as simulated

    refuse_other_result(case, outputs.path)
    result = simulated(case, steps=arguments.steps, progress=progress)
    progress(Line("writing the simulated state"))
    document = result.to_dict()
    with outputs.new_files() as area:
        write_simulation_files(result, area)
        write_document(document, "simulation.json", outputs, area)
    moved = f"the largest displacement is {document['largest_displacement_mm']:.2f} mm"
    return Outcome(document, f"{moved}\n{warning_lines(document)}{listed(outputs)}")


def export(arguments: argparse.Namespace, _: None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Write what an estimate left for another program."""
    from palpate.export.folder import export_into
    from palpate.export.formats import Options
    from palpate.export.model_file import read_model

    progress(Line("reading the result"))
    model = read_model(arguments.result)
    progress(Line(f"writing the files for {arguments.format}"))
    export_into(outputs, model, arguments.format, Options(arguments.linear, arguments.source))
    document = {"schema": "palpate.export/1", "format": arguments.format, "files": list(outputs.written)}
    return Outcome(document, listed(outputs))


def figures(arguments: argparse.Namespace, _: None, outputs: OutputFolder, progress: Progress) -> Outcome:
    """Write the figures of an estimate for a paper or a talk."""
    from palpate.steps.figures import figures_into, read_data, refuse_settings

    formats = tuple(dict.fromkeys(arguments.formats.split(",")))
    refuse_settings(formats, arguments.dpi)
    progress(Line("reading the result"))
    data = read_data(arguments.result)
    drawn = figures_into(outputs, data, formats=formats, unit=arguments.unit, dpi=arguments.dpi, progress=progress)
    document = {
        "schema": "palpate.figures/1",
        "figures": [{"name": of.name, "caption": of.caption, "files": list(of.files)} for of in drawn if of.files],
        "missing": [{"name": of.name, "reason": of.missing} for of in drawn if not of.files],
        "files": list(outputs.written),
    }
    missing = "".join(f"not drawn: {of.name}: {of.missing}\n" for of in drawn if not of.files)
    return Outcome(document, f"{missing}{listed(outputs)}")


def view(arguments: argparse.Namespace, _: None, outputs: None, progress: Progress) -> Outcome:
    """Show the report in a browser until an interrupt ends it."""
    from palpate.steps.viewing import viewing

    del outputs  # it writes nothing
    found = viewing(arguments.result)
    progress(Line("the report is at the address below, for this machine alone; Ctrl-C ends it"))
    tell(found.report, sys.stderr)
    if not arguments.no_browser:
        webbrowser.open(found.report)
    with suppress(KeyboardInterrupt):
        found.serve()
    return Outcome({"schema": "palpate.view/1", "url": found.url, "report": found.report}, "")
