"""Mmg's remeshing: better tetrahedra of the wanted size, the surfaces between regions kept."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from mmgpy import MmgMesh3D
from numpy.typing import NDArray

from palpate.errors import GeometryError, ResourceError
from palpate.mesh.anatomy import Box
from palpate.mesh.cutting import Grid
from palpate.mesh.tet_mesh import FACES

# Mmg allocates memory for millions of tetrahedra and visits all of it repeatedly, half a second for each mesh. Small
# meshes get less memory, with the same result: 17 000 tetrahedra need 40 MB.
SMALL_TETS = 20_000
LEAST_MB, MB_A_TET = 64, 0.01
HOLLOW_REFERENCE = 8  # references 1 to 6 are the faces of the box, 8 any hollow tissue, the rest pairs of regions


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold SIGINT and SIGTERM while the block works, then let them reach the handlers that were there before.

    Mmg installs handlers of its own, which leave the process at once, and leaves them behind. Where another thread of
    the process could take the signal, it is not held: Mmg then ends the process, with exit code 1. The command line
    starts the threads of the linear algebra so that they never take one. Does nothing in other than the main thread.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM)
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, numbers if _others_take_none(numbers) else ())
    handlers = {number: signal.getsignal(number) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if handler is not None:  # None: no handler of Python, which cannot be restored here
                signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, earlier)


def _others_take_none(numbers: tuple[signal.Signals, ...]) -> bool:
    """Whether every other thread, libraries' own included, blocks the signals; False where the system cannot tell."""
    mask = sum(1 << (number - 1) for number in numbers)
    try:
        others = [task for task in Path("/proc/self/task").iterdir() if task.name != str(threading.get_native_id())]
        statuses = [(task / "status").read_text(encoding="ascii", errors="replace") for task in others]
        blocked = [int(status.partition("\nSigBlk:")[2].split()[0], 16) for status in statuses]  # a bit a signal
    except (OSError, ValueError, IndexError):
        return False
    return all(bits & mask == mask for bits in blocked)


def remeshed(grid: Grid, sizes: NDArray[np.float64], *, box: Box, sag_mm: float) -> Grid:
    """The same regions in tetrahedra of edge length `sizes` (n_nodes,) mm, by Mmg (Dapogny, Dobrzynski, Frey 2014).

    Surfaces move by no more than about `sag_mm`. Raises `GeometryError` when Mmg gives up, `ResourceError` when
    it has no memory for what it is given.
    """
    mesh = MmgMesh3D()
    corners = grid.nodes[grid.tets]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    wanted = 6.0 * np.sqrt(2.0) * np.sum(volumes / sizes[grid.tets].mean(axis=1) ** 3)  # regular tetrahedra
    most = max(len(grid.tets), wanted)
    if most < SMALL_TETS:
        with suppress(RuntimeError), interrupts_held(), _silent():  # an empty mesh, which is refused; the limit stays
            mesh.remesh(mem=int(LEAST_MB + MB_A_TET * most), verbose=-1)
    triangles, references = _surfaces(grid, box)
    # where two faces of the box meet, or one meets a hollow tissue, Mmg must keep the edge sharp
    border = references <= HOLLOW_REFERENCE
    edges = np.sort(triangles[border][:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2), axis=1)
    kinds = np.unique(np.column_stack([edges, np.repeat(references[border], 3)]), axis=0)
    unique, count = np.unique(kinds[:, :2], axis=0, return_counts=True)
    ridges = unique[count > 1]
    n_nodes, n_tets = len(grid.nodes), len(grid.tets)
    try:
        with _silent():
            mesh.set_mesh_size(vertices=n_nodes, tetrahedra=n_tets, triangles=len(triangles), edges=len(ridges))
        mesh.set_vertices(grid.nodes)
        mesh.set_tetrahedra(grid.tets.astype(np.int32), (grid.region + 1).astype(np.int32))
        mesh.set_triangles(triangles.astype(np.int32), references.astype(np.int32))
        mesh.set_edges(ridges.astype(np.int32))
        mesh.set_ridge_edges(np.arange(len(ridges), dtype=np.int32))
        mesh["metric"] = sizes[:, None]
    except RuntimeError as error:
        raise ResourceError(
            f"the mesher has no memory for {n_tets} tetrahedra ({error}); make mesh.edge_length_mm larger, or end other"
            " programs"
        ) from error
    try:
        with interrupts_held(), _silent():
            mesh.remesh(
                hmin=0.4 * float(sizes.min()),
                hmax=1.2 * float(sizes.max()),
                hausd=sag_mm,
                hgrad=1.4,
                angle=0,
                verbose=-1,
            )
    except RuntimeError as error:
        raise GeometryError(
            f"Mmg could not improve a mesh of {n_tets} tetrahedra ({error}); try another mesh.edge_length_mm"
        ) from error
    tets, region = mesh.get_tetrahedra_with_refs()
    return compact(np.array(mesh.get_vertices()), np.array(tets, dtype=np.int64), np.array(region, dtype=np.int64) - 1)


def compact(nodes: NDArray[np.float64], tets: NDArray[np.int64], region: NDArray[np.int64]) -> Grid:
    """A grid without the nodes that no tetrahedron uses: nodes (n, 3) mm, tets (n_tets, 4), region (n_tets,)."""
    used, tets = np.unique(tets, return_inverse=True)
    return Grid(nodes[used], tets.reshape(-1, 4), region)


def _surfaces(grid: Grid, box: Box) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces (n, 3) between regions and on the border, with Mmg's reference (n,) of the surface they belong to."""
    faces = grid.tets[:, FACES].reshape(-1, 3)
    regions = np.repeat(grid.region, 4)
    order = np.lexsort(np.sort(faces, axis=1).T)
    same = np.zeros(len(order), dtype=bool)
    ordered = np.sort(faces, axis=1)[order]
    same[:-1] = (ordered[1:] == ordered[:-1]).all(axis=1)
    second = np.zeros(len(order), dtype=bool)
    second[1:] = same[:-1]
    pair = np.flatnonzero(same)
    pair = pair[regions[order[pair]] != regions[order[pair + 1]]]
    a, b = regions[order[pair]], regions[order[pair + 1]]
    code = 10 + np.minimum(a, b) * (regions.max() + 1) + np.maximum(a, b)
    border = order[~same & ~second]
    triangles = np.concatenate([faces[order[pair]], faces[border]])
    on = box.faces_of(grid.nodes[faces[border]])
    return triangles, np.concatenate([code, np.where(on.any(axis=1), 1 + on.argmax(axis=1), HOLLOW_REFERENCE)])


@contextmanager
def _silent() -> Iterator[None]:
    """Keep what the C library writes to the process's standard streams away from the user's terminal."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    with Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            for stream, copy in enumerate(kept, start=1):
                os.dup2(copy, stream)
                os.close(copy)
