"""Young's moduli of measured bodies, whose stiffness, or its ratio, is known from another source. Not simulated.

    python benchmarks/measured.py NAME --data FOLDER [--fit STEPS] [--predict STEPS] [--foot N] [--map] [--alike UM]
        [--bead-sd UM] [--json] [--plot FILE.svg]

NAME is one of

    tpu     a block of 3D-printed TPU that is pulled along z, its motion by digital volume correlation of CT and its
            force by a load cell (Bourdyot et al., "Learning a hyperelastic constitutive model from 3D experimental
            data"). FOLDER holds nodes_mm.csv, tets.csv, displacement_stepK_mm.csv and forces_n.csv. Modulus and
            Poisson's ratio are fitted to field and force of the steps of --fit (2), under the law that fits the field
            better; force and field of the steps of --predict (1) follow from the motion of both ends alone.
    beam    a silicone beam that bends under 52 g and 101 g at its tip, by optical markers on tip and clamp (Dubied et
            al., "Sim-to-Real for Differentiable Projective Dynamics on Soft Robots"). FOLDER holds
            static_markers_mm.csv. One modulus from each weight, with the clamp's motion unknown and with it held.
    beads   beads in a homogeneous hydrogel that a ball is pressed into (Yang et al., SoftwareX 2022). FOLDER holds
            beads.npz. The modulus of the gel's inner part over that of the rest, which is 1, and the misfit. With
            --map the inner part's modulus is a field: how far it is from flat, beside its own intervals. --bead-sd
            (0.2) and --alike (0): standard deviation of the errors, and length over which they are alike, um.
    skin    living human skin, and a keloid in it, pulled by two pads (Elouneg et al.). FOLDER holds monolithic.npz,
            bimaterial.npz and their meshes. Moduli from field and force at a pull of --fit (1.0) mm; the forces at
            pulls of --predict (2.0,3.0) mm follow. See measured_skin.py.

Nothing of FOLDER is copied. Needs meshio: pip install 'palpate[mesh]'.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from matplotlib.figure import Figure
from measured_skin import plot_skin, skin
from numpy.typing import NDArray

from palpate.body import inverse_problem, make_body, read_states
from palpate.case import Case, read_case
from palpate.inversion import Inversion, invert
from palpate.study import estimate, inversion_settings
from palpate.uncertainty import StiffnessMap

Array = NDArray[np.float64]

NORMAL_95 = 1.96
HEAD = "before_x,before_y,before_z,after_x,after_y,after_z"

# TPU. Correlation noise: scatter of the nodes' motion about a local affine fit, 0.01 to 0.04 mm, alike over 2 mm.
FIELD_SD_MM, FIELD_LENGTH_MM = 0.03, 2.0
FORCE_SD = 0.01  # of a force: load cells are better
FOOT_N = 50.0  # where loading begins is known to a per cent of strain, some 40 to 50 N
END_MM = 1.0  # nodes so near to the lowest and the highest plane are held by the grips
RATIO, RATIO_SD = 0.40, 0.05  # of Poisson; printed TPU is given 0.35 to 0.48

# Beam: about 100 x 30 x 30 mm along z, weights pull along -x.
BEAM_MM, BEAM_Z = 30.0, (-21.0, 79.0)
BEAM_AXIS = (62.0, 33.0)  # of the clamp's markers, mm
GRAVITY = 9.81e-3  # N a gram
WEIGHTS_G = {"load52": 52.0, "load101": 101.0}
BEAM_KG_M3 = 1080.0  # Dragon Skin
FACE_SD_MM = 0.05  # of a face's points, which follow three markers as a rigid body

# Beads: the meshed box of gel and its inner part, in um that are used as mm.
GEL_LOW, GEL_HIGH = np.array([60.0, 60.0, 16.0]), np.array([350.0, 350.0, 68.0])
GEL_CELLS = (14, 14, 4)
GEL_INNER = 0.5  # of the half width along x and y
GEL_FIELD = 'modulus = "field"\nfield_sd = 0.7\nfield_length_mm = 30.0\n'  # of the inner part, with --map
BEAD_SD = 0.2  # scatter of the beads about a local affine fit: 0.13 in the median, 0.43 in the 95th percentile


def main() -> int:
    """Run one experiment and print what it finds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=tuple(EXPERIMENTS))
    parser.add_argument("--data", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--fit", help="steps of tpu (2), or millimetres of pull of skin (1.0), with commas")
    parser.add_argument("--predict", help="the same, of forces that follow (1; 2.0,3.0); '' for none")
    parser.add_argument("--foot", type=float, default=FOOT_N, help="sd (N) of the load cell's offset of tpu; 0: none")
    parser.add_argument("--map", action="store_true", help="map the inner part of beads")
    parser.add_argument("--bead-sd", type=float, default=BEAD_SD, help="sd (um) of the errors of beads")
    parser.add_argument("--alike", type=float, default=0.0, help="length (um) over which errors of beads are alike")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    parser.add_argument("--plot", type=Path, metavar="FILE.svg", help="values with their 95 %% intervals")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        usual = ("1.0", "2.0,3.0") if arguments.name == "skin" else ("2", "1")
        asked = (
            own if given is None else given
            for given, own in zip((arguments.fit, arguments.predict), usual, strict=True)
        )
        fit, predict = ([float(s) for s in text.split(",") if s] for text in asked)
        options = Options(arguments.data, Path(folder), fit, predict, arguments.foot)
        options = replace(options, mapped=arguments.map, bead_sd=arguments.bead_sd, alike=arguments.alike)
        found = EXPERIMENTS[arguments.name](options)
    sys.stdout.write(json.dumps(found, indent=None if arguments.json else 1) + "\n")
    if arguments.plot:
        if arguments.name == "skin":
            plot_skin(arguments.data, found, arguments.plot)
        else:
            _plot(arguments.name, found, arguments.plot)
    return 0


@dataclass(frozen=True)
class Options:
    """Where the data are, a folder to work in, the steps, and the standard deviation (N) of a load cell's offset.

    mapped: whether the gel's inner part is; bead_sd, alike: of the beads' errors, um.
    """

    data: Path
    folder: Path
    fit: Sequence[float]
    predict: Sequence[float]
    foot_n: float
    mapped: bool = False
    bead_sd: float = BEAD_SD
    alike: float = 0.0


def tpu(options: Options) -> dict[str, Any]:
    """Fit the block's modulus and Poisson's ratio to some steps, under both laws, and predict others."""
    block = _block(options)
    found = {law: _tpu_fit(block, options, law, "P1") for law in ("linear", "neo-hookean")}
    law = min(found, key=lambda name: float(found[name]["field_rms_mm"]))
    best = _tpu_fit(block, options, law, "auto")
    predictions = [_tpu_prediction(block, options, step, best) for step in options.predict]
    return {"fit": best, "linear_tetrahedra": list(found.values()), "predictions": predictions}


@dataclass(frozen=True)
class Block:
    """Nodes (n, 3) mm, their motion (n, 3) mm by step, and the forces (N) that were measured."""

    nodes: Array
    motion: dict[float, Array]
    forces: dict[float, float]

    @property
    def at_ends(self) -> NDArray[np.bool_]:
        """Nodes (n,) that the grips hold."""
        z = self.nodes[:, 2]
        return np.asarray((z < z.min() + END_MM) | (z > z.max() - END_MM))


def _block(options: Options) -> Block:
    data, folder = options.data, options.folder
    nodes, tets = _table(data / "nodes_mm.csv"), _table(data / "tets.csv").astype(int)
    steps: dict[float, Path] = {
        int(path.stem.split("_")[1].removeprefix("step")): path for path in data.glob("displacement_step*_mm.csv")
    }
    meshio.write(folder / "block.vtu", meshio.Mesh(nodes, [("tetra", tets)]))
    forces: dict[float, float] = {
        int(step): float(force) for step, force in np.atleast_2d(_table(data / "forces_n.csv"))
    }
    return Block(nodes, {step: _table(path) for step, path in steps.items()}, forces)


def _tpu_case(folder: Path, law: str, element: str, data: Sequence[str]) -> Case:
    surfaces = "".join(
        f'[[surfaces]]\nname = "{n}"\nwhere = "{w}"\n' for n, w in (("lower", "z_min"), ("upper", "z_max"))
    )
    (folder / "case.toml").write_text(
        f'[body]\nmesh = "block.vtu"\n{surfaces}[tissues.block]\nlabel = 1\nrole = "estimate"\n'
        f'poisson_ratio = {RATIO}\n[mechanics]\nlaw = "{law}"\nelement = "{element}"\n'
        f"[discrepancy]\nheterogeneity_sd = 0.0\npoisson_sd = {RATIO_SD}\n[driver]\nkernel_mm = 10.0\n"
        "[estimate]\nstarts_kpa = [3000.0, 10000.0]\nbounds_kpa = [100.0, 100000.0]\n" + "".join(data)
    )
    return read_case(folder / "case.toml")


def _tpu_data(
    block: Block, folder: Path, step: float, state: int, *, force: tuple[float, float, float], ends: bool
) -> str:
    """The [[data]] of one step; force: N, its standard deviation, that of its offset; ends: of the grips alone."""
    chosen = block.at_ends if ends else np.ones(len(block.nodes), dtype=bool)
    name = f"step{step:g}{'_ends' if ends else ''}.csv"
    _pairs(folder / name, block.nodes[chosen], block.motion[step][chosen])
    newton, sd, offset = force
    return (
        f'[[data]]\nkind = "displacement-field"\nstate = {state}\nfile = "{name}"\nsd_mm = {FIELD_SD_MM}\n'
        f'correlation_mm = {FIELD_LENGTH_MM}\n[[data]]\nkind = "force"\nstate = {state}\nsurface = "upper"\n'
        f"force_n = {newton}\ndirection = [0.0, 0.0, 1.0]\nsd_n = {sd}\noffset_sd_n = {offset}\n"
    )


def _tpu_fit(block: Block, options: Options, law: str, element: str) -> dict[str, Any]:
    folder, steps = options.folder, options.fit
    forces = [(block.forces[step], FORCE_SD * block.forces[step], options.foot_n) for step in steps]
    each = enumerate(zip(steps, forces, strict=True), start=1)
    data = [_tpu_data(block, folder, step, state, force=force, ends=False) for state, (step, force) in each]
    case = _tpu_case(folder, law, element, data)
    inversion = _inverted(case)
    found = estimate(case).estimation
    (block_found,) = found.estimates
    rms = [of.end.rms_mm for fits in found.fits for of in fits]
    return {
        "youngs_modulus_mpa": _mpa(block_found.value),
        "interval95": [_mpa(end) for end in block_found.interval95 or (None, None)],
        "verdict": block_found.verdict,
        "poisson_ratio": round(RATIO + _poisson_shift(inversion), 4),
        "law": law,
        "field_rms_mm": round(float(np.sqrt(np.mean(np.square(rms)))), 4),
        "steps": list(map(int, steps)),
        "status": found.status,
    }


def _tpu_prediction(block: Block, options: Options, step: float, fit: dict[str, Any]) -> dict[str, Any]:
    """Force and field of a step by the motion of both ends, the modulus and its uncertainty those of the fit."""
    folder, unknown = (
        options.folder,
        (0.0, 1e6, 0.0),
    )  # a force with a huge error: the model predicts it
    data = [_tpu_data(block, folder, step, 1, force=unknown, ends=True)]
    case = _tpu_case(folder, fit["law"], "auto", data)
    case = replace(case, tissues=tuple(replace(t, poisson_ratio=fit["poisson_ratio"]) for t in case.tissues))
    if None in fit["interval95"]:
        raise SystemExit(f"steps {fit['steps']} do not identify the modulus: there is nothing to foretell with")
    low, high = (np.log(end) for end in fit["interval95"])
    sd = float(high - low) / (2.0 * NORMAL_95)
    inversion = _inverted(case, prior=(float(np.log(1e3 * fit["youngs_modulus_mpa"])), sd))
    objective, x = inversion.objective, inversion.minimum.unknowns
    parameters = objective.parameters
    moved = objective.states[0].displacement(parameters.moduli(x), parameters.coefficients(x)[0])[: len(block.nodes)]
    (line,) = (line for line in inversion.minimum.evaluation.linearisations if line.observation.name == "force")
    force = float(line.residuals.values[0])
    half = NORMAL_95 * float(np.hypot(force * sd, options.foot_n))
    inside = ~block.at_ends
    off = np.linalg.norm((moved - block.motion[step])[inside], axis=1)
    motion = np.linalg.norm(block.motion[step][inside] - block.motion[step][inside].mean(axis=0), axis=1)
    return {
        "step": int(step),
        "force_n": round(force, 1),
        "measured_n": block.forces.get(step),
        "interval95": [round(force - half, 1), round(force + half, 1)],
        "field_rms_mm": round(float(np.sqrt(np.mean(off**2))), 4),
        "motion_rms_mm": round(float(np.sqrt(np.mean(motion**2))), 4),
    }


def beam(options: Options) -> dict[str, Any]:
    """The beam's modulus from each weight: the clamp's motion unknown and held; without its own weight at rest."""
    data, folder = options.data, options.folder
    markers = _markers(data / "static_markers_mm.csv")
    low = np.array([BEAM_AXIS[0] - 0.5 * BEAM_MM, BEAM_AXIS[1] - 0.5 * BEAM_MM, BEAM_Z[0]])
    size = np.array([BEAM_MM, BEAM_MM, BEAM_Z[1] - BEAM_Z[0]])
    nodes, tets = _box(low, size, (6, 6, 20))
    meshio.write(folder / "beam.vtu", meshio.Mesh(nodes, [("tetra", tets)]))
    found: dict[str, Any] = {"authors_kpa": 264.0}
    for boundary, hangs in (("moving", True), ("fixed", True), ("moving", False)):
        for load, grams in WEIGHTS_G.items():
            ends = [(3, BEAM_Z[0]), (0, BEAM_Z[1])] if boundary == "moving" else [(0, BEAM_Z[1])]
            places, motions = [], []
            for first, z in ends:
                rotation, shift = _rigid(markers["gravity"][first : first + 3], markers[load][first : first + 3])
                points = low + size * np.array([[a, b, 0.0] for a in (0.1, 0.5, 0.9) for b in (0.1, 0.5, 0.9)])
                points[:, 2] = z + (0.01 if z == BEAM_Z[0] else -0.01)
                places.append(points)
                motions.append(points @ rotation.T + shift - points)
            _pairs(folder / "faces.csv", np.concatenate(places), np.concatenate(motions))
            traction = -1e3 * grams * GRAVITY / BEAM_MM**2
            weight = "".join(
                f'[[loads]]\nkind = "gravity"\nstate = {state}\nacceleration_m_s2 = [{-1e3 * GRAVITY}, 0.0, 0.0]\n'
                for state in (0, 1)
            )
            (folder / "case.toml").write_text(
                f'[body]\nmesh = "beam.vtu"\n[[surfaces]]\nname = "clamp"\nwhere = "z_min"\nboundary = "{boundary}"\n'
                '[[surfaces]]\nname = "tip"\nwhere = "z_max"\nboundary = "free"\n[tissues.beam]\nlabel = 1\n'
                f'role = "estimate"\npoisson_ratio = 0.49\ndensity_kg_m3 = {BEAM_KG_M3}\n'
                "[discrepancy]\nheterogeneity_sd = 0.0\npoisson_sd = 0.0\n"
                "[estimate]\nstarts_kpa = [100.0, 400.0]\nbounds_kpa = [10.0, 10000.0]\n"
                f'[[loads]]\nkind = "traction"\nsurface = "tip"\nstate = 1\ntraction_kpa = [{traction}, 0.0, 0.0]\n'
                f"{weight if hangs else ''}"
                f'[[data]]\nkind = "landmarks"\nfile = "faces.csv"\nsd_mm = {FACE_SD_MM}\n'
            )
            result = estimate(read_case(folder / "case.toml")).estimation
            (item,) = result.estimates
            found[f"{load}, clamp {boundary}{'' if hangs else ', weightless'}"] = {
                "youngs_modulus_kpa": item.value and round(item.value, 1),
                "interval95": [end and round(end, 1) for end in item.interval95 or (None, None)],
                "verdict": item.verdict,
                "landmarks_rms_mm": round(result.fits[0][0].end.rms_mm, 3),
            }
    return found


def beads(options: Options) -> dict[str, Any]:
    """The ratio of the moduli of two parts of one homogeneous gel, by all beads in it."""
    data, folder = options.data, options.folder
    with np.load(data / "beads.npz") as file:
        rest, later, partner = (file[name] for name in ("reference_um", "deformed_um", "match_extended"))
    known = partner >= 0
    before, after = rest[known].astype(np.float64), later[partner[known]].astype(np.float64)
    inside = np.all((before > GEL_LOW) & (before < GEL_HIGH), axis=1)
    nodes, tets = _box(GEL_LOW, GEL_HIGH - GEL_LOW, GEL_CELLS)
    away = np.abs(nodes[tets].mean(axis=1) - 0.5 * (GEL_LOW + GEL_HIGH)) / (0.5 * (GEL_HIGH - GEL_LOW))
    inner = (away[:, :2] < GEL_INNER).all(axis=1)
    mesh = meshio.Mesh(nodes, [("tetra", tets)], cell_data={"tissue": [np.where(inner, 1, 2)]})
    meshio.write(folder / "gel.vtu", mesh)
    _pairs(folder / "beads.csv", before[inside], (after - before)[inside])
    (folder / "case.toml").write_text(
        '[body]\nmesh = "gel.vtu"\n[[surfaces]]\nname = "border"\nwhere = "boundary"\n[tissues.inner]\nlabel = 1\n'
        f'role = "estimate"\npoisson_ratio = 0.475\n{GEL_FIELD if options.mapped else ""}'
        '[tissues.rest]\nlabel = 2\nrole = "known"\npoisson_ratio = 0.475\n'
        "youngs_modulus_kpa = 1.0\n[driver]\nmodes = 300\nkernel_mm = 30.0\nprior_mm = 10.0\n[discrepancy]\n"
        "heterogeneity_sd = 0.0\npoisson_sd = 0.01\n"
        f'[[data]]\nkind = "displacement-field"\nfile = "beads.csv"\nsd_mm = {options.bead_sd}\n'
        f"correlation_mm = {options.alike}\n"
    )
    result = estimate(read_case(folder / "case.toml")).estimation
    (item,) = result.estimates
    by_map = {"map": _flatness(of, float(item.value))} if (of := next(iter(result.maps), None)) and item.value else {}
    return by_map | {
        "beads": int(inside.sum()),
        "ratio": item.value,
        "interval95": item.interval95,
        "verdict": item.verdict,
        "misfit_rms_um": round(result.fits[0][0].end.rms_mm, 4),
        "information_shares": result.information_shares,
        "status": result.status,
    }


def _flatness(found: StiffnessMap, mean: float) -> dict[str, Any]:
    """How far a map, with the geometric mean of its moduli, is from the value 1 that all of them have."""
    moduli = mean * np.exp(found.log_ratio)
    inside = np.abs(np.log(moduli)) < NORMAL_95 * found.sd
    return {
        "elements": len(moduli),
        "inside_95": round(float(inside.mean()), 3),
        "moduli_2.5_50_97.5_percent": np.percentile(moduli, (2.5, 50.0, 97.5)).round(2).tolist(),
        "sd_ln_modulus_50_percent": round(float(np.median(found.sd)), 3),
        "resolved": round(found.resolved, 3),
        "prior_sd": round(found.prior_sd, 3),
        "region": found.region
        and {
            "probability": round(found.region.probability, 4),
            "volume_um3": round(1e3 * found.region.volume_ml),
            "centre_um": found.region.centre_mm.round(1).tolist(),
            "contrast": round(found.region.contrast, 2),
            "interval95": [round(end, 2) for end in found.region.interval95 if end is not None],
        },
    }


def _plot(name: str, found: dict[str, Any], path: Path) -> None:
    """The values found, with their intervals, and the values known from elsewhere."""
    rows: list[tuple[str, float, Sequence[float]]] = []
    told: list[tuple[str, float]] = []
    if name == "tpu":
        unit = "force (N)"
        for item in found["predictions"]:
            rows.append((f"step {item['step']}, predicted", item["force_n"], item["interval95"]))
            told += [(f"step {item['step']}, measured", item["measured_n"])] if item["measured_n"] is not None else []
    elif name == "beam":
        unit = "Young's modulus (kPa)"
        every = [(key, item) for key, item in found.items() if isinstance(item, dict)]
        rows = [(key, item["youngs_modulus_kpa"], item["interval95"]) for key, item in every]
        told = [("the authors' fit of the swinging beam", found["authors_kpa"])]
    else:
        unit = "modulus of the inner part over that of the rest"
        rows, told = [("all beads", found["ratio"], found["interval95"])], [("one gel", 1.0)]
    figure = Figure(figsize=(7.0, 1.3 + 0.4 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    for place, (_, value, (low, high)) in enumerate(rows):
        axes.plot([low, high], [place, place], color="#4c78a8", linewidth=5, solid_capstyle="round", alpha=0.5)
        axes.plot(value, place, "o", color="#1f3a5f")
    for place, (label, value) in enumerate(told):
        axes.axvline(value, color="#c0392b", linestyle=("--", ":")[place % 2], label=label)
    axes.set_yticks(range(len(rows)), [label for label, _, _ in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlabel(unit)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.35 if len(rows) < 3 else 1.2), frameon=False, ncols=2)
    figure.savefig(path, metadata={"Date": None})


def of_skin(options: Options) -> dict[str, Any]:
    """Healthy skin, and a keloid over skin, by the largest pull of `fit`."""
    return skin(options.data, max(options.fit), options.predict)


EXPERIMENTS = {"tpu": tpu, "beam": beam, "beads": beads, "skin": of_skin}


def _inverted(case: Case, *, prior: tuple[float, float] | None = None) -> Inversion:
    """The inversion of a case; prior: mean and standard deviation of ln E (kPa)."""
    body = make_body(read_states(case), case, progress=lambda _: None)
    problem = inverse_problem(body, case, progress=lambda _: None)
    if prior is not None:
        mean, sd = (np.array([value]) for value in prior)
        problem = replace(problem, parameters=problem.parameters.with_prior(mean, sd))
    return invert(problem, inversion_settings(case, problem.parameters), progress=lambda _: None)


def _poisson_shift(inversion: Inversion) -> float:
    """By how much the tissue's Poisson's ratio differs from the given one."""
    parameters, x = inversion.objective.parameters, inversion.minimum.unknowns
    columns = [parameters.columns(i) for i, block in enumerate(parameters.blocks) if block.cause == "poisson"]
    return float(x[columns[0][0]])


def _mpa(kpa: float | None) -> float | None:
    return None if kpa is None else round(1e-3 * kpa, 4)


def _table(path: Path) -> Array:
    return np.asarray(np.loadtxt(path, delimiter=",", skiprows=1))


def _pairs(path: Path, points: Array, moved: Array) -> None:
    np.savetxt(path, np.concatenate([points, points + moved], axis=1), delimiter=",", header=HEAD, comments="")


def _markers(path: Path) -> dict[str, Array]:
    """Markers (6, 3) mm by state."""
    rows = [line.split(",") for line in path.read_text().splitlines()[1:]]
    states = dict.fromkeys(row[0] for row in rows)
    return {state: np.array([[float(x) for x in row[2:5]] for row in rows if row[0] == state]) for state in states}


def _rigid(before: Array, after: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and shift (3,) mm that bring points (n, 3) mm nearest to others (Kabsch)."""
    middle, other = before.mean(axis=0), after.mean(axis=0)
    left, _, right = np.linalg.svd((after - other).T @ (before - middle))
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return turn, other - turn @ middle


def _box(low: Array, size: Array, cells: tuple[int, int, int]) -> tuple[Array, NDArray[np.int64]]:
    """Nodes (n, 3) mm and tetrahedra (n_tets, 4) of a box, six in each cell."""
    counts = np.array(cells) + 1
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3)
    corner = index[(index < np.array(cells)).all(axis=1)]
    tets = []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        steps = np.cumsum(np.concatenate([np.zeros((1, 3), int), np.eye(3, dtype=int)[list(order)]]), axis=0)
        tets.append(np.stack([np.ravel_multi_index((corner + step).T, counts) for step in steps], axis=1))
    return low + size * index / np.array(cells), np.concatenate(tets).astype(np.int64)


if __name__ == "__main__":
    sys.exit(main())
