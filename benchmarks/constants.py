"""Whether an answer hangs on the constants of the inversion, on the machine, or on where it begins.

    python benchmarks/constants.py [--rows clean,finite-clean] [--only NAME,...] [--seed S] [--edge MM] [--json]

Simulated data: rows of accuracy.py. An estimate is made with each number that stands in capitals in `palpate.inversion`
half and twice as large (shares of a whole at most the mean of themselves and 1); the table says how far the log-moduli
move, in their posterior standard deviations. So it does for an estimate on one processor, for one with so little memory
that no factor fits, and for two that begin at moduli e times as large and as small. The exit code is 1 where a constant
moves one by more than 0.1, or one of these by more than 0.01.
"""

from __future__ import annotations

import argparse
import json
import os
import pkgutil
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from importlib import import_module
from types import ModuleType
from unittest.mock import patch

import numpy as np
from accuracy_rows import ROWS, Posed, posed

import palpate.inversion
from palpate.errors import PalpateError
from palpate.inversion import invert, posterior_sd

MOST, MOST_BY_CONDITION = 0.1, 0.01  # posterior standard deviations
LITTLE = 5e7  # bytes of memory
SHARES = ("BAD", "FITTED")


def main() -> int:
    """Estimate with each constant changed and print by how much the answer moves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default="clean")
    parser.add_argument("--only", help="constants instead of all")
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--edge", type=float, help="edge length (mm) instead of the row's own")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    arguments = parser.parse_args()
    found, numbers = [], constants()
    conditions = dict(CONDITIONS)
    if arguments.only:
        asked = arguments.only.split(",")
        numbers = {name: of for name, of in numbers.items() if name in asked}
        conditions = {name: of for name, of in conditions.items() if name in asked}
    for name in arguments.rows.split(","):
        row = ROWS[name] if arguments.edge is None else replace(ROWS[name], edge_mm=arguments.edge)
        case = posed(row, arguments.seed, 0, {})
        theta, sd = _answer(case)
        for key, condition in conditions.items():
            with condition(case) as there:
                moved = (np.abs(_answer(there)[0] - theta) / sd).tolist()
            found.append({"row": name, "condition": key, "moved_sd": moved})
            print(_said(found[-1]), file=sys.stderr, flush=True)
        for key, (value, modules) in numbers.items():
            for other in _changed(key, value):
                line = {"row": name, "constant": key, "value": value, "changed": other}
                try:
                    with _with(key, other, modules):
                        line["moved_sd"] = (np.abs(_answer(case)[0] - theta) / sd).tolist()
                except PalpateError as error:
                    line["failed"] = str(error)
                found.append(line)
                print(_said(line), file=sys.stderr, flush=True)
    print(json.dumps({"constants": found}, indent=1) if arguments.json else "\n".join([*HEAD, *map(_said, found)]))
    limits = [MOST_BY_CONDITION if "condition" in line else MOST for line in found]
    return (
        0 if all(max(line.get("moved_sd", [np.inf])) <= most for line, most in zip(found, limits, strict=True)) else 1
    )


def constants() -> dict[str, tuple[float, tuple[ModuleType, ...]]]:
    """Every number in capitals of `palpate.inversion`, by its name, and the modules that know it by it."""
    modules = [import_module(m.name) for m in pkgutil.iter_modules(palpate.inversion.__path__, "palpate.inversion.")]
    names = {n: v for m in modules for n, v in vars(m).items() if n.isupper() and isinstance(v, int | float)}
    return {n: (v, tuple(m for m in modules if vars(m).get(n) == v)) for n, v in sorted(names.items())}


def _changed(key: str, value: float) -> tuple[float, float]:
    half, double = 0.5 * value, min(2.0 * value, 0.5 * (1.0 + value)) if key in SHARES else 2.0 * value
    return (max(round(half), 1), round(double)) if isinstance(value, int) else (half, double)


@contextmanager
def _with(key: str, value: float, modules: tuple[ModuleType, ...]) -> Iterator[None]:
    before = [getattr(module, key) for module in modules]
    try:
        for module in modules:
            setattr(module, key, value)
        yield
    finally:
        for module, old in zip(modules, before, strict=True):
            setattr(module, key, old)


@contextmanager
def _one_processor(case: Posed) -> Iterator[Posed]:
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1" if before != "1" else str(os.cpu_count())
    try:
        yield case
    finally:
        del os.environ["OMP_NUM_THREADS"]
        os.environ |= {} if before is None else {"OMP_NUM_THREADS": before}


@contextmanager
def _little_memory(case: Posed) -> Iterator[Posed]:
    with patch("palpate.mechanics.solvers.registry.available_memory", lambda: LITTLE):
        yield case


@contextmanager
def _elsewhere(case: Posed, *, shift: float) -> Iterator[Posed]:
    starts = tuple(start + shift for start in case.settings.starts)
    yield replace(case, settings=replace(case.settings, starts=starts))


CONDITIONS: dict[str, Callable[[Posed], AbstractContextManager[Posed]]] = {
    "another number of processors": _one_processor,
    "little memory": _little_memory,
    "starts e times as stiff": partial(_elsewhere, shift=1.0),
    "starts e times as soft": partial(_elsewhere, shift=-1.0),
}


def _answer(case: Posed) -> tuple[np.ndarray, np.ndarray]:
    """Log-moduli (n,) of the estimate and their posterior standard deviations."""
    found = invert(case.problem, case.settings, progress=lambda _: None)
    n = found.objective.n_parameters
    return found.minimum.unknowns[:n], posterior_sd(found.minimum, n)


HEAD = ("| row | constant | is | becomes | log-moduli move, sd |", "|---|---|---|---|---|")


def _said(line: dict[str, object]) -> str:
    moved = line.get("moved_sd")
    told = ", ".join(f"{of:.3f}" for of in moved) if isinstance(moved, list) else line["failed"]
    if "condition" in line:
        return f"| `{line['row']}` | {line['condition']} | | | {told} |"
    return f"| `{line['row']}` | `{line['constant']}` | {line['value']:g} | {line['changed']:g} | {told} |"


if __name__ == "__main__":
    raise SystemExit(main())
