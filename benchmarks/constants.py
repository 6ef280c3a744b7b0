"""Whether an answer hangs on the constants of the inversion: each is halved and doubled, all else as it is.

    python benchmarks/constants.py [--rows clean,finite-clean] [--only NAME,...] [--seed S] [--edge MM] [--json]

Simulated data: rows of accuracy.py. An estimate is made with each number that stands in capitals in `palpate.inversion`
half and twice as large (shares of a whole at most the mean of themselves and 1); the table says how far the log-moduli
move, in their posterior standard deviations. The exit code is 1 where one moves by more than 0.1.
"""

from __future__ import annotations

import argparse
import json
import pkgutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from types import ModuleType

import numpy as np
from accuracy_rows import ROWS, Posed, posed

import palpate.inversion
from palpate.errors import PalpateError
from palpate.inversion import invert, posterior_sd

MOST = 0.1  # posterior standard deviations
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
    if arguments.only:
        numbers = {name: numbers[name] for name in arguments.only.split(",")}
    for name in arguments.rows.split(","):
        row = ROWS[name] if arguments.edge is None else replace(ROWS[name], edge_mm=arguments.edge)
        case = posed(row, arguments.seed, 0, {})
        theta, sd = _answer(case)
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
    return 0 if all(max(line.get("moved_sd", [np.inf])) <= MOST for line in found) else 1


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


def _answer(case: Posed) -> tuple[np.ndarray, np.ndarray]:
    """Log-moduli (n,) of the estimate and their posterior standard deviations."""
    found = invert(case.problem, case.settings, progress=lambda _: None)
    n = found.objective.n_parameters
    return found.minimum.unknowns[:n], posterior_sd(found.minimum, n)


HEAD = ("| row | constant | is | becomes | log-moduli move, sd |", "|---|---|---|---|---|")


def _said(line: dict[str, object]) -> str:
    moved = line.get("moved_sd")
    told = ", ".join(f"{of:.3f}" for of in moved) if isinstance(moved, list) else line["failed"]
    return f"| `{line['row']}` | `{line['constant']}` | {line['value']:g} | {line['changed']:g} | {told} |"


if __name__ == "__main__":
    raise SystemExit(main())
