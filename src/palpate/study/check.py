"""Every problem of a case at once, before anything is solved: files, tissues, organs, mesh, expected cost."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from palpate.errors import PalpateError, ResourceError
from palpate.findings import Finding, of_pair, one_a_cause, rank
from palpate.images.checks import (
    OBSERVED,
    absent_tissues,
    check_pair,
    check_segmentation,
    later_names,
    refuse_absent,
)
from palpate.images.label_table import read_label_table
from palpate.images.readers import read_intensities
from palpate.images.registration import Registration, length_text
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.progress import Progress
from palpate.study.body import Body, cost_of_bodies, joint_problem, make_body
from palpate.study.case import Case
from palpate.study.case_file import read_case
from palpate.study.case_loads import load_warnings
from palpate.study.contacts import every_finding
from palpate.study.cost import (
    LESS_MEMORY,
    MEMORY_FACTOR,
    ExpectedCost,
    expected_cost,
    free_memory_gb,
    lack_of_memory,
    machine_memory_gb,
)
from palpate.study.imaged import ImagedStates, brought
from palpate.study.plausibility import unit_warnings
from palpate.study.prediction import Prediction
from palpate.study.provenance import file_digest
from palpate.study.read import measured, read_case_images, read_segmentation, read_states
from palpate.study.refusals import refuse_lost, refuse_unmeshable
from palpate.study.samples import require_samples

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that an estimate would refuse (`exit_code` > 0) or warn of (0)."""

    code: str
    message: str
    exit_code: int = 0


@dataclass(frozen=True, slots=True)
class OrganRow:
    """A tissue in the images: its volume in each of them, mL."""

    tissue: str
    role: str
    volumes_ml: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class CheckReport:
    """All problems of a case, its organs and what its estimate would cost (None when that cannot be told).

    alignments: how each later image lay, by its name; none where nothing was aligned; measured: what was read of each
    file of [[data]], by its name; predicted: the intervals that may be expected, where they were asked for.
    """

    id: str
    problems: tuple[Problem, ...]
    images: tuple[str, ...] = ()
    organs: tuple[OrganRow, ...] = ()
    cost: ExpectedCost | None = None
    alignments: tuple[tuple[str, Registration], ...] = ()
    measured: Mapping[str, str] = field(default_factory=dict)
    predicted: Prediction | None = None

    @property
    def exit_code(self) -> int:
        """0, or that of the first problem, with which an estimate would end."""
        return self.problems[0].exit_code if self.problems else 0

    def to_dict(self) -> dict[str, Any]:
        """A JSON document, schema palpate.check/1."""
        cost = self.cost
        return {
            "schema": "palpate.check/1",
            "id": self.id,
            "exit_code": self.exit_code,
            "problems": [
                {
                    "severity": "refused" if problem.exit_code else "warning",
                    "code": problem.code,
                    "message": problem.message,
                    "exit_code": problem.exit_code,
                }
                for problem in self.problems
            ],
            "alignment": [found.row(name) for name, found in self.alignments],
            "data": dict(self.measured),
            "organs": [
                {
                    "tissue": row.tissue,
                    "role": row.role,
                    "volume_ml": dict(zip(self.images, row.volumes_ml, strict=False)),
                }
                for row in self.organs
            ],
            "expected": cost
            and {
                "tetrahedra": cost.tets,
                "unknowns": cost.unknowns,
                "memory_gb": round(cost.memory_gb, 2),
                "seconds": round(cost.seconds),
                "solver": cost.solver,
                "processors": cost.processors,
            },
            "predicted": self.predicted and self.predicted.to_dict(),
        }

    def text(self) -> str:
        """The same for people, worst first."""
        lines = [f"refused ({p.exit_code}): {p.message}" for p in self.problems if p.exit_code]
        lines += [f"warning ({p.code}): {p.message}" for p in self.problems if not p.exit_code]
        if not lines:
            lines = ["no problem was found"]
        for row in self.organs:
            volumes = ", ".join(f"{volume:.4g}" for volume in row.volumes_ml)
            lines.append(f"{row.tissue} ({row.role}): {volumes} mL")
        for name, found in self.alignments:
            kept = ", ".join(f"{tissue} {length_text(mm)}" for tissue, mm in found.residual_by_tissue_mm.items())
            lines.append(f"alignment: '{name}' {found.in_words} (surfaces then lie apart by, in mm: {kept})")
        lines += [f"{name}: {words}" for name, words in self.measured.items()]
        if self.cost is not None:
            cost = self.cost
            lines.append(
                f"expected: {cost.tets} tetrahedra, {cost.unknowns} unknowns, {cost.memory_gb:.1f} GB,"
                f" {cost.seconds / 60.0:.1f} min with {cost.solver} on {cost.processors} processor(s)"
            )
        if self.predicted is not None:
            lines += self.predicted.lines()
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class Checked:
    """A case as far as it was found good: its report, and what was made on the way.

    states: its pairs of images that can be read, aligned; bodies: their meshes, none where something was refused.
    """

    report: CheckReport
    case: Case | None = None
    states: tuple[ImagedStates, ...] = ()
    bodies: tuple[Body, ...] = ()


class _Problems:
    """Collects what goes wrong, and goes on."""

    def __init__(self) -> None:
        self.found: list[Problem] = []
        self._findings: list[Finding] = []

    def attempt(self, make: Callable[[], T]) -> T | None:
        """What `make` returns; None, and a problem, when it is refused."""
        try:
            return make()
        except PalpateError as error:
            self.add(Problem(type(error).__name__, str(error), error.exit_code))
        except MemoryError:
            self.add(Problem("ResourceError", "memory is short for these images; crop them", ResourceError.exit_code))
        return None

    @property
    def refused(self) -> bool:
        """Whether an estimate would refuse something."""
        return any(problem.exit_code for problem in self.found)

    def add(self, problem: Problem) -> None:
        """Keep a problem once."""
        if problem not in self.found:
            self.found.append(problem)

    def warn(self, findings: Sequence[Finding], pair: int = 1) -> None:
        """Keep findings on the images of a pair."""
        self._findings += of_pair(findings, pair)

    def all(self) -> tuple[Problem, ...]:
        """Everything that was kept, one a cause: refusals as they were found, then warnings, worst first."""
        warned = [p for p in self.found if not p.exit_code]
        warned += [Problem(each.code, each.message) for each in one_a_cause(self._findings)]
        refused = [p for p in self.found if p.exit_code]
        return (*refused, *sorted(warned, key=lambda problem: rank(problem.code)))


def check_case(source: Path | Case, overrides: Sequence[str], *, progress: Progress) -> CheckReport:
    """The report of `checked_case`."""
    return checked_case(source, overrides, progress=progress).report


def checked_case(
    source: Path | Case, overrides: Sequence[str] = (), *, progress: Progress, meshed: bool = True
) -> Checked:
    """All problems of a case, or of a case file (with overrides as in `read_case`), its organs and its expected cost.

    It does what an estimate does up to where solving begins, and refuses with the same sentence; where an estimate ends
    it goes on, to find the other problems. Without `meshed` it ends before the mesh. Raises nothing for a bad case.
    """
    problems = _Problems()
    if isinstance(source, Case):
        case = source
    elif (read := problems.attempt(partial(read_case, source, overrides))) is not None:
        case = read
    else:
        return Checked(CheckReport(source.stem, problems.all()))
    problems.warn((*unit_warnings(case), *load_warnings(case)))
    progress("reading the images")
    images = problems.attempt(partial(read_case_images, case, progress=progress))
    pairs = _further_problems(problems, case, progress) if images is None else images.pairs
    if not pairs:
        return Checked(CheckReport(case.id, problems.all()), case)
    if images is not None:
        _remarks(problems, case, pairs)
    cost, bodies = problems.attempt(lambda: _cost(problems, pairs, case, progress, meshed=meshed)) or (None, ())
    before, after = pairs[0].before, pairs[0].after
    names = ("before", *(f"after[{i}]" for i in range(len(after))))
    organs = tuple(
        OrganRow(t.name, str(t.role), tuple(round(volume / 1000.0, 4) for volume in pairs[0].volumes(i)))
        for i, t in enumerate(before.tissues)
        if t.meshed or pairs[0].mesh is None
    )
    found = [
        (f"pair {n}: {name}" if n > 1 else name, one)
        for n, pair in enumerate(pairs, start=1)
        for name, one in zip(later_names(len(pair.after)), pair.alignments, strict=False)
    ]
    files = [(source.file, source.in_words) for pair in pairs for source in pair.data]
    measured_words = {f.name + (f", state {f.state}" if f.state > 1 else ""): words for f, words in files}
    report = CheckReport(case.id, problems.all(), names, organs, cost, tuple(found), measured_words)
    return Checked(report, case, tuple(pairs), bodies)


def _remarks(problems: _Problems, case: Case, pairs: Sequence[ImagedStates]) -> None:
    """What an estimate would warn of, what organs do to each other, and grey images that its report cannot show."""
    for number, pair in enumerate(pairs, start=1):
        problems.warn(pair.findings, number)
        if pair.mesh is None:
            problems.warn(every_finding(pair.before, pair.after, loaded=bool(case.loads)), number)
    for grey in _grey_images(case):
        try:
            read_intensities(grey)
        except PalpateError as error:
            problems.add(Problem("report", f"the report will show labels in place of the grey image: {error}"))


def _cost(
    problems: _Problems, pairs: Sequence[ImagedStates], case: Case, progress: Progress, *, meshed: bool
) -> tuple[ExpectedCost, tuple[Body, ...]]:
    """What an estimate would cost on its very meshes, and these; on meshes of a guessed size where one is refused.

    All is made of which an estimate begins to solve; `meshed`: else nothing is.
    """
    first = pairs[0]
    cost = expected_cost(case, first.before, first.after, n_pairs=len(pairs), mesh=first.mesh)
    if problems.refused or not meshed or lack_of_memory(cost):
        problems.found += memory_problems(cost)
        return cost, ()
    bodies = [problems.attempt(partial(make_body, pair, case, progress=progress)) for pair in pairs]
    made = tuple(body for body in bodies if body is not None)
    for number, body in enumerate(made, start=1):
        problems.warn(body.findings, number)
    if len(made) == len(pairs):
        cost = cost_of_bodies(made, case)
        if not lack_of_memory(cost):
            problems.attempt(partial(joint_problem, made, case, progress=progress))
    problems.found += memory_problems(cost)
    return cost, () if problems.refused else made


Pair = tuple[Segmentation, tuple[Segmentation, ...]]


def _further_problems(problems: _Problems, case: Case, progress: Progress) -> tuple[ImagedStates, ...]:
    """All states that can be made of a case that an estimate refuses, with every check made on each of them."""
    problems.attempt(partial(require_samples, case))
    if case.phantom is not None or case.body is not None:  # nothing to read one by one
        states = problems.attempt(partial(read_states, case, progress=progress))
        problems.warn(() if states is None else states.findings)
        return () if states is None else (states,)
    found, first = list[ImagedStates](), 0
    for before, after in _read_pairs(case, problems):
        states = _checked_pair(problems, ImagedStates(before, after, (), ()), case, len(found) + 1, progress)
        data = problems.attempt(partial(measured, case, states, first=first))
        found.append(states if data is None else replace(states, data=data[0]))
        first += states.n_later
    return tuple(found)


def _grey_images(case: Case) -> tuple[Path, ...]:
    images = case.images
    return () if images is None else tuple(g for g in (images.intensities_before, *images.intensities_after) if g)


def _read_pairs(case: Case, problems: _Problems) -> list[Pair]:
    """Every pair whose reference state can be read, with those later states that can; each file is tried."""
    images = case.images
    if images is None:
        return []
    table = images.names
    names = problems.attempt(lambda: read_label_table(table)) if table else None
    for grey in _grey_images(case):
        problems.attempt(partial(file_digest, grey))
    pairs: list[Pair] = []
    for reference, later in ((images.before, images.after), *((pair.before, pair.after) for pair in case.pairs)):
        before = problems.attempt(partial(read_segmentation, case, reference, names, None))
        tissues = before.tissues if before else None
        after = [problems.attempt(partial(read_segmentation, case, path, names, tissues)) for path in later]
        if before is not None:
            pairs.append((before, tuple(image for image in after if image is not None)))
    return pairs


def _checked_pair(
    problems: _Problems, states: ImagedStates, case: Case, number: int, progress: Progress
) -> ImagedStates:
    """The images of one pair, aligned and with every check made on them.

    An organ that is absent is named, and left out of the other checks; the images are then not aligned.
    """
    before, after = states.before, states.after
    problems.attempt(partial(refuse_absent, before, after))
    absent = set(absent_tissues(before, after))
    if not absent:
        states = problems.attempt(partial(brought, before, after, method=case.align, progress=progress)) or states
        problems.warn(states.findings, number)
    in_place = bool(states.bones) or not any(tissue.role is Role.RIGID for tissue in before.tissues)
    before, after = _without(before, absent), tuple(_without(image, absent) for image in states.after)
    problems.warn(check_segmentation(before, "before"), number)
    problems.attempt(partial(refuse_unmeshable, before, "before"))
    for name, image in zip(later_names(len(after)), after, strict=True):
        problems.warn(check_segmentation(image, name), number)
        problems.attempt(partial(refuse_unmeshable, image, name))
        if in_place:
            problems.attempt(partial(refuse_lost, before, image, name))
        if any(tissue.role in OBSERVED for tissue in before.tissues):
            findings = problems.attempt(partial(check_pair, before, image, name=name))
            problems.warn(findings or (), number)
    problems.warn(every_finding(before, after, loaded=bool(case.loads)), number)
    return replace(states, before=before, after=after)


def _without(image: Segmentation, absent: Collection[int]) -> Segmentation:
    """The image with absent tissues marked as void, which the checks leave out."""
    tissues = tuple(replace(t, role=Role.VOID) if i in absent else t for i, t in enumerate(image.tissues))
    return replace(image, tissues=tissues)


def memory_problems(cost: ExpectedCost) -> list[Problem]:
    """A problem when this machine's memory may not do, refused where it will not; else when too little is free now."""
    has, free = machine_memory_gb(), free_memory_gb()
    lack = lack_of_memory(cost)
    if lack:
        return [Problem("memory", f"{lack}; {LESS_MEMORY}", ResourceError.exit_code)]
    if has is not None and cost.memory_gb > has / MEMORY_FACTOR:
        text = (
            f"about {cost.memory_gb:.1f} GB of memory will be needed and this machine has {has:.1f} GB; {LESS_MEMORY}"
        )
        return [Problem("memory", text)]
    if free is not None and cost.memory_gb > free / MEMORY_FACTOR:
        text = (
            f"about {cost.memory_gb:.1f} GB of memory will be needed and at the moment {free:.1f} GB are free: end"
            " other programs, or wait for them"
        )
        return [Problem("memory-now", text)]
    return []
