"""The states of a body that a case names: from its images or its phantom."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from palpate.body.imaged import ImagedStates, aligned
from palpate.body.meshed_body import mesh_states, with_prescribed
from palpate.body.provenance import file_digest, input_digests
from palpate.body.refusals import refuse_large, refuse_still, refuse_what_cannot_be_estimated, require_samples
from palpate.case.case import Case
from palpate.case.schema import nearest, shown
from palpate.case.sources import ImagePair
from palpate.errors import ConfigurationError
from palpate.images.body_in_ct import outside_body
from palpate.images.label_table import read_label_table
from palpate.images.readers import read_intensities, read_label_image
from palpate.images.readers.registry import format_of
from palpate.images.run_report import segmented_otherwise
from palpate.images.segmentation import Segmentation, segment
from palpate.images.tissue import Tissue
from palpate.observation.contract import DataSource
from palpate.observation.registry import read_source
from palpate.phantoms.pelvis import PelvisOptions, pelvis, pelvis_anatomy
from palpate.phantoms.scene import Scene
from palpate.phantoms.spheres import SpheresOptions, spheres, spheres_anatomy
from palpate.progress import Progress, silent


@dataclass(frozen=True, slots=True)
class CaseImages:
    """The states of every pair of a case, aligned and checked; inputs: SHA-256 of each file by its key."""

    pairs: tuple[ImagedStates, ...]
    inputs: Mapping[str, str]


def read_case_images(case: Case, *, progress: Progress = silent) -> CaseImages:
    """All that an estimate reads, after which it refuses nothing for which no mesh is needed.

    Raises `ConfigurationError` where nothing can move or tissues do not fit the images, `InputDataError` for files that
    cannot be used, `GeometryError` for organs that cannot be meshed, `ResourceError` where a library is missing.
    """
    refuse_what_cannot_be_estimated(case)
    require_samples(case)
    pairs = read_pairs(case, progress=progress)
    refuse_still(case, *((pair.before, [later.bones for later in pair.later]) for pair in pairs))
    return CaseImages(pairs, input_digests(case, *(pair.inputs for pair in pairs)))


def read_states(case: Case, *, progress: Progress = silent) -> ImagedStates:
    """Segmentations of the first reference state and of its later states, aligned and checked.

    Raises `InputDataError` for images that cannot be used, `ConfigurationError` for tissues that do not fit them.
    """
    if case.phantom is not None:
        scene = phantom_scene(case)
        after = (segment(scene.after, scene.tissues),)
        return aligned(segment(scene.before, scene.tissues), after, method=case.align, loaded=bool(case.loads))
    if case.body is not None:
        states = mesh_states(case.body, case, progress=progress)
        return with_prescribed(_with_measured(states, case, progress=progress), case)
    if case.images is None:
        raise ConfigurationError(f"case '{case.id}' has neither [images] nor [phantom]")
    return _read_pair(case, case.image_pairs[0], progress=progress)


def read_pairs(case: Case, *, progress: Progress = silent) -> tuple[ImagedStates, ...]:
    """The same of every pair of a case."""
    further = (_read_pair(case, pair, progress=progress) for pair in case.image_pairs[1:])
    return (read_states(case, progress=progress), *further)


def read_segmentation(
    case: Case, path: Path, names: Mapping[int, str] | None, tissues: tuple[Tissue, ...] | None
) -> Segmentation:
    """One image in the tissues of the case.

    `names`: the label table (label -> name), if the case has one; an image that brings its own names is read by those.
    `tissues`: those of the reference image, for an image without names. Raises as `read_states` does.
    """
    images, grey = case.images, None  # of the state that the label image shows
    if images is not None:
        later = dict(zip(images.after, images.intensities_after, strict=False))
        grey = images.intensities_before if path == images.before else later.get(path)
    on = grey if format_of(path).read_on is not None else None  # for files that may lack their grid
    image = read_label_image(path, names=names, grid=None if on is None else read_intensities(on)[1])
    if images is not None and images.body_from_ct:  # label 0 inside the body as one that no tissue claims
        body = image.labels == 0
        if grey is not None:
            body &= ~outside_body(*read_intensities(grey), image.grid)
        claimed = [label for tissue in case.resolve_tissues(image.names) for label in tissue.labels]
        number = 1 + max(int(image.labels.max()), *claimed)
        image = replace(image, labels=np.where(body, np.int32(number), image.labels))
    found = segment(image, case.resolve_tissues(image.names) if tissues is None or image.names else tissues)
    refuse_large(found, path)
    return found


def phantom_scene(case: Case) -> Scene:
    """The scene of a case's [phantom] and [motion], its truth as the case's tissues state it.

    Raises `ConfigurationError` when the case has no phantom, or tissues that its phantom has not.
    """
    if case.phantom is None:
        raise ConfigurationError(f"case '{case.id}' has no [phantom]")
    pelvic = case.phantom.kind == "pelvis"
    options = PelvisOptions(case.phantom.seed) if pelvic else SpheresOptions(case.phantom.seed)
    anatomy = pelvis_anatomy(options) if isinstance(options, PelvisOptions) else spheres_anatomy(options)
    own = {tissue.name: tissue for tissue in anatomy.tissues}
    for tissue in case.tissues:
        if tissue.name not in own:
            raise ConfigurationError(f"the phantom has no tissue '{tissue.name}': {nearest(tissue.name, own)}")
        role = own[tissue.name].role
        if tissue.role is not role or tissue.label != tissue.name:
            raise ConfigurationError(
                f"the phantom's tissue '{tissue.name}' has the role {role} and its own name as label; the case cannot"
                f" give it the role {tissue.role} and the label {shown(tissue.label)}"
            )
    meshed = tuple(tissue for tissue in case.tissues if own[tissue.name].meshed)
    options = replace(
        options,
        law=case.phantom.law or case.mechanics.law,
        law_parameters=case.mechanics.law_parameters,
        moduli_kpa={t.name: t.modulus_kpa for t in meshed if t.modulus_kpa is not None},
        poisson_ratio={t.name: t.poisson_ratio for t in meshed if t.poisson_ratio is not None},
    )
    if isinstance(options, PelvisOptions):
        return pelvis(replace(options, filling_mm=case.motion.filling_mm) if case.motion else options)
    return spheres(replace(options, push_mm=case.motion.filling_mm) if case.motion else options)


def measured(case: Case, states: ImagedStates) -> tuple[tuple[DataSource, ...], dict[str, str]]:
    """The [[data]] of the later states, brought to the first image, and the digests of their files.

    Raises `InputDataError` for files that cannot be used, or that the images contradict.
    """
    found, digests, numbered = [], {}, {later.number: later for later in states.later}
    for number, file in enumerate(case.data_files):
        if (later := numbered.get(file.state)) is None:
            continue
        source = read_source(file)
        for part, digest in enumerate(source.digests):
            digests[f"data[{number}]" + (f".{part}" if part else "")] = digest
        source = source.brought(later.alignment.motion) if later.alignment else source
        if later.image is not None:
            source.against(states.before, later.image)
        found.append(source)
    return tuple(found), digests


def _read_pair(case: Case, pair: ImagePair, *, progress: Progress) -> ImagedStates:
    """One pair of a case."""
    table = case.images.names if case.images else None
    names = read_label_table(table) if table else None
    reference = read_segmentation(case, pair.before, names, None)
    later = tuple(read_segmentation(case, path, names, reference.tissues) for path in pair.after)
    first, loaded = pair.numbers.start, bool(case.loads)
    states = aligned(reference, later, method=case.align, first=first, loaded=loaded, progress=progress)
    states = replace(states, findings=(*states.findings, *segmented_otherwise(pair.before, pair.after)))
    inputs = {"names": names.sha256} if names else {}
    for (key, path), image in zip(pair.paths.items(), (reference, *later), strict=True):
        digests = image.digests or {"": file_digest(path)}  # a reader from elsewhere may not say what it read
        inputs |= {f"{key}.{part}" if part else key: digest for part, digest in digests.items()}
    return _with_measured(replace(states, inputs=inputs), case, progress=progress)


def _with_measured(states: ImagedStates, case: Case, *, progress: Progress) -> ImagedStates:
    """The states with their measurements."""
    data, digests = measured(case, states)
    for source in data:
        progress(f"{source.file.name}: {source.in_words}")
    return replace(states, inputs={**states.inputs, **digests}, data=data)
