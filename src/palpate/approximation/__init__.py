"""What stands in for a full model where it is solved often: reduced bases, expansions, and what they miss."""

from palpate.approximation.contract import Approximation as Approximation
from palpate.approximation.contract import ExactApproximation as ExactApproximation
from palpate.approximation.contract import LinearisationPoint as LinearisationPoint
from palpate.approximation.contract import exact_approximation as exact_approximation
from palpate.approximation.reduced_basis import ReducedBasis as ReducedBasis
from palpate.approximation.reduced_basis import reduced_basis as reduced_basis
