"""Findings on organs beside each other in the images: how much surface they share, and how far it moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from palpate.findings import Finding, listing
from palpate.images.checks import STILL_VOXELS, later_names, wall_motion
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role

BEHIND, IN_FRONT = ("sacrum", "coccyx"), ("prostate", "bladder")  # in every pelvis
PRESCRIBED = (Role.DRIVER, Role.RIGID)
LITTLE_OBSERVED = 0.5


def contact_findings(segmentation: Segmentation) -> tuple[Finding, ...]:
    """A finding for each `estimate` tissue of which much touches a driver, a bone or the image's border.

    Such faces are prescribed or cut, and are left out of the observation, as `observed_surface` does on the mesh. It
    refuses a tissue of whose surface less than a tenth is left.
    """
    faces = _shared_faces(segmentation)
    tissues = segmentation.tissues
    findings = []
    for i, tissue in enumerate(tissues):
        total = float(faces[i].sum() - faces[i, i])
        if tissue.role is not Role.ESTIMATE or not total:
            continue
        held = {
            f"'{tissues[j].name}'": faces[i, j] / total for j in range(len(tissues)) if tissues[j].role in PRESCRIBED
        }
        held["the image's border"] = faces[i, -1] / total
        shares = {name: share for name, share in held.items() if share >= 0.01}
        left = 1.0 - sum(held.values())
        if not shares or left > 1.0 - LITTLE_OBSERVED / 5.0:
            continue
        words = [f"{name} ({share:.0%})" for name, share in shares.items()]
        rest = (
            f"; those faces say nothing about its stiffness, so {left:.0%} of its surface is observed. Nothing needs to"
            " be done: the interval allows for it."
        )
        text = listing(f"'{tissue.name}' touches ", words, rest)
        findings.append(Finding("touching", text, tissue.name, "in 'before'"))
    return tuple(findings)


def motion_findings(
    before: Segmentation, after: Segmentation, name: str, *, loaded: bool = False
) -> tuple[Finding, ...]:
    """A finding for the image called `name` when no driver's or bone's surface moves in it by more than the noise.

    `loaded`: known loads act, which move the organs themselves, so theirs count, too.
    """
    moving = (Role.DRIVER, Role.RIGID, Role.ESTIMATE) if loaded else (Role.DRIVER, Role.RIGID)
    movers = [i for i, tissue in enumerate(before.tissues) if tissue.role in moving]
    voxel = float(max(before.grid.spacing.max(), after.grid.spacing.max()))
    motions = {before.tissues[i].name: wall_motion(before, after, i) for i in movers}
    if not motions or max(motions.values()) > STILL_VOXELS * voxel:
        return ()
    words = [f"'{tissue}' {motion:.2g} mm" for tissue, motion in motions.items()]
    rest = (
        f". That is no more than voxels of {voxel:.2g} mm can show, so intervals will be wide: use a pair with a larger"
        f" {'load' if loaded else 'motion'}."
    )
    text = listing(f"Almost nothing moves from 'before' to '{name}'; mean motion of the surfaces: ", words, rest)
    return (Finding("motion-below-noise", text, place=f"to '{name}'"),)


def sides_findings(segmentation: Segmentation, name: str) -> tuple[Finding, ...]:
    """A finding when tissues or labels called left lie to the right (+x, RAS) of their namesakes called right."""
    middles = {called.lower(): place for called, place in _middles(segmentation, ("left", "right"), axis=0).items()}
    twins = [(left, left.replace("left", "right")) for left in middles if "left" in left]
    wrong = [left for left, right in twins if right in middles and middles[left] > middles[right]]
    if not wrong:
        return ()
    rest = (
        " lies to the right of its namesake, so left and right are exchanged in the names or the header. The moduli are"
        " not affected, but check the image's orientation."
    )
    text = listing(f"In '{name}' ", [f"'{left}'" for left in wrong], rest)
    return (Finding("sides-exchanged", text, place=f"in '{name}'"),)


def front_findings(segmentation: Segmentation, name: str) -> tuple[Finding, ...]:
    """A finding when a sacrum lies in front (+y, RAS) of a prostate or bladder, as where a file is mirrored."""
    middles = _middles(segmentation, (*BEHIND, *IN_FRONT), axis=1)
    behind = [tissue for tissue in middles if any(word in tissue.lower() for word in BEHIND)]
    in_front = [tissue for tissue in middles if tissue not in behind]
    wrong = [(a, b) for a in behind for b in in_front if middles[a] > middles[b]]
    if not wrong:
        return ()
    text = (
        f"In '{name}' '{wrong[0][0]}' lies in front of '{wrong[0][1]}', so the file is mirrored front to back or its"
        " header is wrong. The moduli are not affected if all images are alike, but check their orientation."
    )
    return (Finding("front-exchanged", text, place=f"in '{name}'"),)


def _shared_faces(segmentation: Segmentation) -> NDArray[np.float64]:
    """Area (n, n + 1) mm^2 of voxel faces between tissues; the last column is the image's border."""
    n = len(segmentation.tissues)
    index, spacing = segmentation.index, segmentation.grid.spacing
    faces = np.zeros((n, n + 1))
    for axis in range(3):
        area = float(np.prod(spacing) / spacing[axis])
        along = np.moveaxis(index, axis, 0)
        differ = along[1:] != along[:-1]  # few do: only theirs are counted as wide integers
        low, high = (each[differ].astype(np.int64) for each in (along[:-1], along[1:]))
        both = np.bincount(low * n + high, minlength=n * n).reshape(n, n)
        faces[:, :n] += area * (both + both.T)
        for end in (0, -1):
            faces[:, n] += area * np.bincount(np.take(index, end, axis).ravel(), minlength=n)
    return faces


def _middles(segmentation: Segmentation, words: Sequence[str], *, axis: int) -> dict[str, float]:
    """World coordinate along an axis, mm, of the middle of each tissue and label whose name holds one of the words."""
    found = {called: float(place[axis]) for called, place in segmentation.middles.items()}
    for i, tissue in enumerate(segmentation.tissues):
        if any(word in tissue.name.lower() for word in words) and segmentation.mask(i).any():
            found[tissue.name] = float(segmentation.middle(i)[axis])
    return {called: place for called, place in found.items() if any(word in called.lower() for word in words)}


def every_finding(before: Segmentation, after: Sequence[Segmentation], *, loaded: bool = False) -> tuple[Finding, ...]:
    """Contacts of the reference state and motions of all later ones, named as `check_images` names them.

    `loaded`: as of `motion_findings`.
    """
    motions = [
        finding
        for name, image in zip(later_names(len(after)), after, strict=True)
        for finding in motion_findings(before, image, name, loaded=loaded)
    ]
    sides = (*sides_findings(before, "before"), *front_findings(before, "before"))
    return (*contact_findings(before), *sides, *motions)
