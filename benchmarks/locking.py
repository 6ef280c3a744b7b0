"""The error of a modulus by locking: a stiff inclusion, fitted with each element at rising Poisson's ratios.

    python benchmarks/locking.py [--finest 24] [--ratios 0.3,0.45,0.49,0.4999] [--json]

A unit cube (modulus 1 kPa, the side z = 0 pushed in by a bump of 0.05, the sides held, the top free) holds a cube of
half its edge (3 kPa) and a soft slab on top (0.4 kPa). The displacement on the inclusion's surface is extrapolated
from three meshes (P2-P0, edge 1/8, 1/16, 1/finest, by the observed rate; a quarter of the cube, for its symmetry) and
is what the inclusion's modulus is fitted to with every element on coarser meshes: 4 and 8 elements across. Simulated.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import brentq, least_squares
from scipy.spatial import cKDTree

from palpate.images import Role, Tissue
from palpate.mechanics import ELEMENTS, LinearModel, linear_model
from palpate.mesh import Constraint, LagrangeSpace, lagrange_space
from palpate_validation.structured_meshes import box_mesh

Array = NDArray[np.float64]

TRUTH = np.array([1.0, 3.0, 0.4])
TINY = 1e-9


def model_of(n: int, poisson_ratio: float, element: str) -> LinearModel:
    """The model of the quarter x, y < 1/2 of the cube with edges 1 / n."""
    named = zip(("block", "inclusion", "slab"), TRUTH.tolist(), strict=True)
    tissues = [
        Tissue(name, Role.KNOWN, poisson_ratio=poisson_ratio, youngs_modulus_kpa=modulus) for name, modulus in named
    ]
    unit = box_mesh((n // 2, n // 2, n))
    mesh = replace(unit, nodes=unit.nodes * [0.5, 0.5, 1.0], tissues=tuple(tissues))
    centre = mesh.nodes[mesh.tets].mean(axis=1)
    inside = (centre[:, 0] < 0.25) & (centre[:, 1] < 0.25) & (np.abs(centre[:, 2] - 0.5) < 0.25)
    mesh = replace(mesh, region=np.where(inside, 1, np.where(centre[:, 2] > 0.75, 2, 0)))
    space = lagrange_space(mesh, ELEMENTS[element].space)
    return linear_model(space, constraint_of(space), dilatation=ELEMENTS[element].dilatation)


def constraint_of(space: LagrangeSpace) -> Constraint:
    """Symmetry on x = 0 and y = 0, the other sides and the floor held, a bump pushed into the floor."""
    p, floor = space.points, space.points[:, 2] < TINY
    held = np.repeat((floor | (p[:, :2] > 0.5 - TINY).any(axis=1))[:, None], 3, axis=1)
    held[:, :2] |= p[:, :2] < TINY
    offset = np.zeros_like(p)
    offset[floor, 2] = 0.05 * np.prod(np.cos(np.pi * p[floor, :2]) ** 2, axis=1)
    free = sparse.csr_matrix(sparse.identity(held.size, format="csr")[:, ~held.ravel()])
    return Constraint(free=free, modes=np.zeros((held.size, 0)), offset=offset.ravel())


def observed(model: LinearModel, modulus: float) -> Array:
    """Displacement at the places of a grid of 1/8 on the inclusion's surface."""
    grid = np.stack(np.meshgrid(*[np.arange(3) / 8] * 2, np.arange(2, 7) / 8, indexing="ij"), axis=-1).reshape(-1, 3)
    shell = (grid[:, :2].max(axis=1) > 0.25 - TINY) | (np.abs(grid[:, 2] - 0.5) > 0.25 - TINY)
    _, places = cKDTree(model.space.points).query(grid[shell])
    u = model.solve(np.array([TRUTH[0], modulus, TRUTH[2]]), np.zeros(0)).displacement
    return np.asarray(u[places].ravel())


def reference(poisson_ratio: float, finest: int) -> tuple[Array, float]:
    """Extrapolated displacement, and how far the finest mesh is from it (relative)."""
    sizes = (8, 16, finest)
    a, b, c = (observed(model_of(n, poisson_ratio, "P2-P0"), TRUTH[1]) for n in sizes)
    wanted, h = np.linalg.norm(b - a) / np.linalg.norm(c - b), 1.0 / np.array(sizes)
    rate = brentq(lambda p: (h[0] ** p - h[1] ** p) / (h[1] ** p - h[2] ** p) - wanted, 0.2, 6.0)
    exact = c + (c - b) * h[2] ** rate / (h[1] ** rate - h[2] ** rate)
    return exact, float(np.linalg.norm(exact - c) / np.linalg.norm(exact))


def fitted_error(model: LinearModel, data: Array) -> float:
    """Relative error of the inclusion's modulus in the least-squares fit of ln E."""

    def residuals(theta: Array) -> Array:
        """Of displacements, relative."""
        return np.asarray((observed(model, float(np.exp(theta[0]))) - data) / np.linalg.norm(data))

    found = least_squares(residuals, np.log(TRUTH[1:2]), diff_step=[1e-3], xtol=1e-5, ftol=1e-10)
    return float(np.exp(found.x[0]) / TRUTH[1] - 1.0)


def main() -> None:
    """Print a row for each Poisson's ratio, element and mesh."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--finest", type=int, default=24)
    parser.add_argument("--ratios", default="0.3,0.45,0.49,0.4999")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    rows = []
    for nu in map(float, asked.ratios.split(",")):
        data, gap = reference(nu, asked.finest)
        for element in ("P1", "P2", "P2-P0", "auto"):
            for n in (8, 16):
                error = fitted_error(model_of(n, nu, element), data)
                rows.append({"nu": nu, "element": element, "across": n // 2, "modulus_error": error})
                rows[-1]["reference_gap"] = gap
                if not asked.json:
                    print(f"nu {nu:<7g} {element:6s} {n // 2} across: {100 * error:+10.2f} %", flush=True)
    if asked.json:
        print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
