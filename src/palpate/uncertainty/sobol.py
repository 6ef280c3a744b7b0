"""Sobol's indices: by which inputs, alone and together with others, a function of several of them varies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from palpate.errors import ResourceError


@dataclass(frozen=True, slots=True)
class SobolIndices:
    """Shares of the variance of each output (n_outputs,) by each input, (n_inputs, n_outputs) each, dimensionless.

    first: by the input alone; total: with all that it does together with others; *_half: half widths of their 95 %
    intervals, by bootstrap; variance (n_outputs,): of the outputs; failed: share of the samples without an output.
    """

    first: NDArray[np.float64]
    total: NDArray[np.float64]
    first_half: NDArray[np.float64]
    total_half: NDArray[np.float64]
    variance: NDArray[np.float64]
    failed: float


def require_salib() -> None:
    """Raise `ResourceError` where SALib is not installed."""
    try:
        import_module("SALib")
    except ImportError as error:
        raise ResourceError(
            "Sobol indices need SALib, which is not installed: pip install 'palpate[sensitivity]'; the other"
            " sensitivities work without --sobol"
        ) from error


def sobol_indices(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    ranges: Sequence[tuple[float, float]],
    *,
    n: int,
    seed: int,
) -> SobolIndices:
    """Indices of the outputs of `function`, (n_samples, n_inputs) to (n_samples, n_outputs), over uniform inputs.

    ranges: low and high of each input; n: a power of 2, the function is asked n (n_inputs + 2) times, and answers NaN
    where it has no output, which then counts as 0. Saltelli's scheme on Sobol's sequence (Saltelli et al., Computer
    Physics Communications 181 (2010) 259-270), by SALib. Raises `ResourceError` as `require_salib` does.
    """
    require_salib()
    sample, analyze = import_module("SALib.sample.sobol"), import_module("SALib.analyze.sobol")
    problem = {
        "num_vars": len(ranges),
        "names": [str(i) for i in range(len(ranges))],
        "bounds": [list(r) for r in ranges],
    }
    outputs = function(np.asarray(sample.sample(problem, n, calc_second_order=False, seed=seed)))
    failed = np.asarray(np.isnan(outputs).any(axis=1))
    outputs = np.where(failed[:, None], 0.0, outputs)
    found = [analyze.analyze(problem, column, calc_second_order=False, seed=seed) for column in outputs.T]
    first, total, first_half, total_half = (
        np.stack([np.asarray(each[key]) for each in found], axis=1) for key in ("S1", "ST", "S1_conf", "ST_conf")
    )
    return SobolIndices(first, total, first_half, total_half, np.var(outputs, axis=0), float(failed.mean()))
