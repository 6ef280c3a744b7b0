"""The figures in README and docs: each stands between two comments, and what stands there comes from docs/figures.json.

`<!--demo.seconds-->80<!--/-->` is the number `seconds` of the part `demo`. A name may end in a format, as in
`<!--pairs.one:.2f-->`. `demo.commit`, `demo.command` and `demo.minutes` say where the part comes from. A list of lines
becomes a block of text, and a view (`VIEWS`) a table with its source; their comments stand on lines of their own.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["FILE", "ROOT", "Figures", "complaints", "pages", "read_figures", "rewritten"]

Values = dict[str, Any]
Figures = Mapping[str, Mapping[str, Any]]  # part -> command, commit, machine, minutes, values

ROOT = Path(__file__).parents[1]
FILE = ROOT / "docs" / "figures.json"
MARK = re.compile(r"<!--([a-z]+\.[\w.-]+?)(?::([\w.+%]+))?-->(.*?)<!--/-->", re.DOTALL)
ABOUT = ("commit", "command", "minutes", "machine")
TABLED = ("rows.", "laws.", "families.", "commit")  # what a view shows of its branch


class View(NamedTuple):
    """A table, the part that it is of, and the branch of its values whose rows it shows ("" for the part's own)."""

    part: str
    branch: str
    table: Callable[[Any], list[str]]


def read_figures(file: Path = FILE) -> dict[str, dict[str, Any]]:
    """The file of all figures."""
    found: dict[str, dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))
    return found


def pages() -> list[Path]:
    """README and all pages of the docs."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def rewritten(text: str, figures: Figures) -> str:
    """A page with every figure as the file has it; raises `KeyError` for a name that the file has not."""

    def figure(match: re.Match[str]) -> str:
        """The figure between its comments."""
        name, form, _ = match.groups()
        begin = f"<!--{name}:{form}-->" if form else f"<!--{name}-->"
        shown = _shown(figures, name, form or "")
        return f"{begin}\n{shown}\n<!--/-->" if "\n" in shown else f"{begin}{shown}<!--/-->"

    return MARK.sub(figure, text)


def complaints(texts: Mapping[str, str], figures: Figures) -> Iterator[str]:
    """What is wrong with the pages (name -> text): figures that differ, are not in the file, or stand nowhere."""
    stated = set[str]()
    for page, text in texts.items():
        names = [match[1] for match in MARK.finditer(text)]
        stated |= set(names)
        if text.count("<!--/-->") != len(names) or len(re.findall(r"<!--[a-z]+\.", text)) != len(names):
            yield f"{page}: a figure's comment lacks its end or its beginning"
        for match in MARK.finditer(text):
            begins = text[: match.start()].endswith("\n") or not match.start()
            if begins and "\n" not in match[3]:
                yield f"{page}: a line begins with {match[1]}: Markdown would take the line for HTML"
        try:
            if rewritten(text, figures) != text:
                yield f"{page}: figures differ from docs/figures.json; run make figures PARTS=text"
        except KeyError as error:
            yield f"{page}: docs/figures.json has no {error}"
    views = [VIEWS[name] for name in stated & VIEWS.keys()]
    shown = tuple(".".join(filter(None, (v.part, v.branch, key))) for v in views for key in TABLED)
    for leaf in _leaves(figures):
        if leaf not in stated and not leaf.startswith(shown):
            yield f"no page states {leaf}: a figure that nobody needs goes from the file"


def digest(path: Path) -> str:
    """The first letters of a file's SHA-256: whether a picture is the one that the command drew."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _leaves(figures: Figures) -> Iterable[str]:
    def below(name: str, value: Any) -> Iterator[str]:
        """The names of single figures."""
        for key, item in value.items():
            if isinstance(item, dict):
                yield from below(f"{name}.{key}", item)
            else:
                yield f"{name}.{key}"

    for part, found in figures.items():
        if part != "pictures":  # which no page states, but which pages show
            yield from below(part, found["values"])


def _shown(figures: Figures, name: str, form: str) -> str:
    """A figure as it stands in a page."""
    if name in VIEWS:
        view = VIEWS[name]
        of = figures[view.part]
        values = _at(of["values"], view.branch.split(".") if view.branch else [], name)
        source = _source(of, values) if values.get("rows", True) else "Not computed yet."
        return "\n".join(["", *view.table(values), "", f"*{source}*", ""])
    part, *path = name.split(".")
    value = figures[part][path[0]] if path[0] in ABOUT else _at(figures[part]["values"], path, name)
    if isinstance(value, list):
        return "\n".join(["", "```text", *value, "```", ""])
    return format(value, form) if form else str(value)


def _at(values: Any, path: Iterable[str], name: str) -> Any:
    for key in path:
        if not isinstance(values, dict) or key not in values:
            raise KeyError(name)
        values = values[key]
    return values


def _source(part: Mapping[str, Any], values: Mapping[str, Any]) -> str:
    """Where the figures of a part come from; values may have commits of their own."""
    took = f", {part['minutes']} minutes on {part['machine']}" if part["minutes"] else ""
    return f"`{part['command']}`: commit {values.get('commit', part['commit'])}{took}."


Columns = Mapping[str, str | Callable[[Any], str]]  # heading -> a format of a row's figures, or what writes them
MAY_LACK = ("Cramer-Rao limit", "half-width (median)")  # columns that are left out where they are empty


def table_of(
    values: Mapping[str, Any], columns: Columns, branch: str = "rows", order: Iterable[str] | None = None
) -> list[str]:
    """A table of a branch of figures, a line a row; a cell whose figure is None is empty, and so may be a column."""
    rows = [_named(name, values[branch][name]) for name in order or values[branch]]
    cells = {head: [_cell(of, row) for row in rows] for head, of in columns.items()}
    shown = {head: column for head, column in cells.items() if any(column) or head not in MAY_LACK}
    return [_line(shown), _line(["---"] * len(shown)), *map(_line, zip(*shown.values(), strict=True))]


def _named(name: str, row: Any) -> Values:
    """The figures of a row with its name; those of a list by their numbers."""
    return {"name": name} | (row if isinstance(row, dict) else {f"n{k}": value for k, value in enumerate(row)})


def _cell(of: str | Callable[[Any], str], row: Values) -> str:
    try:
        return of.format_map(row) if isinstance(of, str) else of(row)
    except TypeError:  # of a figure that is None
        return ""


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |".replace("|  |", "| |").replace("|  |", "| |")


def _with_error(row: Mapping[str, Any]) -> str:
    """An RMS and its own standard error, which is 1 / sqrt(2 n) of it for n independent errors."""
    rms, digits = row["rms"], 4 if row["rms"] < 0.005 else 3
    return f"{rms:.{digits}f} ± {rms / math.sqrt(2.0 * row['moduli']):.{digits}f}"


def _held(row: Mapping[str, Any]) -> str:
    return f"{row['held']} of {row['stated']}" if row["stated"] else ""


def _ends(interval: Sequence[float | None]) -> str:
    """An interval of which an end may be open."""
    low, high = interval
    if low is None or high is None:
        return "open" if low is high else f"below {high:.2f}" if low is None else f"above {low:.2f}"
    return f"{low:.2f} to {high:.2f}"


def _listed(values: Iterable[Any]) -> str:
    return ", ".join(map(str, values))


SEEN = {  # the rows of benchmarks/accuracy.py, in the order of the tables, and what an estimate sees there
    "same-mesh": "surfaces of the mesh that inverts them (tests the optimiser only)",
    "other-mesh": "exact surfaces of a finer mesh",
    "clean": "voxels of 1 mm, a rectum that fills by 6 to 8 mm",
    "finite-clean": "the same, neo-Hookean law",
    "clean-3mm": "voxels of 1 mm, a rectum that fills by 3 mm",
    "finite-clean-3mm": "the same, neo-Hookean law",
    "tumour": "voxels of 1 mm, 6 to 8 mm of filling, a tumour in the prostate",
    "nu-0.49": "voxels of 1 mm, 6 to 8 mm of filling, a Poisson's ratio of 0.49",
    "noise": "voxels of 1 x 1 x 2.5 mm, surfaces off by 0.3 mm",
    "finite-noise": "the same, neo-Hookean law",
}
ACCURACY: Columns = {
    "row": "`{name}`",
    "what the estimate sees": lambda row: SEEN[row["name"]],
    "moduli": "{moduli}",
    "RMS of ln E": _with_error,
    "95 % intervals that hold": _held,
    "Cramer-Rao limit": "{limit:.2f}",
}


def _accuracy_short(values: Mapping[str, Any]) -> list[str]:
    """The same for README: both laws beside each other, errors in per cent."""

    def cell(name: str) -> str:
        """The error and how many intervals hold."""
        row = values["rows"].get(name)
        if row is None:
            return ""
        percent = 100.0 * row["rms"]
        error = f"{percent:.1f} %" if percent < 1.0 else f"{percent:.0f} %"
        return error + (f", {_held(row)}" if row["stated"] else "")

    laws = {"other-mesh": "", "clean": "finite-clean", "clean-3mm": "finite-clean-3mm", "tumour": ""}
    lines = [_line(["the estimate sees", "linear law", "neo-Hookean law"]), _line(["---"] * 3)]
    for linear, finite in (laws | {"noise": "finite-noise"}).items():
        lines.append(_line([SEEN[linear], cell(linear), cell(finite)]))
    return lines


MISMATCH: Columns = {
    "scenes": "`{name}`",
    "bodies": "{bodies}",
    "RMS of ln E, prostate, bladder": lambda row: ", ".join(f"{value:.2f}" for value in row["rms"]),
    "largest": "{largest:.2f}",
    "half-width (median)": "{half_width:.2f}",
    "identified, weak, not identified": lambda row: _listed(row["verdicts"]),
    "95 % intervals that hold": "{held} of {stated}",
}
ROWS = {  # of benchmarks/coverage.py, as the table names them
    "gauss-0.1": "smooth noise of 0.1 mm",
    "gauss-0.2": "the same of 0.2 mm",
    "matern": "rougher noise",
    "bumps": "bumps of 2 to 4 mm on 5 % of a surface",
    "uneven": "one image smoother than the other",
    "resegmented": "one image smoothed otherwise",
    "shrunk": "organs drawn 0.2 mm smaller",
    "patchy": "ln E varies by 0.3 to 0.6 inside tissues",
    "moving": "a border that moves by 1 to 2.5 mm",
    "balls": "another anatomy: balls",
    "liver": "another anatomy: a liver",
    "other-law": "a truth of another law",
    "finite": "as `gauss-0.1`, neo-Hookean law",
    "surfaces": "as `moving`, noise of 0.3 mm",
    "markers": "the same, and 30 markers of 0.3 mm",
    "field-1": "the same, and 1500 displacements of 1 mm",
    "field-0.5": "the same of 0.5 mm",
    "field-0.2": "the same of 0.2 mm",
}
COVERAGE: Columns = {
    "row": "`{name}`",
    "what is wrong or measured": lambda row: ROWS[row["name"]],
    "identified, weak, not identified": lambda row: _listed(row["verdicts"]),
    "95 % intervals that hold": _held,
    "error of ln E (median)": "{error:.2f}",
}
SPEED: Columns = {
    "law": "{name}",
    "unknowns": lambda row: f"{row['unknowns']:,}".replace(",", " "),
    "time": "{seconds:.0f} s",
    "peak memory": "{peak_gb:.1f} GB",
    "time with frame and tissues held": "{held_seconds:.0f} s",
}
SOURCE: Columns = {
    "surfaces off by": lambda row: f"{row['noise_mm']:g} mm" + ("" if row["law"] == "linear" else f", {row['law']}"),
    "later images": "{images}",
}
COST: Columns = {
    "time of one processor": "{seconds:.0f} s",
    "peak memory": "{peak_gb:.1f} GB",
}
PATIENTS: Columns = {
    **SOURCE,
    "patients": "{patients}",
    "error of ln E (RMS, median)": "{rms:.2f}, {error:.2f}",
    "half-width (median)": "{half_width:.2f}",
    "stated moduli": "{stated} of {moduli}",
    "95 % intervals that hold": _held,
    **COST,
}
PATIENTS_SHORT: Columns = {
    **SOURCE,
    "moduli with a stated interval": PATIENTS["stated moduli"],
    "of these hold": PATIENTS["95 % intervals that hold"],
    "median error of ln E": "{error:.2f}",
}


def _patients_cost(values: Mapping[str, Any]) -> list[str]:
    """For the page of speed: what a number of later images costs at the largest noise."""
    most = max((row["noise_mm"] for row in values["rows"].values()), default=0.0)
    rows = {name: row for name, row in values["rows"].items() if row["noise_mm"] == most}
    return table_of({"rows": rows}, {"later images": SOURCE["later images"], **COST})


COHORT: Columns = {
    "organ": "{name}",
    "patients of the lower, the higher stage": lambda row: _listed(row["patients"]),
    "with a value, with an interval alone": "{stated}, {censored}",
    "factor found": "{factor:.2f}",
    "its 95 % interval": lambda row: "" if row["undefined"] else _ends(row["interval95"]),
    "p": "{p:.3f}",
    "true factor": "{truth:.2f}",
    "of the moduli that were drawn": "{drawn:.2f}",
}
FAMILIES = {  # of `palpate verify`: what each is, and with what it is compared
    "B0": "patch test, rotations, translation (exact)",
    "B1 to B3": "thick spheres and cylinders under pressure, nu up to 0.4999 (closed form; Code_Aster)",
    "B4": "concentric organs: displacements, ratios, log-sensitivities (closed form)",
    "B5": "Eshelby's sphere in a large matrix, also nearly incompressible (Eshelby 1957)",
    "B6": "spherical cavity under tension (Southwell & Gough 1926)",
    "B7": "Cook's membrane: plane stress, plane strain, incompressible (published; the last our own)",
    "B8": "Hertz, flat punch, Boussinesq (closed form; Code_Aster)",
    "B9": "uniaxial and equibiaxial tension at finite strain (closed form)",
    "B10": "shear and plane strain at finite strain (closed form)",
    "B11 to B13": "thick balloons of one and two layers, limit point, tube (closed form)",
    "B16": "manufactured solutions: observed orders, both laws (theory)",
    "E1": "moduli of simulated spheres, truth on another mesh (truth)",
    "E2, E5, E6": "scale invariance, singular values, a parameter at its bound (exact, closed form)",
    "E3": "coverage of the 95 % intervals in 200 repeats (90 to 98 %)",
    "E4": "gradients against central differences (adjoint identity)",
}
VERIFICATION: Columns = {
    "problems": "{name}",
    "what (reference)": lambda row: FAMILIES[row["name"]],
    "error, %": "{n0:.2g}",
    "tolerance, %": "{n1:.2g}",
}
VIEWS = {
    "accuracy.table": View("accuracy", "", partial(table_of, columns=ACCURACY, order=SEEN)),
    "accuracy.short": View("accuracy", "", _accuracy_short),
    **{
        f"mismatch.{of}-table": View("mismatch", of, partial(table_of, columns=MISMATCH)) for of in ("linear", "finite")
    },
    "mismatch.noise-table": View("mismatch", "noise", partial(table_of, columns=MISMATCH)),
    "coverage.table": View("coverage", "", partial(table_of, columns=COVERAGE, order=ROWS)),
    "patients.table": View("patients", "", partial(table_of, columns=PATIENTS)),
    "patients.short": View("patients", "", partial(table_of, columns=PATIENTS_SHORT)),
    "patients.cost": View("patients", "", _patients_cost),
    "patients.cohort-table": View("patients", "cohort", partial(table_of, columns=COHORT)),
    "speed.table": View("speed", "", partial(table_of, columns=SPEED, branch="laws")),
    "verification.table": View("verification", "", partial(table_of, columns=VERIFICATION, branch="families")),
}
