"""Our exports in other programs: CalculiX solves them, and readers of each format read them back.

    make export-check
    python benchmarks/export_check.py [--edge 12] [--only calculix,gmsh,...] [--json]

The demo's pelvis is estimated three times: linear with P2, neo-Hookean with P2 and with the default element; a body
that is turned in space and slides, under known loads, twice. Every line has a figure and its limit. A program that
is not installed has a line without a figure. The exit code is 5 where a figure exceeds its limit.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from export_calculix import calculix
from export_images import dicom, nifti, warp
from export_meshes import dolfinx, febio, gmsh, meshes
from export_rows import Results, Row, any_of, installed, missing
from export_turned import turned_result

import palpate
from palpate.demo import DATA

CASES = (("linear", "P2"), ("neo-hookean", "P2"), ("neo-hookean", "auto"))


def main() -> int:
    """Check all, print the table; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--edge", type=float, default=12.0, help="edge length at the organs, mm (default: %(default)s)")
    parser.add_argument("--only", default=",".join(PARTS), help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    wanted = arguments.only.split(",")
    rows: list[Row] = []
    results: Results = {}
    with tempfile.TemporaryDirectory() as folder:
        for law, element in CASES if "calculix" in wanted else CASES[1:2]:
            results[law, element] = estimated(law, element, arguments.edge)
        for law in ("linear", "neo-hookean") if "calculix" in wanted else ("linear",):
            results[law, "turned"] = turned_result(Path(folder) / f"turned-{law}", law)
        for name in wanted:
            for row in PARTS[name](results, Path(folder)):
                rows.append(row)
                print(f"{row.part}: {row.what}: {row.text}", file=sys.stderr, flush=True)
    if arguments.json:
        print(json.dumps([{**row.__dict__, "kept": row.kept} for row in rows], indent=1))
    else:
        print("| program | what | found | limit |\n|---|---|---|---|")
        for row in rows:
            print(f"| {row.part} | {row.what} | {row.text} | {row.limit:g} {row.unit} |")
    return 0 if all(row.kept for row in rows) else 5


def estimated(law: str, element: str, edge: float) -> palpate.CaseResult:
    """The demo's estimate under a law, with an element."""
    overrides = [f"mechanics.law={law}", f"mechanics.element={element}", f"mesh.edge_length_mm={edge}"]
    case = palpate.read_case(DATA / "demo.toml", [*overrides, "estimate.start_ratios=[2.0]"])
    return palpate.estimate(case, progress=lambda message: print(f"  {law} {element}: {message}", file=sys.stderr))


def netcdf(results: Results, folder: Path) -> Iterator[Row]:
    """Samples by xarray: their mean and spread are those of the result."""
    result, what = any_of(results), "posterior.nc: difference of a sample's log-mean, in standard deviations"
    xarray = installed("xarray")
    if xarray is None or installed("h5netcdf") is None:
        yield from missing("xarray", what)
        return
    palpate.export(result, folder / "netcdf", format="netcdf")
    samples = xarray.open_dataset(folder / "netcdf" / "posterior.nc", group="posterior", engine="h5netcdf")
    estimates = {item.tissue: item.value or np.nan for item in result.estimation.estimates}
    logs = np.log(samples["youngs_modulus"]).stack(sample=("chain", "draw"))
    expected = np.log([estimates[str(name)] for name in samples["tissue"].values])
    off = np.abs(logs.mean("sample").values - expected) / logs.std("sample").values
    yield Row("xarray", what, float(off.max()), 0.1)


PARTS: dict[str, Callable[[Results, Path], Iterator[Row]]] = {
    "calculix": calculix,
    "gmsh": gmsh,
    "meshes": meshes,
    "dolfinx": dolfinx,
    "febio": febio,
    "nifti": nifti,
    "warp": warp,
    "dicom": dicom,
    "netcdf": netcdf,
}

if __name__ == "__main__":
    sys.exit(main())
