"""What is known of an estimate: covariance by cause, profiles, intervals, samples of the posterior, sensitivity."""

from palpate.uncertainty.combinations import Combination, Information, information, information_shares, known_pairs
from palpate.uncertainty.covariance import (
    GRID_DRAWS,
    Covariance,
    FittedState,
    GridErrors,
    covariance_of,
    gain,
    grid_errors,
    grid_position_shifts,
    imaging_errors,
    mesh_covariance,
    noise_covariance,
    sandwich_covariance,
)
from palpate.uncertainty.diagnostics import ChainDiagnostics, chain_diagnostics, require_arviz
from palpate.uncertainty.discretisation import discretisation_sd
from palpate.uncertainty.image_pairs import Agreement, PairEstimates, agreement, pair_estimates
from palpate.uncertainty.intervals import NORMAL_95, Interval, ModulusInterval, log_interval, modulus_interval
from palpate.uncertainty.joint_region import JointRegion, joint_region
from palpate.uncertainty.profile import Profile
from palpate.uncertainty.refit import refitted
from palpate.uncertainty.sampling import PosteriorChains, posterior_chains, sample_posterior
from palpate.uncertainty.sensitivity import (
    Equilibria,
    Errors,
    FastPath,
    Shift,
    exact_equilibria,
    fast_path,
    law_errors,
    modulus_errors,
    poisson_errors,
    surface_errors,
)
from palpate.uncertainty.sobol import SobolIndices, require_salib, sobol_indices
from palpate.uncertainty.stiffness_map import DifferentRegion, StiffnessMap, stiffness_maps

__all__ = [
    "GRID_DRAWS",
    "NORMAL_95",
    "Agreement",
    "ChainDiagnostics",
    "Combination",
    "Covariance",
    "DifferentRegion",
    "Equilibria",
    "Errors",
    "FastPath",
    "FittedState",
    "GridErrors",
    "Information",
    "Interval",
    "JointRegion",
    "ModulusInterval",
    "PairEstimates",
    "PosteriorChains",
    "Profile",
    "Shift",
    "SobolIndices",
    "StiffnessMap",
    "agreement",
    "chain_diagnostics",
    "covariance_of",
    "discretisation_sd",
    "exact_equilibria",
    "fast_path",
    "gain",
    "grid_errors",
    "grid_position_shifts",
    "imaging_errors",
    "information",
    "information_shares",
    "joint_region",
    "known_pairs",
    "law_errors",
    "log_interval",
    "mesh_covariance",
    "modulus_errors",
    "modulus_interval",
    "noise_covariance",
    "pair_estimates",
    "poisson_errors",
    "posterior_chains",
    "refitted",
    "require_arviz",
    "require_salib",
    "sample_posterior",
    "sandwich_covariance",
    "sobol_indices",
    "stiffness_maps",
    "surface_errors",
]
