"""The steps of the commands: a new case, its check, an estimate, what its images and their noise tell."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path

from palpate.body.surface_labels import SurfaceLabels, surface_labels
from palpate.case.case import Case
from palpate.errors import ConfigurationError, InputDataError
from palpate.images.label_table import read_label_table
from palpate.images.readers import read_label_image
from palpate.progress import Line, Wanted
from palpate.statement.result import SCHEMA, MeshResult, Simulation
from palpate.steps.adding import estimate_added
from palpate.steps.display import shown_in_python
from palpate.steps.previewing import checked_with_page, new_case_with_page, place_page, refuse_other_page
from palpate.steps.results import CaseResult, SavedResult
from palpate.steps.saving import save_sensitivity
from palpate.study import run
from palpate.study.check import CheckReport, check_case
from palpate.study.earlier import refuse_other_result
from palpate.study.new_case import NewCase
from palpate.study.null_pair import NullPair, noise_of_drawings
from palpate.study.outputs import RESULT, OutputFolder, read_json
from palpate.study.sensitivity import Kept, Sensitivity
from palpate.study.sensitivity import sensitivity as vary
from palpate.study.simulate import simulate as simulated

PathLike = str | os.PathLike[str]


def init(
    before: PathLike,
    *after: PathLike,
    labels: PathLike | None = None,
    ct: Sequence[PathLike] = (),
    output: PathLike = "palpate-output",
) -> NewCase:
    """Write a case.toml for label images into the folder `output`, roles guessed from names, as `palpate init` does.

    labels: a label table; ct: the CT of `before`, or of each state in turn, which also tells air from tissue in label
    0. The case that is given says where it lies (`path`), who is taken for what and why (`tissues`), and what nobody
    can guess (`questions`). Beside it preview.html shows how the images were read, where that can be shown. Raises
    `InputDataError` for images that cannot be used, `ConfigurationError` where another case.toml is in the way,
    `ResourceError` where nothing can be written.
    """
    outputs = OutputFolder(Path(output))
    with outputs.held():
        table = None if labels is None else Path(labels)
        images = [Path(path) for path in (before, *after)]
        return new_case_with_page(images, table, outputs, cts=[Path(path) for path in ct])


def check(
    case: Case | PathLike, overrides: Sequence[str] = (), *, html: PathLike | None = None, progress: Wanted = "auto"
) -> CheckReport:
    """Every problem of a case or its file at once, its organs and what an estimate costs, as `palpate check` tells.

    overrides: of a file, as for `read_case`; html: where a page is to be written that shows the case, its images and
    the intervals that may be expected (then they are in the report, too); progress: as in `estimate`.
    Raises nothing for a bad case, which is a problem of the report; `ConfigurationError` for overrides of a case
    that is read, and where `html` is a file that is no preview of ours, `ResourceError` where it cannot be written.
    """
    if isinstance(case, Case) and overrides:
        raise ConfigurationError("overrides are for a case file: palpate.read_case(file, overrides) reads it so")
    source = case if isinstance(case, Case) else Path(case)
    with shown_in_python(progress) as tell:
        if html is None:
            return check_case(source, overrides, progress=tell)
        refuse_other_page(Path(html))
        report, page = checked_with_page(source, overrides, progress=tell)
        place_page(page, Path(html))
    return report


def read_result(folder: PathLike) -> SavedResult:
    """What an estimate left in its output folder: numbers, verdicts and warnings, as `palpate.estimate` gave them.

    Raises `InputDataError` where there is no result.json of an estimate.
    """
    path = Path(folder)
    document = read_json(path / RESULT)
    if document.get("schema") != SCHEMA:
        raise InputDataError(f"{path / RESULT} is no result of an estimate (its schema is {document.get('schema')!r})")
    return SavedResult(document, path)


def noise(
    first: PathLike,
    second: PathLike,
    *,
    labels: PathLike | None = None,
    align: str = "auto",
    progress: Wanted = "auto",
) -> NullPair:
    """How well surfaces are drawn, from two segmentations of one state, as `palpate noise` tells.

    labels: a label table; align: "surfaces", "none", or "auto": on the surfaces where the grids differ. `toml` of what
    is given are the blocks [noise] and [discrepancy] of a case. Raises `InputDataError` for images that cannot be used,
    are the same, or cannot be of one state.
    """
    table = None if labels is None else read_label_table(Path(labels))
    with shown_in_python(progress) as tell:
        tell(Line("reading the images"))
        return noise_of_drawings(*(read_label_image(Path(path), names=table) for path in (first, second)), align=align)


def voxelise(
    *surfaces: PathLike,
    spacing_mm: float = 1.0,
    margin_mm: float = 30.0,
    axes: str | None = None,
    scale: float = 1.0,
    like: PathLike | None = None,
    progress: Wanted = "auto",
) -> SurfaceLabels:
    """The label image of closed surfaces (STL), one an organ, as `palpate voxelise` writes it.

    spacing_mm, margin_mm: of the grid that is made; like: an image whose grid is taken; axes: "RAS" or "LPS", of files
    that do not say; scale: mm of their unit. Raises `InputDataError` for surfaces that cannot be read, are not closed
    or hold no voxel.
    """
    grid = None if like is None else read_label_image(Path(like)).grid
    paths = [Path(path) for path in surfaces]
    with shown_in_python(progress) as tell:
        return surface_labels(
            paths, spacing_mm=spacing_mm, margin_mm=margin_mm, axes=axes, scale=scale, like=grid, progress=tell
        )


def estimate(
    case: Case,
    *,
    samples: int | None = None,
    truth: Mapping[str, float] | None = None,
    add: Sequence[PathLike] = (),
    earlier: PathLike = "palpate-output",
    progress: Wanted = "auto",
) -> CaseResult:
    """The Young's modulus of every `estimate` tissue of a case, with its interval and its verdict.

    samples: draws of the moduli's posterior, 100 to 100 000 (extra `samples`), in the place of the case's own
    [estimate] samples; truth: true moduli (kPa) by tissue, to stand beside the estimates of a
    simulation; a phantom brings its own; add: later images that are added to the result of the case in the folder
    `earlier`, at the price of these images alone; progress: "auto" shows stages with a bar in a notebook and on a
    terminal, True everywhere, None or False nowhere; a function is called with each sentence. Raises as `make_mesh`
    does, `ConfigurationError` for another number of samples or another case than that of the folder, `ResourceError`
    where the libraries for samples are not installed, and `EstimationError` where there is no result; an iteration that
    did not converge is a result whose status says so, without values.
    """
    if samples is not None:
        case = replace(case, estimate=replace(case.estimate, samples=samples))
    with shown_in_python(progress) as tell:
        if add:
            images = [Path(path) for path in add]
            found = estimate_added(case, images, Path(earlier), progress=tell, truth=truth)
        else:
            found = run.estimate(case, progress=tell, truth=truth)
    return CaseResult(**{field.name: getattr(found, field.name) for field in fields(found)})


def make_mesh(case: Case, *, progress: Wanted = "auto") -> MeshResult:
    """The tetrahedra of a case's reference image, whose quality was checked, as `palpate mesh` makes them.

    progress: as in `estimate`. Raises `InputDataError` for images that cannot be used, `GeometryError` for organs that
    cannot be meshed, `MeshQualityError` for a mesh that is not fit to compute with.
    """
    with shown_in_python(progress) as tell:
        return run.make_mesh(case, progress=tell)


def simulate(case: Case, *, steps: int = 1, progress: Wanted = "auto") -> Simulation:
    """A later state of a case whose tissues all state their `youngs_modulus_kpa`, under its law, motion and loads.

    The driver moves as in the later image (its wall is fitted together with the organs' surfaces, the moduli held),
    by [motion] filling_mm, or as in the [phantom]. steps: how many states to give, each in equilibrium at its share
    of the motion, the last one the whole (of a phantom, shares of its displacement); progress: as in `estimate`.
    Raises as `make_mesh` does, and `ConfigurationError` when a modulus is missing, `NotConverged` where a
    finite-strain path ends early.
    """
    with shown_in_python(progress) as tell:
        return simulated(case, steps=steps, progress=tell)


def sensitivity(case: Case, *, output: PathLike | None = None, progress: Wanted = "auto") -> Sensitivity:
    """Each modulus of a case under changed assumptions: constants, segmentation, law, boundary, mesh, alignment, prior.

    output: a folder for sensitivity.json and sensitivity.html, where an interrupted study goes on; None: nothing is
    written. Raises as `estimate` does, `NotConverged` where the case itself has no estimate, and `ConfigurationError`
    where the folder holds the result of another case.
    """
    if output is None:
        with shown_in_python(progress) as tell:
            return vary(case, progress=tell)
    outputs = OutputFolder(Path(output))
    with outputs.held(), shown_in_python(progress) as tell:
        refuse_other_result(case, outputs.path)
        found = vary(case, kept=Kept(outputs), progress=tell)
        save_sensitivity(found, outputs)
    return found
