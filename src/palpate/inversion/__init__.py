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
    StartRun,
    as_good,
    continue_at_finite_strain,
    first_noise_of,
    invert,
    with_released,
)
from palpate.inversion.evidence import with_learned_prior
from palpate.inversion.later_state import InverseProblem, LaterState
from palpate.inversion.objective import Evaluation, Linearisation, LinearisedObjective, Objective
from palpate.inversion.optimise import (
    Bounds,
    Iterate,
    LeastSquares,
    Minimum,
    Outcome,
    fit_coefficients,
    gauss_newton,
    posterior_sd,
)
from palpate.inversion.outer_loop import InversionSettings, OuterIterate, StopRule, run_outer_loop
from palpate.inversion.parameters import ParameterMap, eta_of_ratio, parameter_map, ratio_of_eta
from palpate.inversion.reduced_basis import ReducedBasis, reduced_basis
from palpate.inversion.reweighting import reweighted, with_first_noise

__all__ = [
    "FIELD",
    "KNOWN_MODULUS",
    "Acts",
    "Approximation",
    "Block",
    "Bounds",
    "Evaluation",
    "ExactApproximation",
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
    "continue_at_finite_strain",
    "eta_of_ratio",
    "exact_approximation",
    "first_noise_of",
    "fit_coefficients",
    "fit_driver",
    "frame_blocks",
    "gauss_newton",
    "instrument_block",
    "invert",
    "known_modulus_blocks",
    "layer_blocks",
    "material_blocks",
    "offset_block",
    "parameter_map",
    "posterior_sd",
    "ratio_of_eta",
    "reduced_basis",
    "reweighted",
    "run_outer_loop",
    "unit_blocks",
    "wall_blocks",
    "with_first_noise",
    "with_learned_prior",
    "with_released",
]
