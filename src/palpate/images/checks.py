"""Checks of segmented images before anything is computed from them: refusals and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from palpate.errors import InputDataError
from palpate.findings import Finding
from palpate.images.distance import window_around
from palpate.images.label_image import VoxelGrid
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role, Tissue

STILL_VOXELS = 0.15  # mean motion of a surface, in voxels, by rounding alone
OBSERVED = (Role.ESTIMATE, Role.DRIVER, Role.RIGID)
EMPTIED = 0.30  # of a driver's volume: a smaller loss is no question worth asking
VOLUME_CHANGE = 0.05  # no modulus explains a filling between the scans
VOLUME_IMPLAUSIBLE = 0.30  # volume change that no deformation, and hardly a filling, can make
SMALL_VOXELS = 50
THIN_VOXELS = 4
THIN_SHARE = 0.2
COMMON_SHARE = 0.5
ON_FACE = 1e-6  # voxels: rounding of a point on an image's outer face
FAR_SHARE = {Role.ESTIMATE: 0.5}  # of its size: a solid organ hardly moves further; others by all of it
SPACING_MM = (0.02, 20.0)  # range of a voxel's edge; outside it is more likely in metres or micrometres
LENGTH_MM = (2.0, 1e4)  # range of an image's longest side: outside it no body is imaged
MIRROR_CERTAIN = 0.25  # gain in agreement (at most 1) at which an image is refused as mirrored
MIRROR_LIKELY = 0.10
MIRROR_SAMPLES = 4000
VOID_INSIDE = 0.25  # largest share of a void's surface on the image's cut; the air around a body has more
VOID_STILL = 2.0  # factor on the motion by rounding alone
DIRECTIONS = ("left-right", "front-back", "head-foot")
SAME_SPACING, NEARLY_SAME_SPACING = 5e-4, 0.02  # relative: rounding in a header; too little for another protocol
HALF_VOXEL = 0.02  # voxels, by which an offset is half of one


def wall_motion(before: Segmentation, after: Segmentation, tissue: int) -> float:
    """Mean normal motion of a tissue's surface, mm: the volume that it gains and loses, by its area.

    The area is that of the voxels' faces times 2/3, its mean over all directions of a plane (Cauchy).
    """
    lost = _outside(before, after, tissue) * before.grid.voxel_volume
    gained = _outside(after, before, tissue) * after.grid.voxel_volume
    spacing = before.grid.spacing
    faces = float(np.array(_faces(before.mask(tissue))) @ (np.prod(spacing) / spacing))
    return float((lost + gained) / max(2.0 / 3.0 * faces, 1e-9))


def _outside(one: Segmentation, other: Segmentation, tissue: int) -> int:
    """Number of the tissue's voxels in one image that another tissue has in the other, within its field of view."""
    count = 0
    for voxels in one.voxels(tissue):
        index = np.rint(other.grid.index(one.grid.world(voxels.astype(float)))).astype(np.int64)
        inside = ((index >= 0) & (index < other.grid.shape)).all(axis=1)
        count += int(np.count_nonzero(other.index[tuple(index[inside].T)] != tissue))
    return count


def check_images(before: Segmentation, after: Sequence[Segmentation]) -> tuple[Finding, ...]:
    """All findings on the images of one case: each image by itself, then each later state against `before`.

    Raises `InputDataError` as `check_pair` does; names the later state by its number, from 1, when there are several.
    """
    findings = list(check_segmentation(before, "before"))
    for name, image in zip(later_names(len(after)), after, strict=True):
        findings += check_segmentation(image, name)
        findings += check_pair(before, image, name=name)
    return tuple(findings)


def later_names(count: int) -> list[str]:
    """What the later images of a pair are called in sentences: "after", or "after[1]", "after[2]" ... of several."""
    return ["after"] if count == 1 else [f"after[{number}]" for number in range(1, count + 1)]


def check_headers(before: VoxelGrid, after: VoxelGrid, name: str) -> tuple[Finding, ...]:
    """Findings on probable errors in the headers of two images, from their grids as they were read.

    Spacings that differ by about 1 % stretch every organ, and origins that differ by half a voxel move it, as much as
    its stiffness does. Two scans are rarely so alike without being the same.
    """
    ratio = after.spacing / before.spacing - 1.0
    odd = [axis for axis in range(3) if SAME_SPACING < abs(ratio[axis]) < NEARLY_SAME_SPACING]
    if odd:
        axis = max(odd, key=lambda a: abs(ratio[a]))
        sizes = f"{before.spacing[axis]:.5g} and {after.spacing[axis]:.5g} mm"
        text = (
            f"The voxels of 'before' and '{name}' differ by {abs(ratio[axis]):.2%} along image axis {axis + 1}"
            f" ({sizes}), as if a spacing was rounded or mistyped; all organs then seem stretched by as much. Compare"
            " both headers with the DICOM series."
        )
        return (Finding("spacing-nearly-same", text, place=f"in '{name}' ({abs(ratio[axis]):.2%})"),)
    if before.shape != after.shape or np.abs(before.affine[:3, :3] - after.affine[:3, :3]).max() > SAME_SPACING:
        return ()
    offset = after.index(before.world(np.zeros((1, 3))))[0]
    halves, wholes = np.abs(offset % 1.0 - 0.5) < HALF_VOXEL, np.abs(offset - np.rint(offset)) < HALF_VOXEL
    if not halves.any() or not np.all(halves | wholes) or np.abs(offset).max() > 1.0:
        return ()
    shift = " x ".join(f"{part:.2g}" for part in np.abs(offset))
    text = (
        f"The origins of 'before' and '{name}' differ by {shift} voxels, as if one header gives the centre of the first"
        " voxel and the other its corner. Compare both origins with the DICOM series."
    )
    return (Finding("half-voxel", text, place=f"in '{name}'"),)


def refuse_unit(grid: VoxelGrid, name: str) -> None:
    """Raise `InputDataError` when the image called `name` has the size of one in another unit of length."""
    length = float((np.array(grid.shape) * grid.spacing).max())
    if not LENGTH_MM[0] <= length <= LENGTH_MM[1]:
        unit, code, factor = ("metres", 1, 1000.0) if length < LENGTH_MM[0] else ("micrometres", 3, 0.001)
        raise InputDataError(
            f"'{name}' is {length:.3g} mm long at its longest side: its header seems to be in {unit}. Set the header's"
            f" unit of length (NIfTI: xyzt_units = {code}), or multiply spacing and origin by {factor:g}"
        )


def check_segmentation(segmentation: Segmentation, name: str) -> tuple[Finding, ...]:
    """Findings on one image, called `name` in the text: its reading, voxel size, cut, small or thin organs, islands."""
    findings = [
        replace(finding, message=f"'{name}': {finding.message}", place=f"'{name}'") for finding in segmentation.findings
    ]
    spacing = segmentation.grid.spacing
    if not SPACING_MM[0] <= float(spacing.min()) <= float(spacing.max()) <= SPACING_MM[1]:
        size = " x ".join(f"{edge:.4g}" for edge in spacing)
        unit = "metres" if float(spacing.min()) < SPACING_MM[0] else "micrometres"
        text = f"'{name}' has voxels of {size} mm, as if its header is in {unit}. Set the unit of length in the header."
        findings.append(Finding("voxel-size", text, place=f"'{name}'"))
    for i, tissue in enumerate(segmentation.tissues):
        if tissue.role not in OBSERVED:
            continue
        mask = segmentation.mask(i)
        if not mask.any():
            continue  # a tissue that is absent is refused by check_pair
        if tissue.role is not Role.RIGID:
            box = window_around(mask, segmentation.grid)
            if touching := _touching(mask):
                share = f"{touching / (touching + sum(_faces(mask))):.1%}"
                text = (
                    f"'{tissue.name}' reaches the border of '{name}': {share} of its surface is only the cut of the"
                    " image, where its motion is unknown. Use a larger field of view, if there is one."
                )
                findings.append(Finding("cut-by-border", text, tissue.name, f"in '{name}' ({share})"))
            findings += _too_thin(segmentation.index == i, box, tissue, name)
            parts, count = ndimage.label(segmentation.index[box] == i, structure=np.ones((3, 3, 3)))
            whole = max(len(tissue.labels), 1)  # a tissue of a left and a right label has two pieces
            if count > whole:
                sizes = np.sort(np.bincount(parts.ravel())[1:])
                largest = "the largest" if whole == 1 else f"the {whole} largest"
                text = (
                    f"'{tissue.name}' has {count} separate pieces in '{name}', with"
                    f" {sizes[:-whole].sum() / sizes.sum():.2%} of its volume outside {largest}. Remove stray voxels"
                    " from the labels."
                )
                findings.append(Finding("islands", text, tissue.name, f"in '{name}' ({count})"))
    return tuple(findings)


def absent_tissues(before: Segmentation, after: Sequence[Segmentation]) -> dict[int, list[str]]:
    """Names of the images without a voxel of a tissue that must be seen in all, by the tissue's index."""
    found: dict[int, list[str]] = {}
    for name, image in [("before", before), *zip(later_names(len(after)), after, strict=True)]:
        present = set(np.unique(image.index).tolist())
        for i, tissue in enumerate(image.tissues):
            if tissue.role in OBSERVED and i not in present:
                found.setdefault(i, []).append(name)
    return found


def refuse_absent(before: Segmentation, after: Sequence[Segmentation]) -> None:
    """Raise `InputDataError` that names every absent tissue (see `absent_tissues`) with its images."""
    absent = absent_tissues(before, after)
    if not absent:
        return
    lost = [
        f"tissue '{tissue.name}' (label {', '.join(map(str, tissue.labels)) or 'remaining'}, role {tissue.role}) has no"
        f" voxel in {' and '.join(repr(name) for name in names)}"
        for tissue, names in ((before.tissues[i], names) for i, names in absent.items())
    ]
    raise InputDataError(
        f"{'; '.join(lost)}. Every image must show it: check its label in the images, or remove the tissue from the"
        " case"
    )


def check_pair(before: Segmentation, after: Segmentation, *, name: str = "after") -> tuple[Finding, ...]:
    """Findings on two states of one body: changes of volume, large shifts, mirrored images, little overlap.

    Raises `InputDataError` when the two are the same image, an organ has another name in one of them, they share no
    part of the world, one is clearly the mirror image of the other, or two organs have exchanged their labels.
    """
    if [t.name for t in before.tissues] != [t.name for t in after.tissues]:
        raise InputDataError(f"'before' and '{name}' are segmented into different tissues; use the same list for both")
    # 3D Slicer numbers segments anew in each file: one number may be two organs
    for here, there in zip(before.tissues, after.tissues, strict=True):
        names = [sorted(word.casefold() for word in tissue.called) for tissue in (here, there)]
        if all(names) and names[0] != names[1]:
            raise InputDataError(
                f"tissue '{here.name}' (label {', '.join(map(str, here.labels))}) is called {list(here.called)} in"
                f" 'before' and {list(there.called)} in '{name}'; give the tissue a name as its label in the case"
                f' (label = "{here.called[0]}"), or the same names in both files'
            )
    if np.array_equal(before.index, after.index):
        raise InputDataError(
            f"'before' and '{name}' are the same label image, voxel by voxel, so there is no deformation to estimate"
            " from; check the two paths"
        )
    findings = _common_part(before, after, name)
    observed = [i for i, tissue in enumerate(before.tissues) if tissue.role in OBSERVED]
    findings += _mirrored(before, after, observed, name)
    findings += _shifts(before, after, observed, name)
    for i in observed:
        findings += _volume_change(before, after, i, name)
    for i in range(len(before.tissues)):
        findings += _moving_void(before, after, i, name)
    findings += _emptied(before, after, name)
    return tuple(findings)


def _touching(mask: NDArray[np.bool_]) -> int:
    """Number of outer voxel faces of the image that belong to the organ."""
    return sum(int(np.count_nonzero(np.take(mask, end, axis))) for axis in range(3) for end in (0, -1))


def _faces(mask: NDArray[np.bool_]) -> list[int]:
    """Number of voxel faces across each axis between the organ and what is beside it in the image."""
    return [int(np.count_nonzero(np.diff(mask, axis=axis))) for axis in range(3)]


def _too_thin(mask: NDArray[np.bool_], box: tuple[slice, ...], tissue: Tissue, name: str) -> list[Finding]:
    """A finding where an organ has few voxels, or many that no cube of THIN_VOXELS inside it covers.

    box: the organ's bounding box.
    """
    count = int(np.count_nonzero(mask[box]))
    if count < SMALL_VOXELS:
        text = f"'{tissue.name}' has only {count} voxels in '{name}', so its surface is not reliable. Use finer images."
        return [Finding("too-small", text, tissue.name, f"in '{name}' ({count})")]
    window = tuple(slice(max(s.start - THIN_VOXELS, 0), s.stop + THIN_VOXELS) for s in box)
    missing = [
        (max(THIN_VOXELS - s.start, 0), max(s.stop + THIN_VOXELS - n, 0)) for s, n in zip(box, mask.shape, strict=True)
    ]
    around = np.pad(mask[window], missing, mode="edge")  # where the image ends, the tissue goes on
    thick = ndimage.binary_opening(around, np.ones((THIN_VOXELS,) * 3, dtype=bool))
    inner = (slice(THIN_VOXELS, -THIN_VOXELS),) * 3
    share = 1.0 - np.count_nonzero(thick[inner] & around[inner]) / count
    if share <= THIN_SHARE:
        return []
    text = (
        f"{share:.0%} of '{tissue.name}' in '{name}' is thinner than {THIN_VOXELS} voxels, so its surface there is"
        " known only to about half a voxel. Use finer images, or join it to its neighbour."
    )
    return [Finding("thin", text, tissue.name, f"in '{name}' ({share:.0%})")]


def _common_part(before: Segmentation, after: Segmentation, name: str) -> list[Finding]:
    share = max(share_inside(before.grid, after.grid), share_inside(after.grid, before.grid))
    if share == 0.0:
        centres = [grid.world((np.array([grid.shape]) - 1.0) / 2.0)[0] for grid in (before.grid, after.grid)]
        raise InputDataError(
            f"'before' and '{name}' do not overlap in space: their centres lie at {np.round(centres[0], 1).tolist()}"
            f" and {np.round(centres[1], 1).tolist()} mm (RAS); check the headers, or register the images first"
        )
    if share >= COMMON_SHARE:
        return []
    text = (
        f"'before' and '{name}' share only {share:.0%} of the smaller image; surfaces outside that part are not"
        " compared. Check the headers, unless the fields of view differ so much."
    )
    return [Finding("little-in-common", text, place=f"'{name}' ({share:.0%})")]


def share_inside(grid: VoxelGrid, other: VoxelGrid) -> float:
    """Share of the grid's volume that lies inside the other one, by a lattice of 33^3 points out to the outer faces."""
    ticks = [np.linspace(-0.5, n - 0.5, 33) for n in grid.shape]
    lattice = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    index = other.index(grid.world(lattice))
    low, high = -0.5 - ON_FACE, np.array(other.shape) - 0.5 + ON_FACE
    return float(((index >= low) & (index <= high)).all(axis=1).mean())


def _mirrored(before: Segmentation, after: Segmentation, observed: Sequence[int], name: str) -> list[Finding]:
    """Lay the organs of one image on the other, as they are and mirrored along one, two or three axes.

    The agreement is the mean over the organs of the share of voxels that lie in the same organ of the other image. The
    organs' common centroids are matched first, so that a shift or the size of the field of view does not matter. Where
    exchanging the labels of two organs improves the agreement as much as a mirror, the exchange is reported instead.
    """
    points = []  # of each organ at most MIRROR_SAMPLES voxel centres (n, 3), evenly picked, RAS mm
    for i in observed:
        step = -(-int(np.count_nonzero(before.mask(i))) // MIRROR_SAMPLES)
        picked, seen = list[NDArray[np.int64]](), 0
        for voxels in before.voxels(i):
            picked.append(voxels[-seen % step :: step])
            seen += len(voxels)
        points.append(before.grid.world(np.concatenate(picked).astype(np.float64)))
    middle = np.mean([p.mean(axis=0) for p in points], axis=0)
    target = np.mean([after.middle(i) for i in observed], axis=0)
    agreement, found = {}, np.zeros((len(observed),) * 2)  # share of an organ's voxels that find each organ
    for signs in product((-1.0, 1.0), repeat=3):  # the last as it is
        for row, p in zip(found, points, strict=True):
            index = np.rint(after.grid.index(target + (p - middle) * signs)).astype(np.int64)
            inside = index[((index >= 0) & (index < after.grid.shape)).all(axis=1)]
            row[:] = np.mean(after.index[tuple(inside.T)][:, None] == observed, axis=0) * len(inside) / len(p)
        agreement[signs] = float(np.trace(found)) / len(observed)
    plain = agreement.pop((1.0, 1.0, 1.0))
    signs, best = max(agreement.items(), key=lambda item: (round(item[1], 3), sum(item[0])))
    own = np.diag(found)
    gain = found + found.T - own[:, None] - own
    i, j = sorted(divmod(int(np.argmax(gain)), len(observed)))
    if gain[i, j] >= max(2.0 * MIRROR_CERTAIN, len(observed) * (best - plain)):
        one, other = (before.tissues[observed[k]].name for k in (i, j))
        now, then = (own[i] + own[j]) / 2.0, (found[i, j] + found[j, i]) / 2.0
        raise InputDataError(
            f"'{one}' and '{other}' look exchanged in '{name}': {then:.0%} of their voxels lie in the other tissue"
            f" there, and {now:.0%} in their own; check which label is which in that image"
        )
    if best - plain < MIRROR_LIKELY:
        return []
    axes = " and ".join(direction for direction, sign in zip(DIRECTIONS, signs, strict=True) if sign < 0.0)
    text = (
        f"'{name}' looks mirrored {axes} against 'before': {best:.0%} of the tissues' voxels agree when it is flipped,"
        f" {plain:.0%} as it is. Check how both images were exported; RAS and LPS may be confused."
    )
    if best - plain >= MIRROR_CERTAIN:
        raise InputDataError(text)
    return [Finding("mirrored", text, place=f"'{name}'")]


def _shifts(before: Segmentation, after: Segmentation, observed: Sequence[int], name: str) -> list[Finding]:
    """Organs that move by more than half of their size, and drivers by all of it.

    The motion is relative to the rigid tissues where there are any, and after the alignment.
    """
    shift = {i: after.middle(i) - before.middle(i) for i in observed}
    rigid = [shift[i] for i in observed if before.tissues[i].role is Role.RIGID]
    common = np.mean(rigid, axis=0) if rigid else np.zeros(3)
    findings = []
    for i, vector in shift.items():
        size = (6.0 * before.volume(i) / np.pi) ** (1.0 / 3.0)
        length = float(np.linalg.norm(vector - common))
        share = FAR_SHARE.get(before.tissues[i].role, 1.0)
        if length > share * size:
            against = " relative to the rigid tissues" if rigid else ""
            text = (
                f"'{before.tissues[i].name}' moves by {length:.1f} mm from 'before' to '{name}'{against}, more than"
                f" {'half of ' if share < 1.0 else ''}its size of {size:.1f} mm. Check that its label means the same"
                " tissue in both images, and that the images are aligned."
            )
            findings.append(Finding("large-shift", text, before.tissues[i].name, f"to '{name}' ({length:.1f} mm)"))
    return findings


def _volume_change(before: Segmentation, after: Segmentation, i: int, name: str) -> list[Finding]:
    tissue = before.tissues[i]
    change = after.volume(i) / before.volume(i) - 1.0
    if tissue.role is not Role.ESTIMATE or abs(change) <= VOLUME_CHANGE:
        return []
    radii = [(0.75 * image.volume(i) / np.pi) ** (1.0 / 3.0) for image in (before, after)]  # of balls as large
    drawn, voxel = abs(radii[1] - radii[0]), float(after.grid.voxel_volume ** (1.0 / 3.0))
    sizes = (
        f"The volume of '{tissue.name}' changes by {change:+.1%} from 'before' ({before.volume(i) / 1000.0:.4g} mL) to"
        f" '{name}' ({after.volume(i) / 1000.0:.4g} mL)"
    )
    place = f"to '{name}' ({change:+.1%})"
    cut = [_touching(image.mask(i)) for image in (before, after)]
    if cut[1] and not cut[0]:
        return []  # the later image's field of view ends in the organ, and shows less of it
    if any(cut):
        text = (
            f"{sizes}; the image's border cuts it, which may be the cause. Use a larger field of view, if there is one."
        )
        return [Finding("volume-change", text, tissue.name, place)]
    alike = (
        f"a surface drawn {drawn:.2g} mm ({drawn / voxel:.2g} voxels) further {'out' if change > 0.0 else 'in'} would"
        " look the same"
    )
    driver = "if it is hollow and fills or empties, give it the role driver"
    if abs(change) > VOLUME_IMPLAUSIBLE:
        advice = f"Check that the label means the same in both images; {driver}."
        text = f"{sizes}, too much for one organ; {alike}. {advice}"
        return [Finding("volume-implausible", text, tissue.name, place)]
    text = f"{sizes}, which no modulus explains; {alike}. Compare the outlines; {driver}."
    return [Finding("volume-change", text, tissue.name, place)]


def _emptied(before: Segmentation, after: Segmentation, name: str) -> list[Finding]:
    """A question about `before` where all drivers together are smaller later, and one of them by much."""
    drivers = [i for i, tissue in enumerate(before.tissues) if tissue.role is Role.DRIVER]
    volumes = {i: (before.volume(i), after.volume(i)) for i in drivers}
    if not drivers or sum(end - start for start, end in volumes.values()) >= 0.0:
        return []
    most = min(drivers, key=lambda i: volumes[i][1] / volumes[i][0])
    loss, tissue = 1.0 - volumes[most][1] / volumes[most][0], before.tissues[most].name
    if loss <= EMPTIED or any(_touching(image.mask(most)) for image in (before, after)):
        return []
    text = (
        f"'{tissue}' shrinks by {loss:.0%} from 'before' to '{name}': is 'before' the relaxed state? If '{name}' is,"
        " exchange the two images."
    )
    return [Finding("relaxed-state", text, tissue, f"to '{name}' ({loss:.0%})")]


def _moving_void(before: Segmentation, after: Segmentation, i: int, name: str) -> list[Finding]:
    """A void inside the body, such as a rectum, whose wall moves although the model does not move it."""
    tissue, mask = before.tissues[i], before.mask(i)
    if tissue.role is not Role.VOID or not mask.any() or not after.mask(i).any():
        return []
    if _touching(mask) > VOID_INSIDE * (sum(_faces(mask)) + _touching(mask)):
        return []  # the air around the body
    motion, voxel = wall_motion(before, after, i), float(max(before.grid.spacing.max(), after.grid.spacing.max()))
    if motion <= VOID_STILL * STILL_VOXELS * voxel:
        return []
    text = (
        f"The surface of '{tissue.name}' moves by {motion:.2g} mm from 'before' to '{name}', but the role void does not"
        " prescribe that motion. If it is a hollow organ that fills or moves, give it the role driver; air that follows"
        " its surroundings may stay void."
    )
    return [Finding("void-moves", text, tissue.name, f"to '{name}' ({motion:.2g} mm)")]
