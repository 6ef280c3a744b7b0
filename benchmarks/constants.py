"""Whether an answer depends on the constants of the inversion, on the machine, or on the starts.

    python benchmarks/constants.py [--rows clean,finite-clean] [--only NAME,...] [--seed S] [--edge MM] [--defaults]
        [--json]

Simulated data: rows of accuracy.py. Each constant in capitals of `palpate.inversion` is halved and doubled (a share of
a whole becomes at most the mean of itself and 1). The table says how far the log-moduli move, in their posterior
standard deviations. It says the same for another number of processors, for the solver that is chosen where no factor
fits into memory, for starts at moduli e times as large and as small, and for one such start alone. The exit code is 1
where a constant moves a log-modulus by more than 0.1, or another change by more than 0.01.
"""

from __future__ import annotations

import argparse
import json
import os
import pkgutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np
from accuracy_rows import ROWS, Posed, posed

import palpate.inversion
from palpate.errors import PalpateError
from palpate.inversion import invert, posterior_sd

MOST, MOST_BY_CONDITION = 0.1, 0.01  # posterior standard deviations
SHARES = ("BAD", "FITTED")


Context = Callable[[Posed], AbstractContextManager[Posed]]


@dataclass(frozen=True)
class Change:
    """What is changed, in which `context` a case is estimated, and by how much that may move it (posterior sd)."""

    name: str
    words: str
    most: float
    context: Context


def main() -> int:
    """Estimate under each change and print by how much the answer moves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default="clean")
    parser.add_argument("--only", help="some of the changes instead of all")
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--edge", type=float, help="edge length (mm) instead of the row's own")
    parser.add_argument("--defaults", action="store_true", help="the program's defaults: nothing is held")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    found, every = [], [*CONDITIONS, *constants()]
    names = dict.fromkeys(change.name for change in every)
    asked = arguments.only.split(",") if arguments.only else list(names)
    if unknown := [name for name in asked if name not in names]:
        parser.error(f"--only {', '.join(unknown)}: it must name some of {', '.join(names)}")
    for name in arguments.rows.split(","):
        row = replace(ROWS[name], held=not arguments.defaults, edge_mm=arguments.edge or ROWS[name].edge_mm)
        case = posed(row, arguments.seed, 0, {})
        theta, sd = _answer(case)
        for change in every:
            if change.name not in asked:
                continue
            line = {"row": name, "changed": change.name, "to": change.words, "most_sd": change.most}
            try:
                with change.context(case) as there:
                    line["moved_sd"] = (np.abs(_answer(there)[0] - theta) / sd).tolist()
            except PalpateError as error:
                line["failed"] = str(error)
            found.append(line)
            print(_said(line), file=sys.stderr, flush=True)
    print(json.dumps({"changes": found}, indent=1) if arguments.json else "\n".join([*HEAD, *map(_said, found)]))
    return 0 if all(max(line.get("moved_sd", [np.inf])) <= line["most_sd"] for line in found) else 1


def constants() -> Iterator[Change]:
    """Every number in capitals of `palpate.inversion`, half and twice as large, in all modules that know its name."""
    modules = [import_module(m.name) for m in pkgutil.iter_modules(palpate.inversion.__path__, "palpate.inversion.")]
    names = {n: v for m in modules for n, v in vars(m).items() if n.isupper() and isinstance(v, int | float)}
    for name, value in sorted(names.items()):
        known = [module for module in modules if vars(module).get(name) == value]
        for other in _changed(name, value):
            yield Change(name, f"{value:g} -> {other:g}", MOST, partial(_with, known, name, other))


def _changed(name: str, value: float) -> tuple[float, float]:
    half, double = 0.5 * value, min(2.0 * value, 0.5 * (1.0 + value)) if name in SHARES else 2.0 * value
    return (max(round(half), 1), round(double)) if isinstance(value, int) else (half, double)


@contextmanager
def _with(modules: Sequence[ModuleType], name: str, value: object, case: Posed) -> Iterator[Posed]:
    """The case while a name of some modules means something else."""
    with ExitStack() as changed:
        for module in modules:
            changed.enter_context(patch.object(module, name, value))
        yield case


@contextmanager
def _processors(case: Posed) -> Iterator[Posed]:
    """The case on one processor; on all where the environment leaves one already."""
    other = str(os.cpu_count()) if os.environ.get("OMP_NUM_THREADS") == "1" else "1"
    with patch.dict(os.environ, OMP_NUM_THREADS=other):
        yield case


@contextmanager
def _memory(case: Posed) -> Iterator[Posed]:
    """The case with the solver that is chosen where no factor fits into the memory that is free."""
    models = [replace(state.model, solver="multigrid") for state in case.problem.states]
    states = tuple(replace(state, model=model) for state, model in zip(case.problem.states, models, strict=True))
    yield replace(case, problem=replace(case.problem, states=states))


@contextmanager
def _starts(shift: float, case: Posed) -> Iterator[Posed]:
    """The case with all log-moduli of the starts shifted."""
    starts = tuple(start + shift for start in case.settings.starts)
    yield replace(case, settings=replace(case.settings, starts=starts))


@contextmanager
def _begin(shift: float, case: Posed) -> Iterator[Posed]:
    """The case with one start alone, all log-moduli shifted from where it would begin."""
    start = case.settings.centre + shift
    yield replace(case, settings=replace(case.settings, starts=(start,), further=()))


CONDITIONS = (
    Change("processors", "others", MOST_BY_CONDITION, _processors),
    Change("memory", "too little for a factor", MOST_BY_CONDITION, _memory),
    Change("starts", "e times as stiff", MOST_BY_CONDITION, partial(_starts, 1.0)),
    Change("starts", "e times as soft", MOST_BY_CONDITION, partial(_starts, -1.0)),
    Change("begin", "one start, e times as stiff", MOST_BY_CONDITION, partial(_begin, 1.0)),
    Change("begin", "one start, e times as soft", MOST_BY_CONDITION, partial(_begin, -1.0)),
)


def _answer(case: Posed) -> tuple[np.ndarray, np.ndarray]:
    """Log-moduli (n,) of the estimate and their posterior standard deviations."""
    found = invert(case.problem, case.settings, progress=lambda _: None)
    n = found.objective.n_parameters
    return found.minimum.unknowns[:n], posterior_sd(found.minimum, n)


HEAD = ("| row | changed | to | log-moduli move, sd |", "|---|---|---|---|")


def _said(line: Mapping[str, Any]) -> str:
    moved = line.get("moved_sd")
    told = ", ".join(f"{of:.3f}" for of in moved) if moved else line["failed"]
    return f"| `{line['row']}` | `{line['changed']}` | {line['to']} | {told} |"


if __name__ == "__main__":
    raise SystemExit(main())
