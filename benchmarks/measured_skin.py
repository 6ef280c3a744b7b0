"""Living human skin, and a keloid in it, pulled by two pads: moduli from the field of DIC and the force. Not simulated.

Called by measured.py; the data are those of Elouneg et al., whose files FOLDER holds: NAME.npz and NAME_sheet.msh, with
`monolithic` (healthy) or `bimaterial` (a keloid between the pads) for NAME.

A sheet 1 mm thick (so a modulus is kPa mm), free above and below: plane stress. Its pads are holes. What the skin under
a pad does, how the sheet's border moves, and where loading begins are unknown.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from palpate import CaseResult, estimate, read_case
from palpate.mechanics import choose_element, equilibrium, law_named, outer_constraint, surface_reaction

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

NORMAL_95 = 1.96
THICK_MM = 1.0
LAW = "neo-hookean"
HEAD = "before_x,before_y,before_z,after_x,after_y,after_z"
FIELD_SD_MM, FIELD_LENGTH_MM = 0.015, 4.0  # scatter about a quartic: 0.013
BLIND_MM = 10.0  # error of the motion across the sheet, which no camera saw
SLIP = 0.3  # of the pull: how far skin at a pad's edge moves otherwise than the pad
PATCHY_SD, PATCHY_MM = 0.3, 10.0  # of ln E inside a tissue, and the length over which it varies
FORCE_SD = 0.02  # of the force
STIFFENS_SD = 0.05  # of the force, a doubling of the pull: moduli that the authors fitted up to other pulls differ so
RATIO, RATIO_SD = 0.3, 0.02  # of Poisson; 0.45 changes moduli by 3 %
SURFACES = {"moving_pad": 1, "fixed_pad": 2, "border": 3}
UNDERSIDE = {"underside": 4}
AWAY = np.array([-1.0, 0.0, 0.0])  # from the fixed pad
TISSUE = 10  # number of the first tissue's group
STRIP_MM = 2.0
FEW_PAIRS = 4  # of a pad's nodes, one is compared


@dataclass(frozen=True)
class Specimen:
    """One of the two: name of its files, its tissues by their group, where the centre of DIC lies, fitted tissue."""

    file: str
    tissues: dict[int, str]
    stated: str
    from_centre: bool


SPECIMENS = {
    "healthy": Specimen("monolithic", {1: "skin"}, "skin", from_centre=False),
    "keloid": Specimen("bimaterial", {1: "keloid", 2: "skin"}, "keloid", from_centre=True),
}
HEALTHY_ORIGIN, KELOID_SHIFT = np.array([32.0, 20.0]), np.array([-20.363635, 0.0])  # mm, of the DIC's points


@dataclass(frozen=True)
class Series:
    """What was measured: points (n, 2) mm at rest and (frames, n, 2) later, the pull (frames,) mm, pull and force (m,).

    pads: motion (frames, 2, 2) mm of the moving and of the fixed one.
    """

    rest: Array
    later: Array
    pull: Array
    pads: Array
    machine_mm: Array
    force_n: Array

    def at(self, pull_mm: float) -> tuple[Array, Array]:
        """Motion (n, 2) mm of the points, and (2, 2) mm of the pads, at a pull, between two frames of DIC."""
        k = int(np.clip(np.searchsorted(self.pull, pull_mm), 1, len(self.pull) - 1))
        share = (pull_mm - self.pull[k - 1]) / (self.pull[k] - self.pull[k - 1])
        moved, pads = ((1.0 - share) * of[k - 1] + share * of[k] for of in (self.later - self.rest, self.pads))
        return moved, pads

    def force(self, pull_mm: float) -> float:
        """The force (N) at a pull; NaN beyond the end of the series."""
        return float(np.interp(pull_mm, self.machine_mm, self.force_n, right=np.nan))

    def line(self, pull_mm: float) -> tuple[float, float, float]:
        """Slope (N/mm) and start (N) of the line through the later half of the forces up to a pull; the rest, N."""
        half = (self.machine_mm >= 0.5 * pull_mm) & (self.machine_mm <= pull_mm)
        slope, start = np.polyfit(self.machine_mm[half], self.force_n[half], 1)
        rest = self.force_n[half] - slope * self.machine_mm[half] - start
        return float(slope), float(start), float(np.sqrt(np.mean(rest**2)))


def skin(data: Path, fit_mm: float, predict_mm: Sequence[float]) -> dict[str, Any]:
    """Healthy skin, and a keloid over skin: moduli at one pull, and the forces that follow at others."""
    return {name: _specimen(data, specimen, fit_mm, predict_mm) for name, specimen in SPECIMENS.items()}


def _specimen(data: Path, specimen: Specimen, fit_mm: float, predict_mm: Sequence[float]) -> dict[str, Any]:
    series = _series(data, specimen)
    fit_mm = min(fit_mm, float(series.pull[-1]), float(series.machine_mm[-1]))
    with tempfile.TemporaryDirectory() as name:
        result = _fitted(data, Path(name), specimen, series, fit_mm)
    (item,) = (of for of in result.estimation.estimates if of.tissue == specimen.stated)
    field = result.estimation.fits[0][0].end.rms_mm
    fit: dict[str, Any] = {
        "pull_mm": round(fit_mm, 3),
        "youngs_modulus_kpa": item.value and round(item.value, 2),
        "interval95": [end and round(end, 2) for end in item.interval95 or (None, None)],
        "verdict": item.verdict,
        "field_rms_mm": round(field, 4),
        "status": result.estimation.status,
        "profile": _profile(result),
    }
    if len(specimen.tissues) > 1:
        fit["others"] = {
            of.tissue: {"youngs_modulus_kpa": of.value and round(of.value, 2), "interval95": of.interval95}
            for of in result.estimation.estimates
            if of is not item
        }
    predictions = [_prediction(result, series, fit_mm, pull) for pull in predict_mm]
    found: dict[str, Any] = {"fit": fit, "predictions": predictions}
    if wrong := [of for of in predictions if of["measured_n"] is not None and not _holds(of)]:
        pulls = " and ".join(f"{of['pull_mm']:g} mm" for of in wrong)
        found["law_fails"] = (
            f"the {LAW} law, fitted at a pull of {fit_mm:.2g} mm, misses the force at {pulls}: the tissue stiffens"
            " otherwise than the law and the forces up to there tell"
        )
    return found


def _profile(result: CaseResult) -> dict[str, list[float]]:
    """The mean motion along the pull, mm, every `STRIP_MM` between the pads: measured, and of the model."""
    motions = result.estimation.points[0].motions  # of the field, which the case names first
    strip = np.floor(motions.rest[:, 0] / STRIP_MM)
    strips = [strip == number for number in np.unique(strip)]
    every = {"x_mm": motions.rest, "measured_mm": motions.observed, "model_mm": motions.fitted}
    return {name: [round(float(of[own, 0].mean()), 4) for own in strips] for name, of in every.items()}


def _holds(of: dict[str, Any]) -> bool:
    low, high = of["interval95"]
    return bool(low <= of["measured_n"] <= high)


def _series(data: Path, specimen: Specimen) -> Series:
    with np.load(data / f"{specimen.file}.npz", allow_pickle=False) as file:
        later, moving, fixed, machine, force = (
            np.asarray(file[name], dtype=np.float64)
            for name in ("xt_dic", "xt_pad_mov", "xt_pad_fix", "ux_pad_mov", "fx_pad_mov")
        )
    nodes = meshio.read(data / f"{specimen.file}_sheet.msh").points[:, :2]
    centre = 0.5 * (nodes.min(axis=0) + nodes.max(axis=0))
    shift = centre + KELOID_SHIFT if specimen.from_centre else HEALTHY_ORIGIN
    pads = np.stack([moving - moving[0], fixed - fixed[0]], axis=1)
    frames, readings = (1 + int(np.argmax(of)) for of in (-pads[:, 0, 0], -machine))  # of loading alone
    own = later[:frames] + shift, -pads[:frames, 0, 0], pads[:frames]
    return Series(own[0][0], *own, -machine[:readings], -force[:readings])


def _fitted(data: Path, folder: Path, specimen: Specimen, series: Series, fit_mm: float) -> CaseResult:
    """Moduli from field and force at a pull; unknown: motion at the pads and the border, where loading begins."""
    edges = _sheet(data / f"{specimen.file}_sheet.msh", folder / "sheet.msh", specimen)
    moved, pads = series.at(fit_mm)
    _table(folder / "field.csv", series.rest, moved, FIELD_SD_MM)
    places = [edges[name][::FEW_PAIRS] for name in ("moving_pad", "fixed_pad")]
    by_pad = np.concatenate([np.tile(motion, (len(own), 1)) for own, motion in zip(places, pads, strict=True)])
    _table(folder / "pads.csv", np.concatenate(places), by_pad, SLIP * fit_mm)
    force = series.force(fit_mm)
    boundaries = dict.fromkeys(UNDERSIDE, "sliding") | dict.fromkeys(SURFACES, "moving")
    surfaces = ", ".join(f'{{ name = "{n}", where = "{n}", boundary = "{of}" }}' for n, of in boundaries.items())
    tissues = "".join(
        f'tissues.{name} = {{ label = {TISSUE + group}, role = "estimate", poisson_ratio = {RATIO} }}\n'
        for group, name in specimen.tissues.items()
    )
    (folder / "case.toml").write_text(
        f'body.mesh = "sheet.msh"\nsurfaces = [{surfaces}]\n{tissues}mechanics = {{ law = "{LAW}", element = "P1" }}\n'
        f"discrepancy = {{ heterogeneity_sd = {PATCHY_SD}, heterogeneity_length_mm = {PATCHY_MM},"
        f" poisson_sd = {RATIO_SD}, layer_sd = 0.0 }}\n"
        "estimate = { starts_kpa = [10.0, 100.0], bounds_kpa = [0.1, 10000.0] }\ndata = [\n"
        f'{{ kind = "displacement-field", file = "field.csv", correlation_mm = {FIELD_LENGTH_MM} }},\n'
        f'{{ kind = "displacement-field", file = "pads.csv", correlation_mm = {FIELD_LENGTH_MM} }},\n'
        f'{{ kind = "force", surface = "moving_pad", direction = [-1.0, 0.0, 0.0], force_n = {force},'
        f" sd_n = {FORCE_SD * force}, offset_sd_n = {abs(series.line(fit_mm)[1])} }},\n]\n"
    )
    return estimate(read_case(folder / "case.toml"))


def _prediction(result: CaseResult, series: Series, fit_mm: float, pull_mm: float) -> dict[str, Any]:
    """The force (N) at another pull: the border moves as it was found to, in proportion to the pull.

    The fitted force is carried on by the model. Errors: the load cell's; the scatter of the forces about the line of
    their later half; what this line and the proportion to the pull differ by, for where loading begins is not known;
    and stiffening (`STIFFENS_SD`).
    """
    space, law, ratio = result.space, law_named(LAW), pull_mm / fit_mm
    values = {of.tissue: of.value for of in result.estimation.estimates}
    moduli = np.array([values[tissue.name] for tissue in result.tissues if tissue.meshed])
    faces, named, fitted = space.mesh.boundary, space.mesh.surfaces, result.estimation.displacements[0]
    border, none = np.zeros(len(space.points), dtype=bool), np.zeros((space.points.size, 0))
    border[np.unique(np.concatenate([faces[named[name]] for name in SURFACES]))] = True
    dilatation = choose_element("P1").dilatation
    reaction = surface_reaction(space, faces[named["moving_pad"]], AWAY, law, dilatation=dilatation)

    def at(share: float) -> float:
        """The model's force (N) where its border moves by a share of what was fitted."""
        offset = share * np.where(border[:, None], fitted, 0.0).ravel()
        held = outer_constraint(space, outer="free", modes=none, offset=offset, prescribed=border)
        found = equilibrium(space, held, moduli, law=law, dilatation=dilatation).displacement
        return reaction.at(found.ravel()[reaction.dofs], moduli, np.zeros(0))[0]

    at_fit = series.force(fit_mm)
    force = at_fit * at(ratio) / at(1.0)  # moduli and motion err together: the force is known better than they
    slope, start, scatter = series.line(fit_mm)
    errors = (
        FORCE_SD * force,
        scatter * ratio,
        slope * pull_mm + start - ratio * at_fit,
        STIFFENS_SD * force * max(ratio - 1.0, 0.0),
    )
    half = NORMAL_95 * float(np.linalg.norm(errors))
    measured = series.force(pull_mm)
    return {
        "pull_mm": pull_mm,
        "force_n": round(force, 4),
        "measured_n": None if np.isnan(measured) else round(measured, 4),
        "interval95": [round(force - half, 4), round(force + half, 4)],
    }


def _sheet(plane: Path, path: Path, specimen: Specimen) -> dict[str, Array]:
    """Write a sheet of tetrahedra, three above each triangle of a plane mesh, and return the nodes at each surface.

    Nodes (n, 3) mm, at half the thickness. A prism is cut by the order of its nodes' numbers, so that neighbours agree.
    """
    flat = meshio.read(plane)
    points, n = flat.points[:, :2], len(flat.points)
    groups, names = flat.cell_data_dict["gmsh:physical"], {int(tag): name for name, (tag, _) in flat.field_data.items()}
    names |= {int(tag): name for name, (tag, dimension) in flat.field_data.items() if dimension == 1}
    lines, triangles = (np.sort(flat.cells_dict[kind], axis=1) for kind in ("line", "triangle"))
    a, b, c = triangles.T
    tets = np.concatenate(
        [np.stack(own, axis=1) for own in ((a, b, c, c + n), (a, b, b + n, c + n), (a, a + n, b + n, c + n))]
    )
    nodes = np.concatenate([np.c_[points, np.full(n, z)] for z in (0.0, THICK_MM)])
    edges = nodes[tets[:, 1:]] - nodes[tets[:, :1]]
    turned = np.linalg.det(edges) < 0.0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    first, last = lines.T
    walls = np.concatenate([np.stack(own, axis=1) for own in ((first, last, last + n), (first, first + n, last + n))])
    kinds = [
        next((own for own in ("moving_pad", "fixed_pad") if own in names[tag]), "border") for tag in groups["line"]
    ]
    of_walls = np.tile([SURFACES[kind] for kind in kinds], 2)
    of_tets = TISSUE + np.tile(groups["triangle"] if len(specimen.tissues) > 1 else np.ones(len(a), dtype=int), 3)
    below = np.full(len(a), UNDERSIDE["underside"])
    _write_msh(path, nodes, [(2, triangles, below), (2, walls, of_walls), (4, tets, of_tets)])
    at = {kind: np.unique(lines[[own == kind for own in kinds]]) for kind in SURFACES}
    return {kind: np.c_[points[own], np.full(len(own), 0.5 * THICK_MM)] for kind, own in at.items()}


def _write_msh(path: Path, nodes: Array, blocks: Sequence[tuple[int, Integers, Integers]]) -> None:
    """Write gmsh's format 2.2; blocks: number of the kind of element, nodes (n, k) and group (n,) of each."""
    groups = [f'2 {tag} "{name}"' for name, tag in (SURFACES | UNDERSIDE).items()]
    rows = [
        f"{kind} 2 {tag} {tag} {' '.join(map(str, own))}"
        for kind, cells, tags in blocks
        for own, tag in zip((cells + 1).tolist(), tags.tolist(), strict=True)
    ]
    parts = {
        "MeshFormat": ["2.2 0 8"],
        "PhysicalNames": [str(len(groups)), *groups],
        "Nodes": [str(len(nodes)), *(f"{i} {x:.9g} {y:.9g} {z:.9g}" for i, (x, y, z) in enumerate(nodes.tolist(), 1))],
        "Elements": [str(len(rows)), *(f"{i} {row}" for i, row in enumerate(rows, 1))],
    }
    path.write_text("".join(f"${name}\n{chr(10).join(lines)}\n$End{name}\n" for name, lines in parts.items()))


def _table(path: Path, places: Array, moved: Array, sd_mm: float) -> None:
    """Points (n, 2) or (n, 3) mm with their motion (n, 2) mm in the sheet; what is across it was not measured."""
    n = len(places)
    before = np.c_[places[:, :2], np.full(n, 0.5 * THICK_MM)]
    errors = np.c_[np.full((n, 2), sd_mm), np.full(n, BLIND_MM)]
    rows = np.hstack([before, before + np.c_[moved, np.zeros(n)], errors])
    np.savetxt(path, rows, delimiter=",", header=f"{HEAD},sd_x,sd_y,sd_z", comments="")


def plot_skin(data: Path, found: dict[str, Any], path: Path) -> None:
    """Field: the motion along the pull between the pads; force over pull, measured and predicted with its interval."""
    figure = Figure(figsize=(8.0, 5.6), layout="constrained")
    for (field, force), (name, specimen) in zip(figure.subplots(2, 2).T, SPECIMENS.items(), strict=True):
        series, of = _series(data, specimen), found[name]
        profile = of["fit"]["profile"]
        field.plot(profile["x_mm"], profile["measured_mm"], "o", color="#888888", label="measured")
        field.plot(profile["x_mm"], profile["model_mm"], color="#1f3a5f", label="model")
        field.set(xlabel="place along the pull (mm)", ylabel="motion along it (mm)", title=name)
        force.plot(series.machine_mm, series.force_n, color="#888888", label="measured")
        force.axvline(of["fit"]["pull_mm"], color="#c0392b", linestyle=":", label="fitted")
        for item in of["predictions"]:
            at = [item["pull_mm"]] * 2
            force.plot(at, item["interval95"], color="#4c78a8", linewidth=5, alpha=0.5, solid_capstyle="round")
            force.plot(at[0], item["force_n"], "o", color="#1f3a5f")
        force.set(xlabel="pull (mm)", ylabel="force (N)")
        for axes in (field, force):
            axes.legend(frameon=False)
    figure.savefig(path, metadata={"Date": None})
