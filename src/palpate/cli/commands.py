"""The sub-commands around an estimate: init, check, mesh, simulate."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from palpate.cli.outcome import Outcome, columns, warning_lines

if TYPE_CHECKING:
    from palpate.study.case import Case

__all__ = ["check", "init", "mesh", "simulate"]

Progress = Callable[[str], None]


def init(arguments: argparse.Namespace, _: None, progress: Progress) -> Outcome:
    """Write a case for images; an earlier case.toml is never replaced."""
    from palpate.study.new_case import write_new_case

    progress("reading the images")
    path, case = write_new_case(arguments.images, arguments.labels, arguments.output)
    rows = [["tissue", "role", "why"]]
    rows += [[tissue.name, str(tissue.role or "?"), tissue.reason] for tissue in case.tissues]
    questions = "".join(f"question: {question}\n" for question in case.questions)
    text = f"{columns(rows)}\n{questions}written to {path}; read it, correct it, then: palpate check {path}"
    return Outcome(case.to_dict() | {"case": str(path)}, text)


def check(arguments: argparse.Namespace, _: None, progress: Progress) -> Outcome:
    """List every problem of a case."""
    from palpate.study.check import check_case

    found = check_case(arguments.case_file, arguments.set, progress=progress)
    refused = "\n".join(problem.message for problem in found.problems if problem.exit_code)
    complaint = refused if arguments.quiet else ""  # what is refused is said even then, as by any other command
    return Outcome(found.to_dict(), found.text(), found.exit_code, complaint)


def mesh(arguments: argparse.Namespace, case: Case, progress: Progress) -> Outcome:
    """Make a mesh and write it."""
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
    files = "mesh.vtu, surfaces, mesh.json"
    return Outcome(document, f"{text}\n{warning_lines(document)}written to {arguments.output}: {files}")


def simulate(arguments: argparse.Namespace, case: Case, progress: Progress) -> Outcome:
    """Simulate a later state and write it."""
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
    return Outcome(document, f"{moved}\n{warning_lines(document)}written to {arguments.output}: {names}")
