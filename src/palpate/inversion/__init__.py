"""The inverse problem: from later states and what is observed of them to the moduli that explain them."""

from palpate.inversion.approximation import Approximation, ExactApproximation, Place, exact_approximation
from palpate.inversion.blocks import (
    FIELD,
    KNOWN_MODULUS,
    Acts,
    Block,
    frame_blocks,
    instrument_block,
    known_modulus_blocks,
    layer_blocks,
    material_blocks,
    offset_block,
    unit_blocks,
    wall_blocks,
)
from palpate.inversion.driver_fit import fit_driver
from palpate.inversion.estimate import (
    Inversion,
    InversionSettings,
    StartRun,
    as_good,
    continue_at_finite_strain,
    first_noise_of,
    invert,
    with_released,
)
from palpate.inversion.frozen_posterior import (
    FixedCorrespondence,
    FrozenPosterior,
    fixed_correspondence,
    frozen_posterior,
)
from palpate.inversion.hyper_parameters import with_correlations, with_first_noise, with_hyper_parameters
from palpate.inversion.later_state import InverseProblem, LaterState
from palpate.inversion.objective import Evaluation, Linearisation, LinearisedObjective, Objective
from palpate.inversion.optimise import (
    Bounds,
    Iterate,
    LeastSquares,
    Minimum,
    Outcome,
    gauss_newton,
    posterior_sd,
)
from palpate.inversion.parameters import ParameterMap, eta_of_ratio, parameter_map, ratio_of_eta
from palpate.inversion.reduced_basis import ReducedBasis, reduced_basis
from palpate.inversion.trust_region import OuterIterate, StopRule, begun, fit_coefficients, minimised

__all__ = [
    "FIELD",
    "KNOWN_MODULUS",
    "Acts",
    "Approximation",
    "Block",
    "Bounds",
    "Evaluation",
    "ExactApproximation",
    "FixedCorrespondence",
    "FrozenPosterior",
    "InverseProblem",
    "Inversion",
    "InversionSettings",
    "Iterate",
    "LaterState",
    "LeastSquares",
    "Linearisation",
    "LinearisedObjective",
    "Minimum",
    "Objective",
    "Outcome",
    "OuterIterate",
    "ParameterMap",
    "Place",
    "ReducedBasis",
    "StartRun",
    "StopRule",
    "as_good",
    "begun",
    "continue_at_finite_strain",
    "eta_of_ratio",
    "exact_approximation",
    "first_noise_of",
    "fit_coefficients",
    "fit_driver",
    "fixed_correspondence",
    "frame_blocks",
    "frozen_posterior",
    "gauss_newton",
    "instrument_block",
    "invert",
    "known_modulus_blocks",
    "layer_blocks",
    "material_blocks",
    "minimised",
    "offset_block",
    "parameter_map",
    "posterior_sd",
    "ratio_of_eta",
    "reduced_basis",
    "unit_blocks",
    "wall_blocks",
    "with_correlations",
    "with_first_noise",
    "with_hyper_parameters",
    "with_released",
]
