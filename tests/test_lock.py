"""What the Dockerfile installs is pinned, and is all that the package asks for."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PINS = [line for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines() if line]


def test_every_line_pins_one_version():
    assert [
        line for line in PINS if not re.fullmatch(r"[a-z\d][a-z\d._-]*==[\d.]+(?:\.post\d+)?(?: ; .+)?", line)
    ] == []


def test_every_dependency_is_pinned_and_so_is_what_builds_the_wheel():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    extras = re.search(r"^LOCKED := (.+)$", makefile, flags=re.MULTILINE)[1].split()
    asked = [*project["project"]["dependencies"], *project["build-system"]["requires"]]
    asked += [line for extra in extras for line in project["project"]["optional-dependencies"][extra]]
    names = {re.match(r"[\w.-]+", line).group().lower().replace("_", "-") for line in asked}
    assert names <= {line.partition("==")[0] for line in PINS}


def test_the_dockerfile_copies_what_the_build_reads():
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project, packages = document["project"], document["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    kept = set(re.findall(r"^!(\S+)$", (ROOT / ".dockerignore").read_text(encoding="utf-8"), flags=re.MULTILINE))
    read = {name.partition("/")[0] for name in (*project["license-files"], *packages)}
    assert {"pyproject.toml", "requirements.lock", project["readme"], *read} <= kept
