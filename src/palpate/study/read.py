"""The states of a body that a case names: from its images or its phantom."""

from __future__ import annotations

from palpate.errors import ConfigurationError
from palpate.images.label_table import read_label_table
from palpate.images.readers import read_label_image
from palpate.images.segmentation import segment
from palpate.phantoms.pelvis import PelvisOptions, pelvis
from palpate.phantoms.scene import Scene
from palpate.phantoms.spheres import SpheresOptions, spheres
from palpate.study.body import ImagedStates, aligned
from palpate.study.case import Case

__all__ = ["phantom_scene", "read_states"]

FILLING_MM = 7.0


def read_states(case: Case) -> ImagedStates:
    """Segmentations of the reference state and of the later states, aligned and checked.

    Raises `InputDataError` for images that cannot be used, `ConfigurationError` for tissues that do not fit them.
    """
    if case.phantom is not None:
        scene = phantom_scene(case)
        after = (segment(scene.after, scene.tissues),)
        return aligned(segment(scene.before, scene.tissues), after, method=case.align)
    if case.images is None:
        raise ConfigurationError(f"case '{case.id}' has neither [images] nor [phantom]")
    names = read_label_table(case.images.names) if case.images.names else None
    before = read_label_image(case.images.before, names=names)
    tissues = case.resolve_tissues(before.names)
    later = tuple(segment(read_label_image(path, names=names), tissues) for path in case.images.after)
    return aligned(segment(before, tissues), later, method=case.align)


def phantom_scene(case: Case) -> Scene:
    """The scene of a case's [phantom] and [motion]; raises `ConfigurationError` when it has no phantom."""
    if case.phantom is None:
        raise ConfigurationError(f"case '{case.id}' has no [phantom]")
    filling = case.motion.filling_mm if case.motion else FILLING_MM
    if case.phantom.kind == "spheres":
        return spheres(SpheresOptions(seed=case.phantom.seed))
    return pelvis(PelvisOptions(seed=case.phantom.seed, filling_mm=filling))
