"""Every problem of a case at once, before anything is solved: files, tissues, organs, mesh, expected cost."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from palpate.body.body import Body, cost_of_bodies, joint_problem, make_body
from palpate.body.contacts import every_finding
from palpate.body.cost import (
    LESS_MEMORY,
    MEMORY_FACTOR,
    ExpectedCost,
    expected_cost,
    free_memory_gb,
    lack_of_memory,
    machine_memory_gb,
)
from palpate.body.imaged import ImagedStates, LaterImage, brought
from palpate.body.loads import load_warnings
from palpate.body.provenance import file_digest
from palpate.body.read import measured, read_case_images, read_segmentation, read_states
from palpate.body.refusals import refuse_lost, refuse_unmeshable, require_samples
from palpate.case.case import Case
from palpate.case.file import read_case
from palpate.errors import InputDataError, PalpateError, ResourceError
from palpate.findings import HELP, Finding, help_on, of_pair, one_a_cause, rank, with_places
from palpate.images.checks import (
    OBSERVED,
    absent_tissues,
    check_pair,
    check_segmentation,
    later_names,
    refuse_absent,
    refuse_unit,
)
from palpate.images.grey_field import GreyField, grey_fields
from palpate.images.label_image import VoxelGrid
from palpate.images.label_table import read_label_table
from palpate.images.readers import read_intensities
from palpate.images.registration import Registration, length_text
from palpate.images.segmentation import Segmentation
from palpate.images.tissue import Role
from palpate.progress import Line, Progress
from palpate.statement.plausibility import unit_warnings
from palpate.study.prediction import Prediction

T = TypeVar("T")
IMAGE = re.compile(r"'(before|after(\[\d+\])?)'")
NUMBER = re.compile(r"[-+]?\d[\d.,]*")


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that an estimate would refuse (`exit_code` > 0) or warn of (0).

    place: the image in which a refusal was found ("'after[2]' of pair 2"), if it is about one image.
    """

    code: str
    message: str
    exit_code: int = 0
    place: str = ""

    @property
    def cause(self) -> tuple[str, str]:
        """What refusals with one cause have in common: the code, and the message without images and numbers."""
        return self.code, NUMBER.sub("", IMAGE.sub("", self.message)) if self.place else self.message


@dataclass(frozen=True, slots=True)
class OrganRow:
    """A tissue in the images: its volume in each of them, mL."""

    tissue: str
    role: str
    volumes_ml: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class CheckReport:
    """All problems of a case, its organs and the expected cost of its estimate (None when that is unknown).

    alignments: how each later image lay, by its name; none where nothing was aligned; measured: in words what was read
    from each file of [[data]], by its name; grey: what a field between the first two grey images would tell; predicted:
    the expected intervals, where they were asked for.
    """

    id: str
    problems: tuple[Problem, ...]
    images: tuple[str, ...] = ()
    organs: tuple[OrganRow, ...] = ()
    cost: ExpectedCost | None = None
    alignments: tuple[tuple[str, Registration], ...] = ()
    measured: Mapping[str, str] = field(default_factory=dict)
    grey: tuple[GreyField, ...] = ()
    predicted: Prediction | None = None

    def __str__(self) -> str:
        """What `palpate check` prints."""
        return self.text()

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
                | ({} if problem.exit_code else {"help": help_on(problem.code)})
                for problem in self.problems
            ],
            "alignment": [found.row(name) for name, found in self.alignments],
            "data": dict(self.measured),
            "grey": [asdict(of) for of in self.grey],
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
                "meshed": cost.between is None,
            },
            "predicted": self.predicted and self.predicted.to_dict(),
        }

    def text(self) -> str:
        """The same for people, worst first."""
        lines = [f"refused ({p.exit_code}): {p.message}" for p in self.problems if p.exit_code]
        warned = [f"warning ({p.code}): {p.message}" for p in self.problems if not p.exit_code]
        lines += [*warned, f"each code is explained on {HELP}"] if warned else []
        if not lines:
            lines = ["no problem was found"]
        for row in self.organs:
            volumes = ", ".join(f"{volume:.4g}" for volume in row.volumes_ml)
            lines.append(f"{row.tissue} ({row.role}): {volumes} mL")
        for name, found in self.alignments:
            kept = ", ".join(f"{tissue} {length_text(mm)}" for tissue, mm in found.residual_by_tissue_mm.items())
            lines.append(f"alignment: '{name}' {found.in_words} (surfaces then lie apart by, in mm: {kept})")
        lines += [f"{name}: {words}" for name, words in self.measured.items()]
        lines += [f"grey values of {of.tissue}: {of.in_words}" for of in self.grey]
        if self.cost is not None:
            lines.append(f"expected: {self.cost.in_words}")
        if self.predicted is not None:
            lines += self.predicted.lines()
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class Checked:
    """The report of a case, and what was made for it.

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

    def attempt(self, make: Callable[[], T], *, place: str = "") -> T | None:
        """What `make` returns; None, and a problem at that place, when it is refused."""
        try:
            return make()
        except PalpateError as error:
            self.add(Problem(type(error).__name__, str(error), error.exit_code, place))
        except MemoryError:
            text = "these images need more memory than is free; crop them to the organs"
            self.add(Problem("ResourceError", text, ResourceError.exit_code))
        return None

    @property
    def refused(self) -> bool:
        """Whether an estimate would refuse something."""
        return any(problem.exit_code for problem in self.found)

    def add(self, problem: Problem) -> None:
        """Keep a problem once; a refusal that was found before its image was looked at gets its place."""
        for number, known in enumerate(self.found):
            if known in (problem, replace(problem, place="")):
                self.found[number] = problem
                return
        self.found.append(problem)

    def warn(self, findings: Sequence[Finding], pair: int = 1) -> None:
        """Keep findings on the images of a pair."""
        self._findings += of_pair(findings, pair)

    def all(self) -> tuple[Problem, ...]:
        """All problems, once for each cause: refusals as they were found, then warnings, most harmful first."""
        warned = [p for p in self.found if not p.exit_code]
        warned += [Problem(each.code, each.message) for each in one_a_cause(self._findings)]
        causes: dict[tuple[str, str], list[Problem]] = {}
        for refusal in (p for p in self.found if p.exit_code):
            causes.setdefault(refusal.cause, []).append(refusal)
        refused = [
            replace(first, message=with_places(first.message, [*dict.fromkeys(other.place for other in others)]))
            for first, *others in causes.values()
        ]
        return (*refused, *sorted(warned, key=lambda problem: rank(problem.code)))


def check_case(source: Path | Case, overrides: Sequence[str], *, progress: Progress) -> CheckReport:
    """The report of `checked_case`."""
    return checked_case(source, overrides, progress=progress).report


def checked_case(
    source: Path | Case, overrides: Sequence[str] = (), *, progress: Progress, meshed: bool = True
) -> Checked:
    """All problems of a case, or of a case file (with overrides as in `read_case`), its organs and its expected cost.

    It does what an estimate does before it solves, and refuses with the same sentence. Where an estimate would stop it
    continues, to find the other problems. Without `meshed` it stops before the mesh. It raises nothing for a bad case.
    """
    problems = _Problems()
    if isinstance(source, Case):
        case = source
    elif (read := problems.attempt(partial(read_case, source, overrides))) is not None:
        case = read
    else:
        return Checked(CheckReport(source.stem, problems.all()))
    problems.warn((*unit_warnings(case), *load_warnings(case)))
    progress(Line("reading the images"))
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
        for name, one in zip(later_names(len(pair.later)), (later.alignment for later in pair.later), strict=True)
        if one is not None
    ]
    files = [(source.file, source.in_words) for pair in pairs for source in pair.data]
    measured_words = {f.name + (f", state {f.state}" if f.state > 1 else ""): words for f, words in files}
    grey = problems.attempt(partial(_grey_fields, case, pairs[0])) or ()
    report = CheckReport(case.id, problems.all(), names, organs, cost, tuple(found), measured_words, grey)
    return Checked(report, case, tuple(pairs), bodies)


def _remarks(problems: _Problems, case: Case, pairs: Sequence[ImagedStates]) -> None:
    """Keep the warnings of an estimate, the findings on contacts, and grey images that the report cannot show."""
    for number, pair in enumerate(pairs, start=1):
        problems.warn(pair.findings, number)
        if pair.mesh is None:
            problems.warn(every_finding(pair.before, pair.after, loaded=bool(case.loads)), number)
    for grey in _grey_images(case):
        try:
            read_intensities(grey)
        except PalpateError as error:
            text = f"The report will show labels instead of the grey image, which cannot be read. {error}"
            problems.add(Problem("report", text))


def _grey_fields(case: Case, states: ImagedStates) -> tuple[GreyField, ...]:
    """What a field between the grey images of the first two states would tell; nothing without the first one."""
    images = case.images
    if images is None or images.intensities_before is None:
        return ()
    try:
        before = (*read_intensities(images.intensities_before), states.before)
        if not images.intensities_after or states.later[0].image is None:
            return grey_fields(before)
        values, grid = read_intensities(images.intensities_after[0])
    except InputDataError:  # of which `_remarks` tells
        return ()
    if (found := states.later[0].alignment) is not None:
        grid = VoxelGrid(grid.shape, found.motion.inverse().matrix @ grid.affine)
    return grey_fields(before, (values, grid, states.later[0].image))


def _cost(
    problems: _Problems, pairs: Sequence[ImagedStates], case: Case, progress: Progress, *, meshed: bool
) -> tuple[ExpectedCost, tuple[Body, ...]]:
    """The expected cost on the meshes of the estimate, and the meshes; on guessed sizes where one is refused.

    meshed: whether the meshes are made.
    """
    first = pairs[0]
    cost = expected_cost(case, first.before, first.after, n_pairs=len(pairs), mesh=first.mesh)
    progress(Line(cost.sentence))
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


def _further_problems(problems: _Problems, case: Case, progress: Progress) -> tuple[ImagedStates, ...]:
    """All states that can be made of a case that an estimate refuses, with every check made on each of them."""
    problems.attempt(partial(require_samples, case))
    if case.phantom is not None or case.body is not None:  # nothing to read one by one
        states = problems.attempt(partial(read_states, case, progress=progress))
        problems.warn(() if states is None else states.findings)
        return () if states is None else (states,)
    found = list[ImagedStates]()
    for states in _read_pairs(case, problems):
        checked = _checked_pair(problems, states, case, len(found) + 1, progress)
        data = problems.attempt(partial(measured, case, checked))
        found.append(checked if data is None else replace(checked, data=data[0]))
    return tuple(found)


def _grey_images(case: Case) -> tuple[Path, ...]:
    images = case.images
    return () if images is None else tuple(g for g in (images.intensities_before, *images.intensities_after) if g)


def _read_pairs(case: Case, problems: _Problems) -> list[ImagedStates]:
    """Every pair whose reference state can be read, with those later states that can; each file is tried."""
    images = case.images
    if images is None:
        return []
    table = images.names
    names = problems.attempt(lambda: read_label_table(table)) if table else None
    for grey in _grey_images(case):
        problems.attempt(partial(file_digest, grey))
    pairs = list[ImagedStates]()
    for pair in case.image_pairs:
        before = problems.attempt(partial(read_segmentation, case, pair.before, names, None))
        tissues, later = before.tissues if before else None, list[LaterImage]()
        for number, path in zip(pair.numbers, pair.after, strict=True):
            image = problems.attempt(partial(read_segmentation, case, path, names, tissues))
            later += [] if image is None else [LaterImage(number, image)]
        if before is not None:
            pairs.append(ImagedStates(before, tuple(later)))
    return pairs


def _checked_pair(
    problems: _Problems, states: ImagedStates, case: Case, number: int, progress: Progress
) -> ImagedStates:
    """The images of one pair, aligned and with every check made on them.

    An organ that is absent is named, and left out of the other checks; the images are then not aligned.
    """
    before, after, there = states.before, states.after, None
    for name, image in zip(("before", *later_names(len(after))), (before, *after), strict=True):
        problems.attempt(partial(refuse_unit, image.grid, name))
    problems.attempt(partial(refuse_absent, before, after))
    absent = set(absent_tissues(before, after))
    if not absent:
        there = problems.attempt(partial(brought, before, after, method=case.align, progress=progress))
        problems.warn(there.findings if there else (), number)
    in_place = there is not None or not any(tissue.role is Role.RIGID for tissue in before.tissues)
    lay = tuple(of.alignment for of in there.later) if there else (None,) * len(after)
    before, after = _without(before, absent), tuple(_without(image, absent) for image in (there or states).after)
    problems.warn(check_segmentation(before, "before"), number)
    problems.attempt(partial(refuse_unmeshable, before, "before"))
    for name, image in zip(later_names(len(after)), after, strict=True):
        problems.warn(check_segmentation(image, name), number)
        place = f"'{name}'" + (f" of pair {number}" if number > 1 else "")
        problems.attempt(partial(refuse_unmeshable, image, name), place=place)
        if in_place:
            problems.attempt(partial(refuse_lost, before, image, name), place=place)
        if any(tissue.role in OBSERVED for tissue in before.tissues):
            findings = problems.attempt(partial(check_pair, before, image, name=name), place=place)
            problems.warn(findings or (), number)
    problems.warn(every_finding(before, after, loaded=bool(case.loads)), number)
    every = zip(states.later, after, lay, strict=True)
    later = tuple(replace(of, image=image, alignment=alignment) for of, image, alignment in every)
    return replace(states, before=before, later=later)


def _without(image: Segmentation, absent: Collection[int]) -> Segmentation:
    """The image with absent tissues marked as void, which the checks leave out."""
    tissues = tuple(replace(t, role=Role.VOID) if i in absent else t for i, t in enumerate(image.tissues))
    return replace(image, tissues=tissues)


def memory_problems(cost: ExpectedCost) -> list[Problem]:
    """A problem where this machine has too little memory (refused), may have too little, or has too little free now."""
    has, free = machine_memory_gb(), free_memory_gb()
    lack = lack_of_memory(cost)
    if lack:
        return [Problem("memory", f"{lack}; {LESS_MEMORY}", ResourceError.exit_code)]
    if has is not None and cost.memory_gb > has / MEMORY_FACTOR:
        text = (
            f"The estimate needs about {cost.memory_gb:.1f} GB of memory, and this machine has {has:.1f} GB. If memory"
            f" runs out, {LESS_MEMORY}."
        )
        return [Problem("memory", text)]
    if free is not None and cost.memory_gb > free / MEMORY_FACTOR:
        text = (
            f"The estimate needs about {cost.memory_gb:.1f} GB of memory, and {free:.1f} GB are free at the moment. End"
            " other programs, or wait for them."
        )
        return [Problem("memory-now", text)]
    return []
