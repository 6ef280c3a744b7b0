"""From the result of a case to the data of its report; a part that fails becomes a sentence."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from palpate.case.case import Case
from palpate.errors import PalpateError
from palpate.images.distance import smoothing_width
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue, tissue_colours
from palpate.mechanics.element import largest_strains
from palpate.mesh.tet_mesh import tet_dihedrals
from palpate.parallel import mapped
from palpate.report.measured import measured_states
from palpate.report.pairs import ImagePair, bone_distances, drawn_images, image_pairs, input_images
from palpate.report.report_data import (
    MAP_OF,
    MESH,
    LaterImage,
    MeasuredState,
    MeshPicture,
    Reference,
    ReportData,
    ReportTissue,
    TissueMap,
    TriangleSurface,
)
from palpate.report.stiffness_maps import tissue_maps
from palpate.report.surfaces import MOST_TRIANGLES, carried_outline, image_surface, model_surface, outer_first
from palpate.report.volume import MOVING, Grey, background, earlier_grey, later_grey, slice_box, whole_box, whole_images
from palpate.statement.result import CaseResult, MeshSummary, failure_document, stated_unit

LOGGER = logging.getLogger(__name__)
T = TypeVar("T")

MOST_LATER = 4  # later images whose slices and surfaces are drawn; a page of more is not read
SHOWN = (*MOVING, Role.RIGID)
RIGID_TRIANGLES = 12_000
ALL_TRIANGLES = 300_000  # of all surfaces of the images, so that the page stays small
NONE: tuple[TriangleSurface, ...] = ()
NO_MAPS: tuple[TissueMap, ...] = ()
STILL = np.zeros((0, 3), dtype=np.float32)  # the motion where none was fitted
NOT_MEASURED: tuple[MeasuredState, ...] = ()


@dataclass(frozen=True, slots=True)
class _Attempt:
    """Tries each part of the data and keeps the sentences of those that failed."""

    missing: dict[str, str] = field(default_factory=dict)

    def part(self, name: str, make: Callable[[], T], instead: T) -> T:
        """What `make` returns, or `instead` when it fails, whatever the reason."""
        try:
            return make()
        except Exception as error:
            LOGGER.warning("the report has no %s: %s", name, error, exc_info=True)
            self.missing[name] = f"This part could not be made ({type(error).__name__}: {str(error)[:300]})."
            return instead


@dataclass(frozen=True, slots=True)
class _Drawing:
    """A pair of images to be drawn, its number, the triangles that one surface may have, and where failures go.

    grey: of the reference state; unread: whether there is one that could not be read.
    """

    pair: ImagePair
    number: int
    most_triangles: int
    attempt: _Attempt
    grey: Grey | None
    unread: bool


def collect(result: CaseResult) -> ReportData:
    """The report's data of a result; never fails for the sake of a figure."""
    attempt = _Attempt()
    pairs = image_pairs(result)
    images = input_images(pairs)
    drawn = drawn_images([len(pair.after) for pair in pairs], MOST_LATER)
    pairs = pairs[: max(len({number for number, _ in drawn}), 1)]
    surfaces = max((len(pairs) + len(drawn)) * len(_indices(result, SHOWN)), 1)
    drawings = list[_Drawing]()
    for number, pair in enumerate(pairs):
        grey, unread = None, False
        try:
            grey = earlier_grey(pair.result)
        except PalpateError as error:  # the page tells of it
            LOGGER.warning("the grey image is left out of the report: %s", error)
            attempt.missing[f"background of {pair.before}"] = f"The labels stand in place of the grey image: {error}"
            unread = True
        drawings.append(_Drawing(pair, number, ALL_TRIANGLES // surfaces, attempt, grey, unread))
    references = tuple(_reference(drawing) for drawing in drawings)
    later = tuple(_later(drawings[number], after, references[number]) for number, after in drawn)
    by_place = dict(zip(drawn, later, strict=True))
    measured = attempt.part(
        "points", lambda: measured_states(result, pairs, references, by_place, most=MOST_LATER), NOT_MEASURED
    )
    mesh = attempt.part("mesh", lambda: _mesh(result), None)
    names = [estimate.tissue for estimate in result.estimation.estimates]
    histories = [*(start.history for start in result.estimation.starts), result.estimation.outer_loop]
    return ReportData(
        document=result.to_dict(),
        created=f"{datetime.now(UTC):%Y-%m-%d %H:%M UTC}",
        settings=_settings(result.case, result.mesh_summary),
        tissues=report_tissues(result.tissues, result.stiffness),
        unit=result.unit,
        images=images,
        moduli_paths=tuple(
            {name: tuple(float(step.moduli.get(name, math.nan)) for step in history) for name in names}
            for history in histories
        ),
        references=references,
        later=later,
        measured=measured,
        mesh=mesh,
        maps=attempt.part("maps", lambda: tissue_maps(result), NO_MAPS),
        missing=attempt.missing,
    )


def collect_failure(case: Case, error: PalpateError) -> ReportData:
    """The report's data of an estimate that ended in `error`: what was asked, and why there is no answer."""
    tissues = tuple(tissue.with_labels(()) for tissue in case.tissues)
    return ReportData(
        document=failure_document(case, error),
        created=f"{datetime.now(UTC):%Y-%m-%d %H:%M UTC}",
        settings=_settings(case),
        tissues=report_tissues(tissues, np.full(len(tissues), np.nan)),
        unit=stated_unit(case),
    )


def _settings(case: Case, mesh: MeshSummary | None = None) -> tuple[tuple[str, str], ...]:
    """What the case asked for, in words, and what it was given where it left the choice."""
    mechanics, domain, driver, options = case.mechanics, case.domain, case.driver, case.estimate
    margin = f", {domain.margin_mm:g} mm around the organs" if domain.extent == "margin" else ""
    by_load = bool(case.loads) and not any(tissue.role is Role.KNOWN for tissue in case.tissues)
    in_kpa = " kPa" if by_load else " (ratios)"
    starts, bounds = options.starts_kpa or options.start_ratios, options.bounds_kpa or options.bounds_ratio
    edge, noise = "chosen by the organs", case.noise
    if case.mesh.edge_length_mm is not None:
        edge = f"{case.mesh.edge_length_mm:g} mm"
    elif mesh is not None and mesh.edge_length_mm is not None:
        edge = f"{mesh.edge_length_mm:g} mm, chosen: {mesh.edge_length_reason}"
    return (
        *_brought(case),
        ("material law", mechanics.law),
        *((p.name, f"{mechanics.law_parameters.get(p.name, p.default):g}") for p in mechanics.material_law.parameters),
        ("element", mechanics.element),
        ("edge length at the organs", edge),
        ("outer boundary", f"{domain.outer_boundary}; domain: {domain.extent}{margin}"),
        ("alignment", case.align),
        (
            "driver motion",
            f"{driver.modes} modes, kernel {driver.kernel_mm:g} mm, prior {driver.prior_mm:g} mm"
            + (", learned from the images from there on" if driver.learn_prior else ""),
        ),
        ("method", options.method),
        ("starts", ", ".join(f"{start:g}" for start in starts) + (" kPa" if options.starts_kpa else in_kpa)),
        ("bounds", " to ".join(f"{bound:g}" for bound in bounds) + (" kPa" if options.bounds_kpa else in_kpa)),
        (
            "surface noise",
            "from the residuals" if noise.surface_sd_mm is None else f"{noise.surface_sd_mm:g} mm, given",
        ),
        ("seed", str(case.seed)),
    )


def _brought(case: Case) -> list[tuple[str, str]]:
    """Known loads, measurements, priors of what is mapped and a given mesh in words, without a file's name."""
    found = list[tuple[str, str]]()
    for load in case.loads:
        kind = "following" if load.following else "dead"
        words = f"{kind} pressure {load.pressure_kpa or 0.0:g} kPa"
        if load.acceleration_m_s2 is not None:
            words = f"gravity {_vector(load.acceleration_m_s2)} m/s^2"
        elif load.traction_kpa is not None:
            words = f"traction {_vector(load.traction_kpa)} kPa"
        when = f", in later state {load.state}" if load.state else ", in the reference state"
        where = f" on {load.surface}" if load.surface else ""
        found.append(("known load", f"{words}{where}{'' if load.state is None else when}"))
    for data in case.data:
        of_file = "with a covariance" if data.covariance_mm2 else "with the errors of its file"
        error = of_file if data.sd_mm is None else f"sd {data.sd_mm:g} mm"
        alike = f", alike over {data.correlation_mm:g} mm" if data.correlation_mm else ""
        words = f"{data.kind}, {error}{alike}"
        if data.force_n is not None:
            words = f"{data.kind} of {data.force_n:g} N on {data.surface}, sd {data.sd_n or 0.0:g} N"
        found.append(("measurement", f"{words}, state {data.state}"))
    for tissue in case.tissues:
        if prior := tissue.with_labels(()).field:  # of ln E inside it
            words = f"Gaussian, Matern's kernel, sd {prior.sd:g} of ln E, length {prior.length_mm:g} mm"
            found.append((f"{MAP_OF}{tissue.name}", words))
    return [*found, ("body", MESH)] if case.body is not None else found


def _vector(parts: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{part:g}" for part in parts) + ")"


def report_tissues(tissues: tuple[Tissue, ...], moduli: NDArray[np.float64]) -> tuple[ReportTissue, ...]:
    """Tissues as the page shows them, with moduli (n_tissues,) in the result's unit, NaN where there is none."""
    return tuple(
        ReportTissue(
            name=tissue.name,
            role=tissue.role.value,
            colour=colour,
            poisson_ratio=tissue.poisson_ratio,
            given_kpa=tissue.youngs_modulus_kpa if tissue.role is Role.KNOWN else None,
            modulus=float(modulus) if math.isfinite(modulus) else None,
        )
        for tissue, colour, modulus in zip(tissues, tissue_colours(tissues), moduli, strict=True)
    )


def _indices(result: CaseResult, roles: tuple[Role, ...]) -> tuple[int, ...]:
    return tuple(i for i, tissue in enumerate(result.tissues) if tissue.role in roles)


def _reference(drawing: _Drawing) -> Reference:
    pair, attempt = drawing.pair, drawing.attempt
    result, name = pair.result, pair.before
    image = result.before
    if not result.after:  # voxels show a mesh: those of hollow tissues stand behind its surfaces only by name
        meshed = np.array([tissue.meshed for tissue in image.tissues])
        image = replace(image, index=np.where(meshed[image.index], image.index, -1))
    box = attempt.part(f"slices of {name}", lambda: slice_box(result.before, result.after), None)
    shown = attempt.part(
        f"background of {name}",
        lambda: None if box is None else background(result, drawing.grey, image, box, labels=drawing.unread),
        None,
    )
    return Reference(
        name=name,
        voxel_mm=float(max(image.grid.spacing.max() for image in (result.before, *result.after))),
        slices=box,
        background=shown,
        surfaces=attempt.part(f"surfaces of {name}", lambda: _surfaces(drawing, image), NONE),
        whole=whole_box(result.before, None if box is None else box.position),
    )


def _surfaces(drawing: _Drawing, image: Segmentation) -> tuple[TriangleSurface, ...]:
    """Surfaces of the moving tissues and, coarser, of the rigid ones in an image."""
    result = drawing.pair.result
    width = smoothing_width(result.before.grid, *(image.grid for image in result.after))  # as the mesh: comparable
    found = []
    shown = SHOWN if result.after else (Role.ESTIMATE, Role.KNOWN)  # of a body that comes as a mesh: all of it
    for i in _indices(result, shown):
        most = RIGID_TRIANGLES if result.tissues[i].role is Role.RIGID else MOST_TRIANGLES
        found.append(image_surface(image, i, smoothing_mm=width, most_triangles=min(most, drawing.most_triangles)))
    return outer_first(found)


def _later(drawing: _Drawing, after: int, reference: Reference) -> LaterImage:
    result, attempt, name = drawing.pair.result, drawing.attempt, drawing.pair.after[after]
    fitted, image = after < len(result.estimation.displacements), result.after[after]
    surfaces = attempt.part(f"surfaces of {name}", lambda: _surfaces(drawing, image), NONE)
    moving = [s for s in reference.surfaces if result.tissues[s.tissue].role in MOVING] if fitted else []
    grey, box = attempt.part(f"background of {name}", lambda: later_grey(result, after), None), reference.slices
    whole = reference.whole or whole_box(result.before)
    return LaterImage(
        name=name,
        reference=drawing.number,
        surfaces=surfaces,
        model=attempt.part(
            f"distances of {name}",
            lambda: tuple(
                mapped(lambda i: model_surface(result, i, after), _indices(result, MOVING) if fitted else ())
            ),
            (),
        ),
        background=attempt.part(
            f"background of {name}", lambda: None if box is None else background(result, grey, image, box), None
        ),
        outlines=attempt.part(
            f"outlines of {name}", lambda: tuple(carried_outline(result, s, after) for s in moving), NONE
        ),
        both=attempt.part(
            f"alignment of {name}",
            lambda: whole_images(whole, (result.before, drawing.grey), (image, grey)),
            (),
        ),
        bones=attempt.part(
            f"alignment of {name}", lambda: bone_distances(result, after, reference.surfaces, surfaces), ()
        ),
        motion=attempt.part(f"motion of {name}", lambda: _motion(drawing, after), STILL),
    )


def _motion(drawing: _Drawing, after: int) -> NDArray[np.float32]:
    """Fitted motion (n_nodes, 3) mm of the nodes of the first reference state's mesh; (0, 3) where there is none."""
    result = drawing.pair.result
    if drawing.number or after >= len(result.estimation.displacements):
        return STILL
    return result.estimation.displacements[after][: len(result.space.mesh.nodes)].astype(np.float32)


def _mesh(result: CaseResult) -> MeshPicture:
    """The mesh of the first reference state with its largest strain in any of its later images."""
    mesh = result.space.mesh
    motions = result.displacements
    strains = [largest_strains(result.space, motion) for motion in motions]
    return MeshPicture(
        nodes=mesh.nodes.astype(np.float32),
        tets=mesh.tets.astype(np.int32),
        region=mesh.region.astype(np.int16),
        angles=tet_dihedrals(mesh.nodes[mesh.tets]).astype(np.float32),
        strains=np.max(strains, axis=0).astype(np.float32) if strains else np.zeros(0, np.float32),
    )
