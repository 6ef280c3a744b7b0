"""Figure 4: how the linear law's error grows with the deformation when the truth has finite strain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import brentq

from palpate.errors import NotConverged
from palpate.inversion import InverseProblem, Inversion, LaterState, invert
from palpate.mechanics import (
    ACCURACY,
    Conditions,
    Dilatation,
    LinearModel,
    NewtonSettings,
    equilibrium,
    finite_strain_model,
    lame_parameters,
    law_named,
    linear_model,
)
from palpate.mesh import Constraint, LagrangeSpace
from palpate.unknowns import parameter_map, unit_blocks
from palpate_validation.paper.balls import (
    BODIES,
    POISSON_RATIO,
    Balls,
    balls_space,
    balls_tissues,
    floating,
    mean_deformations,
    pulled,
)
from palpate_validation.paper.columns import exact_surfaces, from_half
from palpate_validation.paper.table import COLOURS, save_figure
from palpate_validation.scenes import Job, Part, Progress, Scenes

__all__ = ["Figure4", "Figure4Settings", "Point", "draw_figure4", "figure4", "nominal_stress"]

Array = NDArray[np.float64]
Moduli = tuple[float, float, float]

LAW = "neo-hookean"
LINESTYLES = {"linear": "-", LAW: "--"}
LEAVE_PERCENT = 5.0  # error from which on the linear law is not used

NOTES = (
    "The truth is neo-Hookean, on the mesh that inverts it, so only the law makes an error. The load is as in table 1.",
    "The deformation is the mean over the body of the largest |stretch - 1|.",
    "With one modulus in all bodies the curve is the same for every modulus, because the load scales with it.",
)


@dataclass(frozen=True, slots=True)
class Figure4Settings:
    """The balls, the moduli (kPa) of each line, and the deformations of the body that is deformed most."""

    balls: Balls = field(default_factory=lambda: Balls(edge_mm=13.0))
    moduli_kpa: tuple[Moduli, ...] = ((100.0, 100.0, 100.0), (50.0, 100.0, 150.0), (150.0, 100.0, 50.0))
    deformations: tuple[float, ...] = (0.01, 0.05, 0.10, 0.15, 0.20, 0.30)


@dataclass(frozen=True, slots=True)
class Point:
    """One point of the figure; `error_percent` is None where an iteration did not converge."""

    body: str
    true_kpa: float
    deformation_percent: float
    law: str
    error_percent: float | None
    case: str


@dataclass(frozen=True, slots=True)
class Figure4:
    """All points."""

    points: tuple[Point, ...]

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "schema": "palpate.reproduce/1",
            "experiment": "figure4",
            "points": [asdict(point) for point in self.points],
            "linear_law_ends_percent": self.ends(),
            "notes": list(NOTES),
        }

    def lines(self, law: str) -> dict[tuple[str, str], list[Point]]:
        """Points of a law by body and case, in the order of the deformation."""
        found: dict[tuple[str, str], list[Point]] = {}
        for point in sorted(self.points, key=lambda p: p.deformation_percent):
            if point.law == law:
                found.setdefault((point.body, point.case), []).append(point)
        return found

    def ends(self) -> list[dict[str, Any]]:
        """For each body and case: the deformation (%) where the linear law's error passes 5 %, None if it never does.

        Between two points of the figure it is interpolated linearly.
        """
        found = []
        for (body, case), points in self.lines("linear").items():
            stated = [(p.deformation_percent, abs(p.error_percent)) for p in points if p.error_percent is not None]
            passes = (
                before + (after - before) * (LEAVE_PERCENT - low) / (high - low)
                for (before, low), (after, high) in pairwise([(0.0, 0.0), *stated])
                if low < LEAVE_PERCENT <= high
            )
            found.append({"body": body, "case": case, "deformation_percent": next(passes, None)})
        return found

    def text(self) -> list[list[str]]:
        """Rows of cells for a terminal."""
        rows = [["case", "body", "deformation", "linear", LAW]]
        finite = {(p.case, p.body, p.deformation_percent): p.error_percent for p in self.points if p.law == LAW}
        for p in self.points:
            if p.law == "linear":
                other = finite.get((p.case, p.body, p.deformation_percent))
                rows.append([p.case, p.body, f"{p.deformation_percent:.1f} %", _cell(p.error_percent), _cell(other)])
        return rows


def figure4(settings: Figure4Settings) -> Scenes[Figure4]:
    """All points; `NotConverged` is raised where a truth has no equilibrium."""
    keys = {
        f"{_name(moduli)} {deformation:g}": (moduli, deformation)
        for moduli in settings.moduli_kpa
        for deformation in settings.deformations
    }
    jobs = [Job((key,), partial(_part, settings.balls, *of)) for key, of in keys.items()]

    def conclude(parts: Mapping[str, Part]) -> Figure4:
        """The points of all parts."""
        points = [
            Point(body, modulus, parts[key]["deformation_percent"][i], law, parts[key][law][i], _name(moduli))
            for key, (moduli, _) in keys.items()
            for law in ("linear", LAW)
            for i, (body, modulus) in enumerate(zip(BODIES, moduli, strict=True))
        ]
        return Figure4(tuple(points))

    return Scenes("figure4", settings, jobs, conclude, draw_figure4)


def _part(balls: Balls, moduli: Moduli, deformation: float, key: str, progress: Progress) -> dict[str, Any]:
    progress(f"figure 4, kPa and deformation: {key}")
    return _bench(balls).errors(moduli, deformation, progress)


def _name(moduli: Moduli) -> str:
    return "/".join(f"{modulus:g}" for modulus in moduli)


def nominal_stress(stretch: float) -> float:
    """Uniaxial nominal stress over Young's modulus of a neo-Hookean bar, free at its sides, at a stretch.

    P = mu (s - 1 / s) + lambda ln(J) / s with mu (t^2 - 1) + lambda ln(J) = 0 across it and J = s t^2.
    """
    lame, mu = lame_parameters(1.0, POISSON_RATIO)

    def side(t: float) -> float:
        """Stress across the bar at a stretch t of its sides, by Young's modulus."""
        return float(mu * (t**2 - 1.0) + lame * np.log(stretch * t**2))

    across = float(brentq(side, 0.2, 2.0))
    return float(mu * (stretch - 1.0 / stretch) + lame * np.log(stretch * across**2) / stretch)


@dataclass(frozen=True)
class _Bench:
    """What all points share."""

    balls: Balls

    @cached_property
    def space(self) -> LagrangeSpace:
        """The mesh of truth and estimate."""
        return balls_space(self.balls, self.balls.edge_mm)

    @cached_property
    def constraint(self) -> Constraint:
        """Nothing is held but the rigid motion."""
        return floating(self.space)

    @cached_property
    def linear(self) -> LinearModel:
        """Pulled by 1 kPa."""
        return linear_model(
            self.space, self.constraint, dilatation=Dilatation.BLENDED, loads=(pulled(self.space, 1.0),)
        )

    def errors(self, moduli: Moduli, deformation: float, progress: Progress) -> dict[str, Any]:
        """Errors (%) of the three bodies under both laws, and their deformations (%)."""
        stress = self.stress_kpa(moduli, deformation)
        law, load = law_named(LAW), pulled(self.space, stress)
        truth = equilibrium(
            self.space, self.constraint, np.array(moduli), law=law, dilatation=Dilatation.BLENDED, loads=(load,)
        ).displacement
        observations = exact_surfaces(self.space, self.space, truth)
        blocks = unit_blocks(self.linear.n_modes)
        mapping = parameter_map(balls_tissues(moduli), self.linear.regions, blocks, loaded=True)
        settings = from_half(mapping, dict(zip(BODIES, moduli, strict=True)))
        model = self.linear.with_conditions(Conditions(self.constraint, (load,)))
        finite = finite_strain_model(
            self.space, self.constraint, law, loads=(load,), settings=NewtonSettings(tolerance=ACCURACY)
        )
        problem = InverseProblem((LaterState(model, observations, finite),), mapping)
        linear = invert(problem.linear(), settings, progress=progress)
        try:
            continued = _errors(invert(problem, settings, progress=progress), moduli)
        except NotConverged as error:
            progress(f"not converged: {error}")
            continued = [None] * len(BODIES)
        deformations = 100.0 * mean_deformations(self.space, truth)
        return {"deformation_percent": deformations.tolist(), "linear": _errors(linear, moduli), LAW: continued}

    def stress_kpa(self, moduli: Moduli, deformation: float) -> float:
        """The pull that deforms the body which is deformed most by about `deformation`, at finite strain."""
        unit = self.linear.solve(np.array(moduli), np.zeros(self.linear.n_modes)).displacement
        small = float(1.0 / mean_deformations(self.space, unit).max())
        return small * nominal_stress(1.0 + deformation)


_bench = lru_cache(maxsize=1)(_Bench)


def _errors(inversion: Inversion, moduli: Moduli) -> list[float | None]:
    if not inversion.minimum.outcome.converged:
        return [None] * len(moduli)
    found = inversion.objective.parameters.moduli(inversion.minimum.unknowns)
    return [float(100.0 * (value / truth - 1.0)) for value, truth in zip(found, moduli, strict=True)]


def _cell(error: float | None) -> str:
    return "not converged" if error is None else f"{error:+.2g} %"


def draw_figure4(result: Figure4, path: Path) -> None:
    """Error against deformation, a panel a sphere, a line a modulus and law, into `path` (SVG)."""

    def draw(figure: Figure) -> None:
        """All panels."""
        panels = figure.subplots(1, len(BODIES), sharey=True)
        for axes, body in zip(panels, BODIES, strict=True):
            cases = list(dict.fromkeys(point.case for point in result.points))
            for law, style in LINESTYLES.items():
                lines = result.lines(law)
                for colour, case in zip(COLOURS, cases, strict=False):
                    points = lines.get((body, case), [])
                    errors = [np.nan if p.error_percent is None else p.error_percent for p in points]
                    deformations = [p.deformation_percent for p in points]
                    axes.plot(deformations, errors, style, color=colour, marker=".", label=f"{case} kPa, {law}")
            axes.axhspan(-LEAVE_PERCENT, LEAVE_PERCENT, color="0.9", zorder=0)
            axes.set_title(body)
            axes.set_xlabel("deformation, %")
        panels[0].set_ylabel("error of the modulus, %")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)

    save_figure(draw, path, width=10.0)
