"""NetCDF 4: the moduli's posterior samples in the groups that ArviZ and xarray know (dims chain, draw, tissue)."""

from __future__ import annotations

import io
from importlib import import_module
from pathlib import Path

import numpy as np

from palpate.errors import ResourceError
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.export.formats import Options
from palpate.export.samples import CHAINS, DRAWS, moduli_samples
from palpate.study.outputs import write_bytes

__all__ = ["write"]


def write(model: FittedModel, body: FittedBody, folder: Path, options: Options) -> None:
    """Write posterior.nc: groups posterior, sample_stats, constant_data; `ResourceError` without the extra `netcdf`."""
    del body, options
    try:
        h5netcdf = import_module("h5netcdf")
    except ImportError as error:
        raise ResourceError(
            "NetCDF is written by h5netcdf, which is not installed: pip install 'palpate[netcdf]'; without it, export"
            " to csv holds the same samples"
        ) from error
    samples, unit = moduli_samples(model), "kPa" if model.unit == "kPa" else f"ratio to {model.relative_to}"
    given = [item.interval95 if model.unit == "kPa" else item.ratio_interval95 for item in model.estimates]
    ends = np.array([[np.nan if end is None else end for end in pair or (None, None)] for pair in given])
    memory = io.BytesIO()
    with h5netcdf.File(memory, "w") as file:
        file.attrs["created_by"] = "Palpate"
        for name in ("posterior", "sample_stats", "constant_data"):
            group = file.create_group(name)
            axes = {} if name == "constant_data" else {"chain": CHAINS, "draw": DRAWS}
            group.dimensions = {"tissue": len(samples.tissues), **axes}
            tissue = group.create_variable("tissue", ("tissue",), h5netcdf.core.h5py.string_dtype())
            tissue[:] = np.array(samples.tissues, dtype=object)
            for axis, count in axes.items():
                group.create_variable(axis, (axis,), data=np.arange(count))
        moduli = file["posterior"].create_variable("youngs_modulus", ("chain", "draw", "tissue"), data=samples.moduli)
        moduli.attrs["units"], moduli.attrs["kind"] = unit, "linearised: log-normal about the estimate"
        file["sample_stats"].create_variable("lp", ("chain", "draw"), data=samples.log_density)
        for name, values in (("interval95_low", ends[:, 0]), ("interval95_high", ends[:, 1])):
            variable = file["constant_data"].create_variable(name, ("tissue",), data=values)
            variable.attrs["units"], variable.attrs["interval_probability"] = unit, 0.95
    write_bytes(folder / "posterior.nc", memory.getvalue())
