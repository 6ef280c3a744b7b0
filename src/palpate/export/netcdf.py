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
from palpate.study.outputs import write_bytes
from palpate.study.samples import POSTERIOR

DRAWS = 1000
SEED = 0
LINEARISED = "linearised: independent draws, log-normal about the estimate"
SAMPLED = "sampled: Markov chains around the estimate, stretched to the covariance of its interval"
PROBABILITY = 0.95


@dataclass(frozen=True, slots=True)
class Samples:
    """moduli (chains, draws, n) of n `tissues` in the model's unit; kind: what they are, in words.

    log_density (chains, draws): of their logarithms; of chains, of all unknowns and but for a constant.
    """

    tissues: tuple[str, ...]
    moduli: NDArray[np.float64]
    log_density: NDArray[np.float64] | None
    kind: str


def moduli_samples(model: FittedModel) -> Samples:
    """The model's own chains; without any, draws with ln E normal about the estimates under their covariance.

    The latter are independent, in chains for programs that compare chains.
    """
    if model.samples is not None:
        found = model.samples
        return Samples(found.tissues, found.moduli[None], None, SAMPLED)
    centre = np.log([item.value if model.unit == "kPa" else item.ratio for item in model.estimates])  # type: ignore
    n = len(centre)
    normal = np.random.default_rng(SEED).standard_normal((1, DRAWS, n))
    values, vectors = np.linalg.eigh(model.covariance)
    spread = np.sqrt(np.maximum(values, 0.0))
    logarithms = centre + (normal * spread) @ vectors.T
    scale = float(np.log(spread[spread > 0.0]).sum()) + 0.5 * n * np.log(2.0 * np.pi)
    density = -0.5 * (normal**2).sum(axis=2) - scale
    return Samples(tuple(item.tissue for item in model.estimates), np.exp(logarithms), density, LINEARISED)


def write(model: FittedModel, body: FittedBody, folder: Path) -> None:
    """Write posterior.nc: groups posterior, sample_stats, constant_data; `ResourceError` without the extra `netcdf`."""
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
    chains, draws, n = samples.moduli.shape
    memory = io.BytesIO()
    with h5netcdf.File(memory, "w") as file:
        file.attrs["created_by"] = "Palpate"
        for name in ("posterior", "sample_stats", "constant_data"):
            group = file.create_group(name)
            axes = {} if name == "constant_data" else {"chain": chains, "draw": draws}
            group.dimensions = {"tissue": n, **axes}
            tissue = group.create_variable("tissue", ("tissue",), h5netcdf.core.h5py.string_dtype())
            tissue[:] = np.array(samples.tissues, dtype=object)
            for axis, count in axes.items():
                group.create_variable(axis, (axis,), data=np.arange(count))
        moduli = file["posterior"].create_variable("youngs_modulus", ("chain", "draw", "tissue"), data=samples.moduli)
        moduli.attrs["units"], moduli.attrs["kind"] = unit, samples.kind
        if samples.log_density is not None:
            file["sample_stats"].create_variable("lp", ("chain", "draw"), data=samples.log_density)
        given = [item.interval95 if model.unit == "kPa" else item.ratio_interval95 for item in model.estimates]
        ends = np.array([[np.nan if end is None else end for end in pair or (None, None)] for pair in given])
        constants = {"interval95_low": ends[:, 0], "interval95_high": ends[:, 1]}
        if model.samples is not None:
            own = model.samples.interval95
            constants |= {"samples_interval95_low": own[:, 0], "samples_interval95_high": own[:, 1]}
        for name, values in constants.items():
            variable = file["constant_data"].create_variable(name, ("tissue",), data=values)
            if "interval95" in name:
                variable.attrs["units"], variable.attrs["interval_probability"] = unit, PROBABILITY
    write_bytes(path, memory.getvalue())
