"""Elastic equilibrium: stiffness, boundary conditions, linear solvers, forward models and their derivatives."""

from palpate.mechanics.boundary import outer_constraint
from palpate.mechanics.conditions import Conditions
from palpate.mechanics.dilatation import ELEMENTS, Dilatation, ElementChoice, choose_element
from palpate.mechanics.element import (
    barycentric_gradients,
    quadrature,
    shape_derivatives,
    shape_functions,
    triangle_quadrature,
)
from palpate.mechanics.equilibrium import ACCURACY, equilibrium
from palpate.mechanics.finite_strain import FiniteStrainModel, finite_strain_model
from palpate.mechanics.forward import ForwardModel
from palpate.mechanics.laws.contract import Law, stress
from palpate.mechanics.laws.registry import LAWS, law_named
from palpate.mechanics.linear_model import LinearModel, LinearSystem, linear_model, weighted_sum
from palpate.mechanics.linearised import LinearisedSystem
from palpate.mechanics.loads import DeadLoad, boundary_named, gravity, pressure, traction
from palpate.mechanics.newton import NewtonSettings
from palpate.mechanics.solvers.contract import Hints
from palpate.mechanics.solvers.registry import SOLVERS, expected_of_size, factorise
from palpate.mechanics.stiffness import lame_parameters

__all__ = [
    "ACCURACY",
    "ELEMENTS",
    "LAWS",
    "SOLVERS",
    "Conditions",
    "DeadLoad",
    "Dilatation",
    "ElementChoice",
    "FiniteStrainModel",
    "ForwardModel",
    "Hints",
    "Law",
    "LinearModel",
    "LinearSystem",
    "LinearisedSystem",
    "NewtonSettings",
    "barycentric_gradients",
    "boundary_named",
    "choose_element",
    "equilibrium",
    "expected_of_size",
    "factorise",
    "finite_strain_model",
    "gravity",
    "lame_parameters",
    "law_named",
    "linear_model",
    "outer_constraint",
    "pressure",
    "quadrature",
    "shape_derivatives",
    "shape_functions",
    "stress",
    "traction",
    "triangle_quadrature",
    "weighted_sum",
]
