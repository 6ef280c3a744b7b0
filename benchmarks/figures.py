"""Every figure that README and docs state of this program: `make figures`.

    python benchmarks/figures.py [PART ...] [--bodies N] [--processes N] [--browser CHROMIUM]
    python benchmarks/figures.py text      # no run: what the file says into the pages

Runs the parts (figures_parts.py: all but those that take hours, which must be named), one after the other, about two
hours on two quiet cores. Each part replaces its own entry in docs/figures.json: command, commit, machine, minutes,
values. Then every page is written anew where it states a figure (figures_text.py). Simulated data.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time

from figures_parts import PARTS, Place
from figures_text import FILE, ROOT, complaints, pages, read_figures, rewritten

from palpate.parallel import processors

TEXT = "text"
BUSY = 0.5  # processors that other programs use, beside which a time is not measured
CODE = ("src", "validation", "packages", "benchmarks", "examples", "pyproject.toml")  # on which figures depend


def main() -> int:
    """Run parts and write file and pages; exit code 1 where a page states a figure that the file has not."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; or {TEXT} alone")
    parser.add_argument("--processes", type=int, default=processors(), help="that share a campaign")
    parser.add_argument("--bodies", type=int, help="of accuracy, mismatch and coverage, instead of few")
    parser.add_argument("--browser", help="a Chromium, for the pictures")
    asked = parser.parse_args()
    if unknown := set(asked.parts) - {*PARTS, TEXT}:
        parser.error(f"no part is called {sorted(unknown)}; there are {[*PARTS, TEXT]}")
    names = [name for name in asked.parts if name != TEXT]
    if not asked.parts:
        names = [name for name, part in PARTS.items() if not part.asked]
    commit = commit_of_code()
    folder = ROOT / "build" / "figures" / commit  # a run that was interrupted goes on there
    folder.mkdir(parents=True, exist_ok=True)
    place = Place(folder, asked.processes, asked.browser, asked.bodies)
    for name in names:
        part = PARTS[name]
        say(f"{name}: {place.command(name)} (about {part.minutes:g} minutes on two quiet cores, at the usual size)")
        if (load := os.getloadavg()[0]) > BUSY:
            say(f"other programs keep {load:.1f} processors busy: times that are measured now are too long")
        began = time.perf_counter()
        values = part.values(place)
        figures = read_figures() if FILE.exists() else {}
        figures[name] = {
            "command": place.command(name),
            "commit": commit,
            "machine": machine(),
            "minutes": round((time.perf_counter() - began) / 60.0, 1),
            "values": values,
        }
        write(figures)
    return write_pages()


def write(figures: dict[str, dict[str, object]]) -> None:
    """The file, its parts in their order."""
    ordered = {name: figures[name] for name in PARTS if name in figures}
    FILE.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def write_pages() -> int:
    """Every page with the figures of the file; what stays wrong is said."""
    figures = read_figures()
    for page in pages():
        text = page.read_text(encoding="utf-8")
        try:
            new = rewritten(text, figures)
        except KeyError:
            continue  # is said below
        if new != text:
            page.write_text(new, encoding="utf-8")
            say(f"{page.relative_to(ROOT)} is written anew")
    texts = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in pages()}
    found = list(complaints(texts, figures))
    for complaint in found:
        say(complaint)
    return int(bool(found))


def commit_of_code() -> str:
    """The commit that runs, with a plus where its code was changed since."""

    def git(*words: str) -> str:
        """What git answers."""
        return subprocess.run(["git", *words], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()

    changed = git("status", "--porcelain", "--", *CODE)
    return git("rev-parse", "--short=8", "HEAD") + "+" * bool(changed)


def machine() -> str:
    """The machine in words."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return f"{os.cpu_count()} cores ({platform.machine()}, {memory:.0f} GB)"


def say(sentence: str) -> None:
    """Tell what happens."""
    print(sentence, file=sys.stderr, flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
