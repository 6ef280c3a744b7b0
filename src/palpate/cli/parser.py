"""The arguments of `palpate` and its sub-commands."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import metadata
from pathlib import Path
from types import FunctionType
from typing import Any, NoReturn

from palpate.case.schema import nearest, shown
from palpate.cli import cohorts, commands, written
from palpate.cli.outcome import Outcome
from palpate.entry_points import brought
from palpate.errors import ConfigurationError
from palpate.export.formats import FORMATS
from palpate.study.outputs import PAGE, RESULT

CASE_HELP = "the case: images, tissues, roles"
EXAMPLES = {
    "demo": ("palpate demo", "palpate demo --output demo --json > demo.json"),
    "init": (
        "palpate init before.nii.gz after.nii.gz --labels names.json --output case",
        "palpate init masks_before/ masks_after/ --output case",
    ),
    "check": (
        "palpate check case/case.toml --html",
        "palpate check case/case.toml --set mesh.edge_length_mm=6 --json",
    ),
    "noise": (
        "palpate noise a.nii.gz b.nii.gz",
        "palpate noise a.nii.gz b.nii.gz --labels names.json --json",
    ),
    "voxelise": (
        "palpate voxelise before/prostate.stl before/bladder.stl --spacing 1 --output before",
        "palpate voxelise after/prostate.stl after/bladder.stl --like before/surfaces.nii.gz --output after",
    ),
    "mesh": ("palpate mesh case/case.toml --output mesh", "palpate mesh case/case.toml --set mesh.edge_length_mm=6"),
    "simulate": (
        "palpate simulate case/case.toml --output later",
        "palpate simulate case/case.toml --set motion.filling_mm=5 --steps 10",
    ),
    "estimate": (
        "palpate estimate case/case.toml --output out",
        "palpate estimate out/case.toml --set mechanics.law=linear --samples 1000 --output linear",
        "palpate estimate case/case.toml --add after_7.nii.gz --output out",
    ),
    "export": (
        "palpate export out --format abaqus --output abaqus",
        "palpate export out --format dicom --source series/ --output dicom",
    ),
    "figures": ("palpate figures out --output figures", "palpate figures out --formats pdf --unit ratio --dpi 600"),
    "report": ("palpate report out", "palpate report out --json"),
    "sensitivity": (
        "palpate sensitivity case/case.toml --output out",
        "palpate sensitivity out/case.toml --set mechanics.law=linear --output linear",
    ),
    "cohort": (
        "palpate cohort cohort.csv --template case.toml --output study",
        "palpate cohort cohort.csv --output study --scheduler tcp://10.0.0.5:8786 --resume",
    ),
    "status": ("palpate status study", "palpate status study --json"),
    "statistics": ("palpate statistics study", "palpate statistics study --json"),
    "view": ("palpate view out", "palpate view out --no-browser"),
}


def version() -> str:
    """The version of Palpate that is installed."""
    try:
        return metadata.version("palpate")
    except metadata.PackageNotFoundError:
        return "(not installed)"


class _PrintCompletion(argparse.Action):
    """Print a shell's completion of `palpate`, and end."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: object, values: Any, option: Any = None) -> None:
        """Print it for the shell `values`."""
        import argcomplete

        del namespace, option
        sys.stdout.write(argcomplete.shellcode(["palpate"], True, values))
        parser.exit()


class _Parser(argparse.ArgumentParser):
    """One that says what was meant by a mistyped command, and what there is where none is given."""

    def error(self, message: str) -> NoReturn:
        """End with the usage and a sentence; exit code 2."""
        if message.endswith("required: COMMAND"):
            self.print_help(sys.stderr)
            self.exit(2, "\npalpate: give a command, `palpate demo` first of all\n")
        mistyped = re.search(r"COMMAND: invalid choice: '(.*)' \(choose from (.*)\)", message, re.DOTALL)
        if mistyped:
            names = re.findall(r"[\w-]+", mistyped[2])
            message = f"there is no command {shown(mistyped[1])}: {nearest(mistyped[1], names)}"
        if message.endswith("required: CASE.TOML"):  # an option took it
            message += "; give it before the options"
        super().error(message)


def make_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    parser = _Parser(
        prog="palpate",
        description="Finds how stiff each organ is, from segmented images of the same body in two or more states.",
        epilog="Exit codes: 0 done, 1 a bug, 2 usage or configuration, 3 input data, 4 geometry or meshing, 5 solver or"
        " estimation, 6 resources, 130 interrupted. For research only; not a medical device.",
    )
    parser.add_argument("--version", action="version", version=f"palpate {version()}")
    parser.add_argument(
        "--print-completion",
        action=_PrintCompletion,
        choices=("bash", "zsh", "fish"),
        help="print a script with which the shell completes commands, flags and files; source it when the shell starts",
    )
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    what = "estimate the installed example, a pelvis, from images to report"
    demo = _command(subparsers, "demo", written.demo, what=what, folder="palpate-demo")
    _add_overwrite(demo)
    demo.set_defaults(targets=written.TARGETS)
    _add_preparations(subparsers)
    _add_estimates(subparsers)
    _add_cohort(subparsers)
    try:
        for add in brought("palpate.commands", FunctionType, taken=EXAMPLES).values():
            add(partial(_command, subparsers))
    except ConfigurationError as error:
        parser.error(str(error))
    return parser


def _add_preparations(subparsers: Any) -> None:
    """What makes, checks and tries a case: init, check, noise, voxelise, mesh, simulate."""
    what = "write a case.toml for images, with roles guessed from names"
    init = _command(subparsers, "init", commands.init, what=what)
    init.add_argument("images", type=Path, nargs="+", metavar="IMAGE", help="label images: before, then after ...")
    init.add_argument("--labels", type=Path, metavar="TABLE", help="label table: which number is which organ")
    _add_ct(init)
    init.set_defaults(logs=False, targets=("case.toml", "preview.html"))
    what = "list every problem of a case, without an estimate"
    check = _command(subparsers, "check", commands.check, what=what, folder=None)
    check.add_argument("case_file", type=Path, metavar="CASE.TOML", help=CASE_HELP)
    what = "write a page with roles, images, boundary and expected intervals; default: preview.html beside the case"
    check.add_argument("--html", type=Path, nargs="?", const=commands.BESIDE, metavar="FILE", help=what)
    _add_set(check)
    what = (
        "measure how well surfaces are drawn, from two segmentations of one state: [noise] and [discrepancy] for a case"
    )
    noise = _command(subparsers, "noise", commands.noise, what=what, folder=None)
    noise.add_argument("first", type=Path, metavar="A", help="label image")
    noise.add_argument("second", type=Path, metavar="B", help="the same state again: another scan, reader or program")
    noise.add_argument("--labels", type=Path, metavar="TABLE", help="label table: which number is which organ")
    what = "move B onto A first; default: by all surfaces, if the grids differ"
    noise.add_argument("--align", choices=("auto", "surfaces", "none"), default="auto", help=what)
    what = "make a label image from closed surfaces (STL), one file for each organ, whose name it gets"
    voxelise = _command(subparsers, "voxelise", commands.voxelise, what=what)
    voxelise.add_argument("surfaces", type=Path, nargs="+", metavar="SURFACE.STL", help="closed surfaces of one state")
    what = "edge of the voxels, mm; default: %(default)s"
    voxelise.add_argument("--spacing", type=_positive, default=1.0, metavar="MM", help=what)
    what = "margin of the image around the surfaces, mm; default: %(default)s"
    voxelise.add_argument("--margin", type=_positive, default=30.0, metavar="MM", help=what)
    what = "axes of the coordinates, for files that do not state them; default: RAS"
    voxelise.add_argument("--axes", choices=("RAS", "LPS"), help=what)
    what = "length of one unit of the files in mm: 1000 for metres; default: %(default)s"
    voxelise.add_argument("--scale", type=_positive, default=1.0, metavar="MM", help=what)
    voxelise.add_argument("--like", type=Path, metavar="IMAGE", help="use the grid of this image, the first state")
    voxelise.set_defaults(targets=commands.SURFACE_TARGETS)
    mesh = _command(subparsers, "mesh", commands.mesh, what="make the tetrahedral mesh of a case and write it")
    _add_case(mesh)
    mesh.set_defaults(targets=commands.MESH_TARGETS)
    what = "deform the organs of a case with given moduli, and write the later state"
    simulate = _command(subparsers, "simulate", commands.simulate, what=what)
    _add_case(simulate)
    simulate.add_argument("--steps", type=_count, default=1, metavar="N", help="write N steps to animate")
    simulate.set_defaults(targets=commands.SIMULATION_TARGETS)


def _add_estimates(subparsers: Any) -> None:
    """What finds moduli and hands them on: estimate, sensitivity, report, export, figures, view."""
    what = "find the Young's modulus of each organ of a case, or of label images before and after"
    estimate = _command(subparsers, "estimate", written.estimate, what=what)
    estimate.add_argument(
        "inputs",
        type=Path,
        nargs="+",
        metavar="INPUT",
        help="CASE.TOML, or label images BEFORE AFTER ...; for images a case is written first",
    )
    estimate.add_argument("--labels", type=Path, metavar="TABLE", help="label table of the images")
    _add_ct(estimate)
    what = "add later images to the finished estimate in --output, at their price alone; writes DIR/added-IMAGE"
    estimate.add_argument("--add", type=Path, nargs="+", default=[], metavar="IMAGE", help=what)
    what = "first write preview.html, which shows what will be estimated; the mesh is then made twice"
    estimate.add_argument("--preview", action="store_true", help=what)
    _add_overwrite(estimate)
    estimate.set_defaults(targets=written.TARGETS)
    _add_set(estimate)
    what = "draw N samples of the posterior of the moduli, as posterior.nc (extra `samples`)"
    estimate.add_argument("--samples", type=_samples, action="append", dest="set", default=[], metavar="N", help=what)
    what = "estimate a case, then again under changed assumptions; an interrupted run continues"
    sensitivity = _command(subparsers, "sensitivity", written.sensitivity, what=what)
    _add_case(sensitivity)
    sensitivity.set_defaults(targets=written.SENSITIVITY_TARGETS)
    what = "write report.html of an estimate again"
    report = _command(subparsers, "report", written.report, what=what, folder=None)
    report.add_argument("output", type=Path, metavar="DIR", help="the output folder of an estimate")
    report.set_defaults(makes_folder=False, targets=(RESULT, PAGE))
    what = "write an estimate for another program: simulators, viewers, hospital systems"
    export = _command(subparsers, "export", commands.export, what=what, folder="palpate-export")
    export.add_argument("result", type=Path, metavar="DIR", help="the output folder of an estimate")
    formats = "; ".join(f"{name}: {form.description}" for name, form in FORMATS.items())
    export.add_argument("--format", required=True, choices=tuple(FORMATS), help=formats)
    export.add_argument("--linear", action="store_true", help="tetrahedra with four nodes instead of ten")
    export.add_argument("--source", type=Path, metavar="SERIES", help="dicom: the first image's DICOM series")
    export.set_defaults(logs=False)  # which would hold the command with its paths
    what = "write the figures of an estimate for a paper or a talk, with captions"
    figures = _command(subparsers, "figures", commands.figures, what=what, folder="palpate-figures")
    figures.add_argument("result", type=Path, metavar="DIR", help="the output folder of an estimate")
    what = "file formats, separated by commas; the animation is always a GIF; default: %(default)s"
    figures.add_argument("--formats", default="svg,pdf,png", metavar="LIST", help=what)
    what = "unit of the moduli; default: both, where both are known"
    figures.add_argument("--unit", choices=("ratio", "kPa"), help=what)
    what = "dots an inch of PNG, and of pictures inside SVG and PDF; default: %(default)s"
    figures.add_argument("--dpi", type=_dots, default=300, metavar="N", help=what)
    figures.set_defaults(logs=False)
    what = "show the report of an estimate and its files in a browser, on this machine only"
    view = _command(subparsers, "view", commands.view, what=what, folder=None)
    view.add_argument("result", type=Path, metavar="DIR", help="the output folder of an estimate")
    view.add_argument("--no-browser", action="store_true", help="only print the address")


def _add_cohort(subparsers: Any) -> None:
    what = "estimate many cases, and test how their moduli depend on the stage"
    command = _command(subparsers, "cohort", cohorts.cohort, what=what, folder="palpate-cohort")
    command.add_argument(
        "table",
        type=Path,
        metavar="COHORT",
        help="CSV file: id, patient, session, stage, and case or before and after; or a folder of BIDS derivatives",
    )
    command.add_argument("--template", type=Path, metavar="CASE.TOML", help="the case file that is used for all images")
    what = "processes of this machine, which take a row at a time each; default: one for each processor"
    command.add_argument("--workers", type=_count, metavar="N", help=what)
    what = "address of a running Dask scheduler, whose workers are used instead"
    command.add_argument("--scheduler", metavar="ADDRESS", help=what)
    what = "only every N-th row from the K-th; runs of other shards may work in the same output folder at the same time"
    command.add_argument("--shard", type=_shard, metavar="K/N", help=what)
    command.add_argument("--resume", action="store_true", help="continue the cohort in the output folder")
    command.add_argument("--only-failed", action="store_true", help="in that cohort, compute the failed rows again")
    what = "compute all rows again; the output folder may have this or another cohort already"
    command.add_argument("--overwrite", action="store_true", help=what)
    what = "for each row; default: its worker's share of the memory"
    command.add_argument("--memory-limit", type=_positive, metavar="GB", help=what)
    what = "for each row, seconds; default: a day"
    command.add_argument("--time-limit", type=_positive, default=86400.0, metavar="S", help=what)
    command.add_argument(
        "--reference", metavar="SESSION", help="reference state in BIDS derivatives; default: each patient's first"
    )
    command.set_defaults(targets=cohorts.TARGETS, patience_s=300.0)
    _add_set(command)
    what = "count the rows of a cohort that are done, failed and waiting"
    status = _command(subparsers, "status", cohorts.status, what=what, folder=None)
    status.add_argument("folder", type=Path, metavar="DIR", help="the output folder of a cohort")
    what = "compute the statistics of a cohort again, and write its page"
    statistics = _command(subparsers, "statistics", cohorts.statistics, what=what, folder=None)
    statistics.add_argument("output", type=Path, metavar="DIR", help="the output folder of a cohort")
    statistics.set_defaults(makes_folder=False, targets=cohorts.TARGETS)


def _add_ct(command: argparse.ArgumentParser) -> None:
    what = "CT of before, or of each image: for the report, and to find the air in label 0"
    command.add_argument("--ct", type=Path, nargs="+", default=[], metavar="CT", help=what)


def _add_overwrite(command: argparse.ArgumentParser) -> None:
    what = "replace the result of another case in the output folder"
    command.add_argument("--overwrite", action="store_true", help=what)


def _add_case(command: argparse.ArgumentParser) -> None:
    command.add_argument("case", type=Path, metavar="CASE.TOML", help=CASE_HELP)
    _add_set(command)


def _add_set(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--set", action="append", default=[], metavar="KEY.PATH=VALUE", help="replace a value of the case; repeatable"
    )


def _command(
    subparsers: Any,
    name: str,
    function: Callable[..., Outcome],
    *,
    what: str,
    folder: str | None = "palpate-output",
    examples: Sequence[str] = (),
) -> argparse.ArgumentParser:
    """A sub-command with the common flags; `folder`: where it writes by default, with a log; None: nowhere.

    examples: of `EXAMPLES` where none are given.
    """
    command: argparse.ArgumentParser = subparsers.add_parser(
        name,
        help=what,
        description=what[0].upper() + what[1:] + ".",
        epilog="\n  ".join(("examples:", *(examples or EXAMPLES[name]))),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(command=function, logs=folder is not None, output=None, makes_folder=True, targets=())
    if folder is not None:
        command.add_argument("--output", type=Path, default=Path(folder), metavar="DIR", help="default: %(default)s")
    command.add_argument("--json", action="store_true", help="print one JSON document on stdout, and nothing else")
    command.add_argument("--quiet", action="store_true", help="no progress, no table")
    command.add_argument("--verbose", action="store_true", help="also print the details of the computation")
    return command


def _samples(text: str) -> str:
    """The value of the case that it replaces, as --set has it; which numbers it may be is the case's to say."""
    if not re.fullmatch(r"[0-9]{1,9}", text):
        raise argparse.ArgumentTypeError(f"{text[:20]!r} is no whole number")
    return f"estimate.samples={text}"


def _count(text: str) -> int:
    if not re.fullmatch(r"[0-9]{1,4}", text) or not 1 <= int(text) <= 1000:
        raise argparse.ArgumentTypeError(f"{text[:20]!r} is no whole number from 1 to 1000")
    return int(text)


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"{text[:20]!r} is no shard: write K/N, such as 1/4 to 4/4")
    return int(match[1]), int(match[2])


def _dots(text: str) -> int:
    if not re.fullmatch(r"[0-9]{1,4}", text):
        raise argparse.ArgumentTypeError(f"{text[:20]!r} is no whole number of dots an inch")
    return int(text)


def _positive(text: str) -> float:
    if not re.fullmatch(r"[0-9]{1,9}(\.[0-9]{1,6})?", text) or not float(text) > 0.0:
        raise argparse.ArgumentTypeError(f"{text[:20]!r} is no positive number")
    return float(text)
