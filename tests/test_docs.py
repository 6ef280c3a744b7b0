"""What the documentation says of the program is true: links, the schema with its defaults, the codes of warnings."""

from __future__ import annotations

import ast
import importlib.util
import re
import tomllib
from itertools import chain
from pathlib import Path
from pkgutil import resolve_name

import pytest
from markdown_it import MarkdownIt

import palpate
from palpate.case.case import CaseSurface, Domain, DriverMotion, Estimate, Mechanics, MeshSettings
from palpate.case.file import read_case
from palpate.findings import CODES, HARMLESS, MISLEADING, WIDENING
from palpate.mechanics.laws.registry import law_parameters

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
EXAMPLE, LOADS, BORNE, DATA, BODY, *_ = re.findall(
    r"```toml\n(.*?)```", (ROOT / "docs" / "case-file.md").read_text(), flags=re.DOTALL
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_to_a_file_leads_to_one(page):
    targets = re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text())
    missing = [target for target in targets if not target.endswith(".png") and not (page.parent / target).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_toml_block_is_toml(page):
    for block in re.findall(r"```toml\n(.*?)```", page.read_text(), flags=re.DOTALL):
        tomllib.loads(block)


def test_the_schema_in_the_docs_shows_the_defaults(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(EXAMPLE)
    case = read_case(path)
    of_laws = {name: parameter.default for name, parameter in law_parameters().items()}
    assert case.mechanics == Mechanics(law_parameters=of_laws)
    assert (case.domain, case.mesh) == (Domain(), MeshSettings())
    assert (case.driver, case.estimate, case.seed) == (DriverMotion(), Estimate(), 0)
    assert (case.tissues[0].poisson_ratio, case.tissues[1].density_kg_m3) == (0.45, 1000.0)


def test_the_loads_in_the_docs_can_be_read(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(f"{EXAMPLE}\n{LOADS}")
    assert [load.kind for load in read_case(path).loads] == ["pressure", "traction", "gravity"]
    path.write_text(f"{EXAMPLE}\n{BORNE}")
    assert [load.state for load in read_case(path).loads] == [0, 1]


def test_the_measurements_and_the_mesh_in_the_docs_can_be_read(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(f"{EXAMPLE}\n{DATA}")
    assert [data.kind for data in read_case(path).data] == ["landmarks", "force"]
    path.write_text(f'{BODY}\n[[data]]\nkind = "landmarks"\nfile = "markers.csv"\nsd_mm = 0.1\n')
    assert read_case(path).surfaces == (CaseSurface("grip", "z_max"),)


def test_the_reference_of_python_has_every_public_name():
    named = re.findall(r"^::: palpate\.(\w+)$", (ROOT / "docs" / "api.md").read_text(), flags=re.MULTILINE)
    assert sorted(set(named) - {"errors"}) == palpate.__all__


def test_every_page_is_in_the_contents_of_the_site():
    contents = re.findall(r"([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(), flags=re.MULTILINE)
    made = {"commands.md", "security.md", "contributing.md", "changelog.md"}
    assert sorted(set(contents) - made) == sorted(
        p.relative_to(ROOT / "docs").as_posix() for p in PAGES if p.parent != ROOT
    )


def test_the_page_of_warnings_tells_of_every_code_in_the_order_of_what_it_costs():
    page = (ROOT / "docs" / "warnings.md").read_text()
    sections = re.split(r"^## ", page, flags=re.MULTILINE)[1:]
    told = [tuple(re.findall(r"^### (.+)$", section, flags=re.MULTILINE)) for section in sections]
    assert told == [MISLEADING, WIDENING, HARMLESS]
    for entry in re.split(r"^### ", page, flags=re.MULTILINE)[1:]:
        assert all(part in entry for part in ("*Says*", "*Why*:", "*Do*:")), entry


def test_every_code_of_a_warning_stands_where_the_program_gives_it():
    """That none is given which is not registered is what the type of `Finding.code` holds, under mypy."""
    texts = [path.read_text() for path in (ROOT / "src").rglob("*.py") if path.name != "findings.py"]
    words = set[object]()
    for code in CODES:
        for text in texts:
            if code not in words and f'"{code}"' in text:  # outside of a comment, as parsing it tells
                words |= {node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Constant)}
    assert [code for code in CODES if code not in words] == []
    assert len(set(CODES)) == len(CODES)


def test_the_readme_answers_a_newcomer_in_the_order_of_the_questions():
    headings = re.findall(r"^## (.+)$", (ROOT / "README.md").read_text(), flags=re.MULTILINE)
    wanted = ["What qualifies", "Install", "Two commands", "Result", "Limits", "Accuracy and speed"]
    assert [heading for heading in headings if heading in wanted] == wanted


def test_every_path_that_newcomers_are_told_is_there():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    copied = re.findall(r"\b[Cc]opy\s+`([^`]+\.py)`", text)
    named = {*copied, *re.findall(r"`([\w./-]+/|[\w./-]*\w\.(?:py|md|toml|txt))`", text)}
    assert len(copied) > 3
    assert len(named) > 40
    places = (ROOT, ROOT / "src" / "palpate")
    assert [name for name in sorted(named) if not any((place / name).exists() for place in places)] == []


@pytest.mark.parametrize("entry", (ROOT / "tests" / "acceptance.txt").read_text(encoding="utf-8").splitlines())
def test_what_the_acceptance_lists_is_a_test(entry):
    path, _, name = entry.partition("::")
    assert f"def {name.partition('[')[0]}" in (ROOT / "tests" / path).read_text(encoding="utf-8")


TOOLS = {"import-linter": "lint-imports", "mkdocs-material": "material", "pytest-xdist": "-n 2", "scipy-stubs": "mypy"}
MODULES = {"h5py": "h5netcdf", "libigl": "igl", "pynrrd": "nrrd", "scikit-fem": "skfem", "torch-fem": "torchfem"}


def requirements() -> list[str]:
    """The name of every library that the package, its extras and its development ask for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    every = chain(project["dependencies"], *project["optional-dependencies"].values())
    return sorted({re.match(r"[\w-]+", requirement).group() for requirement in every})


def test_every_dependency_is_used():
    folders = ("src", "packages", "validation", "tests", "benchmarks", "docs", "examples")
    code = "\n".join(path.read_text() for folder in folders for path in (ROOT / folder).rglob("*.py"))
    orders = (ROOT / "Makefile").read_text() + (ROOT / "mkdocs.yml").read_text()
    imported = {name.lower() for name in re.findall(r"(?:import |from |import_module\(\"|installed\(\")(\w+)", code)}
    modules = {name: MODULES.get(name, name.replace("-", "_")).lower() for name in requirements()}
    others = [name for name, module in modules.items() if module not in imported]
    assert [name for name in others if TOOLS.get(name, name.split("-")[0]) not in orders] == []


def test_every_dependency_has_its_line():
    told = (ROOT / "docs" / "libraries.md").read_text().lower()
    assert [name for name in requirements() if not re.search(rf"\b{name.lower()}\b", told)] == []


def figures_text():
    """The module that writes figures into pages; benchmarks/ is no package."""
    spec = importlib.util.spec_from_file_location("figures_text", ROOT / "benchmarks" / "figures_text.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TEXT = figures_text()
FIGURES = TEXT.read_figures()
STATED = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in TEXT.pages()}
COMMIT = r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*\d)[0-9a-f]{7,8}\b"  # letters and digits


def test_every_figure_of_a_page_is_that_of_the_file_and_every_figure_of_the_file_stands_in_a_page():
    assert list(TEXT.complaints(STATED, FIGURES)) == []


@pytest.mark.parametrize(
    "spoilt",
    [
        lambda text: re.sub(r"(?<=<!--mismatch.linear.held-->)\d+", "142", text),
        lambda text: text.replace("| `still` | 6 |", "| `still` | 7 |", 1),
        lambda text: text.replace("<!--mismatch.linear.held-->", "", 1),
        lambda text: re.sub(r"<!--mismatch.linear.held-->(\d+)<!--/-->", r"\1", text),
        lambda text: text.replace("<!--mismatch.linear.held-->", "<!--mismatch.linear.hold-->", 1),
        lambda text: text.replace(" <!--mismatch.linear.held-->", "\n<!--mismatch.linear.held-->", 1),
    ],
    ids=["number", "table", "beginning", "comments", "name", "line"],
)
def test_a_figure_that_a_writer_changes_is_seen(spoilt):
    page = "docs/accuracy.md"
    changed = spoilt(STATED[page])
    assert changed != STATED[page]
    assert any(TEXT.complaints({**STATED, page: changed}, FIGURES))


@pytest.mark.parametrize("page", ["README.md", "docs/accuracy.md", "docs/speed.md", "docs/verification.md"])
def test_no_comment_of_a_figure_is_seen_and_its_tables_are_tables(page):
    html = MarkdownIt("commonmark").enable("table").render(STATED[page])
    shown = re.sub(r"<!--.*?-->", "", html)
    assert "<!--" not in shown
    assert "--&gt;" not in shown
    views = [name for name in re.findall(r"<!--([\w.-]+)-->\n", STATED[page]) if name in TEXT.VIEWS]
    assert html.count("<table>") >= len(views)


def test_the_commits_of_pages_with_figures_are_those_of_the_file():
    for page in ("README.md", "docs/accuracy.md"):
        assert re.findall(COMMIT, TEXT.MARK.sub("", STATED[page])) == []


def test_the_pictures_show_the_demo_that_the_figures_are_of():
    drawn = FIGURES["pictures"]
    assert drawn["commit"] == FIGURES["demo"]["commit"]
    for name, digest in drawn["values"].items():
        assert TEXT.digest(ROOT / "docs" / "pictures" / name) == digest, f"{name} is not the one that was drawn"


def test_every_object_of_the_reference_of_python_can_be_found():
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    for name in re.findall(r"^::: ([\w.]+)$", page, flags=re.MULTILINE):
        module, _, item = name.rpartition(".")
        assert hasattr(resolve_name(module), item), name


def test_the_gallery_has_six_small_pictures():
    named = re.findall(r"\]\((pictures/gallery-[^)]+)\)", (ROOT / "docs" / "gallery.md").read_text())
    assert len(named) == 6
    assert all((ROOT / "docs" / name).stat().st_size < 150_000 for name in named)
