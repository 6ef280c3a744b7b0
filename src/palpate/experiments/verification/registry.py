"""All problems with known answers, in the order in which they are told."""

from __future__ import annotations

from palpate.experiments.verification.beads import BEADS_PROBLEMS
from palpate.experiments.verification.concentric import CONCENTRIC_PROBLEMS
from palpate.experiments.verification.cook import COOK_PROBLEMS
from palpate.experiments.verification.estimator import ESTIMATOR_PROBLEMS
from palpate.experiments.verification.homogeneous import HOMOGENEOUS_PROBLEMS
from palpate.experiments.verification.inclusion import INCLUSION_PROBLEMS
from palpate.experiments.verification.indentation import INDENTATION_PROBLEMS
from palpate.experiments.verification.inflation import INFLATION_PROBLEMS
from palpate.experiments.verification.lame import LAME_PROBLEMS
from palpate.experiments.verification.manufactured import MANUFACTURED_PROBLEMS
from palpate.experiments.verification.patch import PATCH_PROBLEMS
from palpate.experiments.verification.problem import Problem

__all__ = ["PROBLEMS"]

PROBLEMS: tuple[Problem, ...] = (
    *PATCH_PROBLEMS,
    *LAME_PROBLEMS,
    *CONCENTRIC_PROBLEMS,
    *INCLUSION_PROBLEMS,
    *COOK_PROBLEMS,
    *INDENTATION_PROBLEMS,
    *HOMOGENEOUS_PROBLEMS,
    *INFLATION_PROBLEMS,
    *MANUFACTURED_PROBLEMS,
    *ESTIMATOR_PROBLEMS,
    *BEADS_PROBLEMS,
)
