"""The images of a case aligned to the first of them: how each lay, its warnings, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np

from palpate.body.contacts import every_finding
from palpate.body.refusals import refuse_lost, refuse_unmeshable
from palpate.errors import InputDataError
from palpate.findings import Finding, listing, some
from palpate.images.alignment import Alignment, Motion, align, moved
from palpate.images.checks import check_headers, check_images, later_names, refuse_absent, refuse_unit
from palpate.images.registration import ON, Registration, registration
from palpate.images.segmentation import Segmentation
from palpate.images.surface_alignment import SurfaceMaps, align_surfaces, surface_maps
from palpate.images.tissue import Role
from palpate.mesh.tet_mesh import TetMesh
from palpate.observation.contract import DataSource
from palpate.parallel import blas_on_one_thread
from palpate.progress import Progress, silent

SMALL_FRAME_MOTION = 1.0 / 3.0  # of the organs' relative motion: a smaller motion of the frame is not reported
LEVER_MM = 25.0  # about an organ's size: the lever that turns a rotation into a motion
SEEN_MM = 0.2  # smaller motions are within the measurement's error
STATED = (
    "motion-below-noise",
    "sides-exchanged",
    "front-exchanged",
)  # findings on contacts are in the result as observed shares


@dataclass(frozen=True, slots=True)
class LaterImage:
    """A later state, with its number in the case, from 1: its image, brought to the first; None where it has none.

    bones: motions of what is moved as prescribed, by tissue index; alignment: how the image lay before; None where
    nothing was aligned.
    """

    number: int
    image: Segmentation | None = None
    bones: Mapping[int, Motion] = field(default_factory=dict)
    alignment: Registration | None = None


@dataclass(frozen=True, slots=True)
class ImagedStates:
    """The reference state of a body and its later states.

    inputs: SHA-256 of each file that was read for them, by its key in `result.json`; data: measurements beside the
    images; mesh: where the body is given as one, and no later state is imaged.
    """

    before: Segmentation
    later: tuple[LaterImage, ...]
    findings: tuple[Finding, ...] = ()
    inputs: Mapping[str, str] = field(default_factory=dict)
    data: tuple[DataSource, ...] = ()
    mesh: TetMesh | None = None

    @property
    def after(self) -> tuple[Segmentation, ...]:
        """The later images that there are."""
        return tuple(of.image for of in self.later if of.image is not None)

    def volumes(self, tissue: int) -> tuple[float, ...]:
        """Volume (mm^3) of a tissue in each image, or that of its tetrahedra in a body that is given as a mesh."""
        if self.mesh is not None:
            return (float(self.mesh.volumes[self.mesh.region == tissue].sum()),)
        return tuple(image.volume(tissue) for image in (self.before, *self.after))


@blas_on_one_thread()
def aligned(
    before: Segmentation,
    after: tuple[Segmentation, ...],
    *,
    method: str,
    first: int = 1,
    loaded: bool = False,
    progress: Progress = silent,
) -> ImagedStates:
    """Bring the later images to the first (`method`: "rigid-tissues", "surfaces" or "none") and check them all.

    first: number of the first of them in the case; loaded: whether known loads act on the body, for what is found of
    its motion.
    Raises `InputDataError` as `refuse_unit`, `refuse_absent`, `align`, `check_images` and `refuse_lost` do,
    `GeometryError` as `refuse_unmeshable`.
    """
    for name, image in zip(("before", *later_names(len(after))), (before, *after), strict=True):
        refuse_unit(image.grid, name)
    refuse_absent(before, after)
    found = brought(before, after, method=method, first=first, progress=progress)
    progress("checking the images")
    findings, images = [*found.findings, *check_images(before, found.after)], found.after
    refuse_unmeshable(before, "before")
    for name, image in zip(later_names(len(images)), images, strict=True):
        refuse_unmeshable(image, name)
        refuse_lost(before, image, name)
    findings += [finding for finding in every_finding(before, images, loaded=loaded) if finding.code in STATED]
    return replace(found, findings=tuple(findings))


def brought(
    before: Segmentation, after: tuple[Segmentation, ...], *, method: str, first: int = 1, progress: Progress = silent
) -> ImagedStates:
    """Bring the later images to the first as `aligned` does, but check nothing besides their headers.

    Raises `InputDataError` as `align` and `align_surfaces`.
    """
    later, findings = list[LaterImage](), list[Finding]()
    maps: SurfaceMaps | None = None
    named = list(zip(later_names(len(after)), after, strict=True))
    if method == "none":
        for name, image in named:
            progress(f"looking for a motion of the whole in '{name}'")
            findings += check_headers(before.grid, image.grid, name)
            with suppress(InputDataError):  # too little is seen for a motion of the whole; nothing rests on it here
                maps = surface_maps(before, image, maps)
                found = registration(before, maps, align_surfaces(before, maps), by="surfaces")
                findings += _frame_findings(before, found, name, aligned=False)
        return ImagedStates(before, tuple(map(LaterImage, count(first), after)), tuple(findings))
    rigid = {i: t.name for i, t in enumerate(before.tissues) if t.role is Role.RIGID}
    for number, (name, image) in enumerate(named, start=first):
        progress(f"aligning '{name}' on {ON[method]}")
        findings += check_headers(before.grid, image.grid, name)
        alignment = align(before, image) if rigid or method == "rigid-tissues" else None
        maps = surface_maps(before, image, maps)
        fit = alignment.overall if alignment and method == "rigid-tissues" else align_surfaces(before, maps)
        lay = registration(before, maps, fit, by=method)
        progress(f"'{name}' {lay.in_words}")
        bones = {i: alignment.remaining(bone, fit) for i, bone in rigid.items()} if alignment else {}
        later.append(LaterImage(number, moved(image, fit.motion.inverse()), bones, lay))
        findings += alignment_findings(alignment, name) if alignment else []
        findings += _frame_findings(before, lay, name)
    return ImagedStates(before, tuple(later), tuple(findings))


def _frame_findings(before: Segmentation, found: Registration, name: str, *, aligned: bool = True) -> list[Finding]:
    """A finding on a motion of the whole body of more than a third of the motion of the organs against each other."""
    own = found.own_motion_mm(before.tissues)
    moved_mm = float(np.hypot(found.distance_mm, LEVER_MM * np.deg2rad(found.rotation_deg)))
    if moved_mm <= SMALL_FRAME_MOTION * own or moved_mm < SEEN_MM:
        return []
    size = f"{found.distance_mm:.1f} mm and {found.rotation_deg:.1f} degrees"
    place = f"in '{name}' ({size})"
    if aligned:
        text = (
            f"The body in '{name}' lay {size} from 'before', measured on {ON[found.by]}, and was moved back; its parts"
            f" move by {own:.2g} mm against each other. Check the alignment in the report."
        )
        return [Finding("frame-aligned", text, place=place)]
    text = (
        f"The body in '{name}' lies {size} from 'before' and was not moved back, so that this offset counts as"
        f" deformation; its parts move by {own:.2g} mm against each other. Check the headers, or set"
        ' images.align = "surfaces".'
    )
    return [Finding("frame-moves", text, place=place)]


def alignment_findings(alignment: Alignment, name: str) -> list[Finding]:
    """Findings on the motion of the bones to the image called `name`: one for each cause, with all its bones."""
    findings = []
    unseen = [bone for bone, fit in alignment.tissues.items() if fit.n_points == 0]
    if unseen:
        rest = " for a motion of its own, so it moves with the other rigid tissues. Use a larger field of view, if any."
        text = listing(f"'{name}' shows too little of the surface of ", _quoted(unseen), rest)
        findings.append(Finding("rigid-unseen", text, place=f"in '{name}' ({some(_quoted(unseen), most=2)})"))
    if alignment.loose:
        off = [f"'{bone}' {distance:.1f} mm" for bone, distance in alignment.loose.items()]
        lead = f"In '{name}' pieces of a rigid tissue do not move as one body, and lie apart after its motion: "
        text = listing(lead, off, ". Give each bone a tissue of its own.")
        findings.append(Finding("several-bodies", text, place=f"in '{name}' ({some(off, most=2)})"))
    round_ones = [bone for bone, fit in alignment.tissues.items() if len(fit.undetermined)]
    if round_ones:
        rest = (
            f" is too round to show its rotation from 'before' to '{name}' about every axis; that rotation is taken as"
            " zero. Join it to a bone that it moves with, if there is one."
        )
        text = listing("The surface of ", _quoted(round_ones), rest)
        findings.append(
            Finding("rotation-undetermined", text, place=f"to '{name}' ({some(_quoted(round_ones), most=2)})")
        )
    return findings


def _quoted(names: Sequence[str]) -> list[str]:
    return [f"'{name}'" for name in names]
