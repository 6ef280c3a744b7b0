"""What is known of an estimate: covariance under correlated residuals, the voxels' part of it, intervals, sampling."""

from palpate.uncertainty.covariance import (
    NORMAL_95,
    FittedState,
    Interval,
    gain,
    grid_position_shifts,
    imaging_errors,
    log_interval,
    sandwich_covariance,
)
from palpate.uncertainty.sampling import sample_posterior

__all__ = [
    "NORMAL_95",
    "FittedState",
    "Interval",
    "gain",
    "grid_position_shifts",
    "imaging_errors",
    "log_interval",
    "sample_posterior",
    "sandwich_covariance",
]
