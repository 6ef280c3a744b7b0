"""What is known of an estimate: covariance by its causes, profile likelihoods, intervals, samples of the posterior."""

from palpate.uncertainty.combinations import Combination, Information, information, known_pairs
from palpate.uncertainty.covariance import (
    Covariance,
    FittedState,
    covariance_of,
    gain,
    grid_position_shifts,
    imaging_errors,
    sandwich_covariance,
)
from palpate.uncertainty.image_pairs import Agreement, PairEstimate, agreement, pair_estimates
from palpate.uncertainty.intervals import NORMAL_95, Interval, ModulusInterval, log_interval, modulus_interval
from palpate.uncertainty.profile import FixedCorrespondence, Profile, fixed_correspondence
from palpate.uncertainty.sampling import sample_posterior

__all__ = [
    "NORMAL_95",
    "Agreement",
    "Combination",
    "Covariance",
    "FittedState",
    "FixedCorrespondence",
    "Information",
    "Interval",
    "ModulusInterval",
    "PairEstimate",
    "Profile",
    "agreement",
    "covariance_of",
    "fixed_correspondence",
    "gain",
    "grid_position_shifts",
    "imaging_errors",
    "information",
    "known_pairs",
    "log_interval",
    "modulus_interval",
    "pair_estimates",
    "sample_posterior",
    "sandwich_covariance",
]
