"""The mesh of a reference state, with the case's edge length or a shorter one where that mesh fails its check."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from palpate.body.cost import expected_cost, lack_of_memory
from palpate.body.edge_length import EdgeLength, case_domain, edge_length_of
from palpate.case.case import Case
from palpate.errors import GeometryError, ResourceError
from palpate.findings import Finding
from palpate.images.distance import smoothing_width
from palpate.images.segmentation import Segmentation
from palpate.mesh.anatomy import Anatomy, Box, anatomy_of
from palpate.mesh.quality import MeshQuality, check_mesh
from palpate.mesh.tet_mesh import TetMesh
from palpate.mesh.tetrahedralise import tetrahedralise
from palpate.progress import Progress

FINER = 0.75  # factor on an edge length whose mesh fails, for the next attempt
FINER_MESHES = 2  # largest number of further attempts
THIN_VOXELS = 4  # thickness along an axis, below which a tissue is thin


@dataclass(frozen=True, slots=True)
class ReferenceMesh:
    """A mesh that has passed its gate, its edge length at the organs with its reason, and what is found of it.

    One that is given has no edge length of ours.
    """

    mesh: TetMesh
    quality: MeshQuality
    edge_length: EdgeLength | None = None
    findings: tuple[Finding, ...] = ()


def mesh_reference(
    before: Segmentation, after: tuple[Segmentation, ...], case: Case, *, progress: Progress
) -> ReferenceMesh:
    """Mesh `before` as far as it goes, or the case's margin, with the edge length of `edge_length_of`.

    A mesh that fails its quality check, or that Mmg gives up, is followed by one of 0.75 times the edge length. This is
    done at most twice, and only if the memory suffices for an estimate on it; the finding "finer-mesh" says so. Raises
    `GeometryError` when none is fit, `ResourceError` where the mesher stops for want of memory.
    """
    box = case_domain(before, case)
    chosen = edge_length_of(case, before, after)
    asked = chosen.mm
    refuse_edge(asked, box)
    progress(f"surfaces of {len(before.tissues)} tissues in {np.round(box.lengths).astype(int).tolist()} mm")
    width = smoothing_width(before.grid, *(image.grid for image in after))
    anatomy = anatomy_of(before, box=box, smoothing_mm=width)
    edges = [round(asked * FINER**number, 3) for number in range(FINER_MESHES + 1)]
    failure: GeometryError | None = None
    for edge in edges:
        finer = replace(case, mesh=replace(case.mesh, edge_length_mm=edge))
        lack = lack_of_memory(expected_cost(finer, before, after, n_pairs=1)) if failure else ""
        if lack:
            raise GeometryError(f"{failure}; a mesh of {edge:g} mm was not tried: {lack}") from failure
        lengths = edge_length_of(finer, before, after) if failure else chosen
        why = f"because the previous mesh failed: {failure}" if failure else chosen.in_words
        progress(f"meshing at {edge:g} mm, {why}")
        try:
            mesh, quality = _fit_mesh(before, anatomy, lengths, progress)
        except GeometryError as error:
            failure = error
            continue
        if failure is None:
            return ReferenceMesh(mesh, quality, chosen)
        text = (
            f"A mesh with edges of {asked:g} mm failed its quality check, so one with edges of {edge:g} mm is used. The"
            f" results are not affected; set mesh.edge_length_mm = {edge:g} to save the attempt (log.txt says what"
            " failed)."
        )
        lengths = replace(lengths, reason=f"a mesh of {asked:g} mm failed its quality check")
        return ReferenceMesh(mesh, quality, lengths, (Finding("finer-mesh", text, place=f"with {edge:g} mm"),))
    raise type(failure or GeometryError())(
        f"no mesh passes its quality check, neither with mesh.edge_length_mm = {asked:g} nor with"
        f" {' and '.join(f'{edge:g}' for edge in edges[1:])} mm. With the last one, {failure}. Correct the labels at"
        " that place, or try another edge length"
    ) from failure


def refuse_edge(edge_mm: float, box: Box) -> None:
    """Raise `GeometryError` for an edge length that the domain has no room for."""
    if edge_mm >= float(box.lengths.min()):
        raise GeometryError(
            f"mesh.edge_length_mm is {edge_mm} mm; it must be less than the smallest side of the domain,"
            f" {box.lengths.min():.1f} mm"
        )


def _fit_mesh(
    before: Segmentation, anatomy: Anatomy, lengths: EdgeLength, progress: Progress
) -> tuple[TetMesh, MeshQuality]:
    """A mesh that passed its gate, with its quality; voxels are counted inside the domain."""
    try:
        mesh = tetrahedralise(anatomy, edge_length_mm=lengths.mm, longer_mm=lengths.longer_mm, progress=progress)
    except RuntimeError as error:  # Mmg's own words, which do not tell a lack of memory from a bad surface
        raise ResourceError(
            f"the mesher stopped ({error}), most likely because memory ran out; make mesh.edge_length_mm larger, or"
            ' the domain smaller (domain.extent = "margin")'
        ) from error
    progress("checking the quality of the mesh")
    # voxels of each tissue, a layer of the image at a time, by their share inside: exact for a box along the grid
    counts, lengths_mm = np.zeros(len(before.tissues)), anatomy.box.lengths
    size = np.abs(before.grid.affine[:3, :3].T @ anatomy.box.axes.T).sum(axis=0)
    for i, layer in enumerate(before.index):
        places = np.argwhere(np.ones(layer.shape, dtype=bool))
        local = anatomy.box.local(before.grid.world(np.column_stack([np.full(len(places), float(i)), places])))
        share = np.clip(0.5 + np.minimum(local, lengths_mm - local) / size, 0.0, 1.0).prod(axis=1)
        counts += np.bincount(layer.ravel(), share, minlength=len(counts))
    volumes, thin = dict[str, float](), list[str]()
    for i, tissue in enumerate(before.tissues):
        if tissue.meshed:
            mask = before.mask(i)
            volumes[tissue.name] = float(counts[i]) * before.grid.voxel_volume
            spans = [np.flatnonzero(mask.any(axis=tuple({0, 1, 2} - {a}))) for a in range(3)]
            if min(span[-1] - span[0] + 1 for span in spans if len(span)) < THIN_VOXELS:
                thin.append(tissue.name)
    return mesh, check_mesh(mesh, anatomy, voxel_volumes=volumes, thin=tuple(thin), image=before)
