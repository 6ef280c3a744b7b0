"""Samples of the moduli's posterior, and NetCDF 4 in the groups of ArviZ and xarray (dims chain, draw, tissue)."""

from __future__ import annotations

import io
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ResourceError
from palpate.export.fitted_model import FittedBody, FittedModel
from palpate.statement.samples import POSTERIOR
from palpate.study.outputs import write_bytes

DRAWS = 4000
SEED = 0
LINEARISED = "linearised: independent draws, log-normal about the estimate"
SAMPLED = "sampled: independent draws of the posterior, over all explanations of the images"
PROBABILITY = 0.95


@dataclass(frozen=True, slots=True)
class Samples:
    """Independent moduli (draws, n) of n `tissues` in the model's unit; kind: what they are, in words."""

    tissues: tuple[str, ...]
    moduli: NDArray[np.float64]
    kind: str


def moduli_samples(model: FittedModel) -> Samples:
    """The model's own draws; without any, draws with ln E normal about the estimates under their covariance."""
    if model.samples is not None:
        return Samples(model.samples.tissues, model.samples.moduli, SAMPLED)
    centre = np.log([item.value if model.unit == "kPa" else item.ratio for item in model.estimates])  # type: ignore
    normal = np.random.default_rng(SEED).standard_normal((DRAWS, len(centre)))
    values, vectors = np.linalg.eigh(model.covariance)
    logarithms = centre + (normal * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return Samples(tuple(item.tissue for item in model.estimates), np.exp(logarithms), LINEARISED)


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write posterior.nc: groups posterior and constant_data; `ResourceError` without the extra `netcdf`."""
    del body
    write_posterior(model, folder / POSTERIOR)


def write_posterior(model: FittedModel, path: Path) -> None:
    """Write the samples of a model to `path`; raises as `write` does."""
    try:
        h5netcdf = import_module("h5netcdf")
    except ImportError as error:
        raise ResourceError(
            "NetCDF is written by h5netcdf, which is not installed: pip install 'palpate[netcdf]'; the export to csv"
            " holds the same samples"
        ) from error
    samples, unit = moduli_samples(model), "kPa" if model.unit == "kPa" else f"ratio to {model.relative_to}"
    draws, n = samples.moduli.shape
    memory = io.BytesIO()
    with h5netcdf.File(memory, "w") as file:
        file.attrs["created_by"] = "Palpate"
        for name in ("posterior", "constant_data"):
            group = file.create_group(name)
            axes = {} if name == "constant_data" else {"chain": 1, "draw": draws}  # independent: they are one chain
            group.dimensions = {"tissue": n, **axes}
            tissue = group.create_variable("tissue", ("tissue",), h5netcdf.core.h5py.string_dtype())
            tissue[:] = np.array(samples.tissues, dtype=object)
            for axis, count in axes.items():
                group.create_variable(axis, (axis,), data=np.arange(count))
        of_draws = ("chain", "draw", "tissue")
        moduli = file["posterior"].create_variable("youngs_modulus", of_draws, data=samples.moduli[None])
        moduli.attrs["units"], moduli.attrs["kind"] = unit, samples.kind
        given = [item.interval95 if model.unit == "kPa" else item.ratio_interval95 for item in model.estimates]
        ends = np.array([[np.nan if end is None else end for end in pair or (None, None)] for pair in given])
        constants = {"interval95_low": ends[:, 0], "interval95_high": ends[:, 1]}
        if model.samples is not None:  # their own intervals
            own = model.samples.interval95
            constants |= {"samples_interval95_low": own[:, 0], "samples_interval95_high": own[:, 1]}
        for name, values in constants.items():
            variable = file["constant_data"].create_variable(name, ("tissue",), data=values)
            if "interval95" in name:
                variable.attrs["units"], variable.attrs["interval_probability"] = unit, PROBABILITY
    write_bytes(path, memory.getvalue())
