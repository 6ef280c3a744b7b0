"""A synthetic result for the tests of reports, exports and the command line: quick, and known to the last number."""

from __future__ import annotations

import dataclasses
import gc
import importlib.util
import os
import signal
import sys
from collections.abc import Sequence
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from palpate.body.imaged import LaterImage
from palpate.case.case import Case, CaseTissue, Estimate, Images
from palpate.case.file import read_case
from palpate.errors import PalpateError
from palpate.findings import MOST_WORDS, SENTENCE_END, Finding, words_in
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import read
from palpate.images.segmentation import segment
from palpate.images.tissue import Role
from palpate.mesh.space import lagrange_space
from palpate.mesh.tet_mesh import OUTER, TetMesh
from palpate.mesh.tetrahedralise import boundary_of
from palpate.observation.contract import Fit
from palpate.progress import silent
from palpate.report import render
from palpate.statement.estimation import Estimation, Iteration, ModulusEstimate, Start, StatedExplanation, TissueFit
from palpate.statement.result import CaseResult, MeshSummary, PairResult, Provenance
from palpate.statement.samples import ModulusSamples
from palpate.study import run
from palpate.study.check import check_case
from palpate.uncertainty import Covariance

sys.path.insert(0, str(Path(__file__).parent))  # tests are no package; dicom_files.py lies here

EDGE = 4.0
CELLS = 10

# The command line leaves alone what its process was told to ignore (by nohup, or a shell's background), and so do its
# children: the tests of interrupts begin as from a terminal, however they were started.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

if "PYTEST_XDIST_WORKER" in os.environ:  # how `make test` lets its own processes hold memory, not those they start
    for variable in ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_", "GLIBC_TUNABLES"):
        os.environ.pop(variable, None)


class SolvingError(Exception):
    """An estimate has come to where it begins to solve."""


@pytest.fixture
def answer(monkeypatch):
    """Exit code and sentence of a check's refusal, (0, "") of a case that may be solved; an estimate ends alike."""

    def solve(*_args, **_options):
        raise SolvingError

    monkeypatch.setattr(run, "invert_case", solve)

    def of(path: Path, overrides: Sequence[str] = ()) -> tuple[int, str]:
        checked = check_case(path, overrides, progress=silent)
        found = (checked.exit_code, checked.problems[0].message if checked.exit_code else "")
        try:
            run.estimate(read_case(path, overrides))
        except PalpateError as error:
            ended = (error.exit_code, str(error))
        except SolvingError:
            ended = (0, "")
        assert ended == found
        return found

    return of


def tissue_at(points: np.ndarray) -> np.ndarray:
    """Index of the tissue at points (n, 3) mm: 0 prostate, 1 bladder (balls), 2 rectum (a tube), 3 the rest."""
    index = np.full(len(points), 3)
    index[np.linalg.norm(points - [20, 22, 13], axis=1) < 8] = 0
    index[np.linalg.norm(points - [20, 22, 29], axis=1) < 8] = 1
    index[np.linalg.norm(points[:, :2] - [20, 6], axis=1) < 4] = 2
    return index


def motion(points: np.ndarray) -> np.ndarray:
    """A smooth displacement (n, 3) mm, largest beside the rectum."""
    size = 3.0 * np.exp(-np.linalg.norm(points[:, :2] - [20, 6], axis=1) / 12.0)
    return np.stack([0 * size, size, 0.3 * size], axis=1)


def make_case(**changes) -> Case:
    tissues = (
        CaseTissue("prostate", (1,), Role.ESTIMATE),
        CaseTissue("bladder", (2,), Role.ESTIMATE),
        CaseTissue("rectum", (3,), Role.DRIVER),
        CaseTissue("surroundings", "remaining", Role.KNOWN, youngs_modulus_kpa=10.0),
    )
    images = Images(Path("before.nii.gz"), (Path("after.nii.gz"),))
    return dataclasses.replace(Case(id="sub-01", images=images, tissues=tissues), **changes)


def make_mesh(case: Case) -> TetMesh:
    steps = np.stack(np.meshgrid(*[np.arange(CELLS + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    first = (steps.max(axis=1) < CELLS).nonzero()[0]
    jump = np.array([(CELLS + 1) ** 2, CELLS + 1, 1])
    tets = []
    for order in permutations(range(3)):
        corners = np.stack([first, *(first + np.cumsum(jump[list(order)])[:, None])], axis=1)
        odd = np.linalg.det(np.eye(3)[list(order)]) < 0
        tets.append(corners[:, [1, 0, 2, 3]] if odd else corners)
    nodes, tets = EDGE * steps.astype(float), np.concatenate(tets)
    region = tissue_at(nodes[tets].mean(axis=1))
    tets, region = tets[region != 2], region[region != 2]
    boundary = boundary_of(tets)
    centre = nodes[boundary].mean(axis=1)
    outer = ((centre < 1e-6) | (centre > EDGE * CELLS - 1e-6)).any(axis=1)
    return TetMesh(nodes, tets, region, boundary, np.where(outer, OUTER, 2), case.resolve_tissues({}))


def make_segmentation(mesh: TetMesh, *, moved: bool):
    grid = VoxelGrid((26, 27, 28), np.array([[1.6, 0, 0, 0.3], [0, 1.6, 0, -0.4], [0, 0, 1.6, -1.0], [0, 0, 0, 1.0]]))
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), axis=-1).reshape(-1, 3)
    points = grid.world(index.astype(float))
    labels = np.array([1, 2, 3, 0])[tissue_at(points - motion(points) if moved else points)]
    return segment(LabelImage(labels.reshape(grid.shape), grid), mesh.tissues)


def make_estimate(tissue: str, value: float, truth: float | None = None) -> ModulusEstimate:
    return ModulusEstimate(
        tissue=tissue,
        unit="kPa",
        value=value,
        interval95=(0.8 * value, 1.25 * value),
        interval_kind="linearised",
        relative_to="surroundings",
        ratio=value / 10,
        ratio_interval95=(0.08 * value, 0.125 * value),
        verdict="identified",
        why="high / low is 1.56",
        truth=truth,
    )


def make_start(ratio: float) -> Start:
    history = tuple(
        Iteration(0.02 + 0.5 * 0.2**k, {"prostate": 60 * (ratio / 6) ** 0.3**k, "bladder": 30.0}, 0.1**k)
        for k in range(5)
    )
    begin = {"prostate": 10 * ratio, "bladder": 10 * ratio}
    return Start(begin, history[-1].moduli, history[-1].objective_mm2, "converged", "ok", 0, history)


def make_estimation(displacement: np.ndarray) -> Estimation:
    fit = TissueFit("prostate", Fit(0.6, 0.8, 1.6, 0.91), Fit(0.08, 0.11, 0.22, 0.984), 0.93)
    return Estimation(
        status="converged",
        reason="the predicted decrease of the objective fell below its tolerance",
        estimates=(make_estimate("prostate", 58.9, 60.0), make_estimate("bladder", 31.2)),
        covariance=Covariance(np.array([[0.01, -0.003], [-0.003, 0.06]]), *np.zeros((3, 2, 2)), np.eye(2)),
        starts=tuple(make_start(ratio) for ratio in (0.5, 2.0, 8.0)),
        fits=((fit, dataclasses.replace(fit, tissue="bladder")),),
        displacements=(displacement,),
        counts={"forward": 3, "adjoint": 0, "tangent": 2, "factorisations": 4, "evaluations": 9},
        remarks=(Finding("example", "a warning to be shown"),),
        observations={"surface distance": "the distance between surfaces"},
        explanations=(
            StatedExplanation(("patchy", "bonded", "frame moves"), ((),), 0.8, {"prostate": 58.0, "bladder": 31.5}),
            StatedExplanation(
                ("nearly homogeneous", "layers", "frame still"),
                (("bladder drawn otherwise",),),
                0.2,
                {"prostate": 64.0, "bladder": 29.0},
            ),
        ),
    )


@pytest.fixture(scope="session")
def case_result() -> CaseResult:
    """A converged estimate of two organs in a box of 40 mm, made without computing anything."""
    case = make_case()
    mesh = make_mesh(case)
    space = lagrange_space(mesh, "P2")
    return CaseResult(
        case=case,
        estimation=make_estimation(motion(space.points)),
        pairs=(
            PairResult(
                space=space,
                mesh_summary=MeshSummary(
                    len(mesh.nodes), len(mesh.tets), 3 * len(space.points), 45.0, 45.0, {"prostate": 0.01}
                ),
                before=make_segmentation(mesh, moved=False),
                later=(LaterImage(1, make_segmentation(mesh, moved=True)),),
            ),
        ),
        provenance=Provenance({"total": 1.5}, {"before": "ab" * 32}, {"palpate": "0.1.0"}),
    )


@pytest.fixture(scope="session")
def sampled_result(case_result) -> CaseResult:
    """The same with draws of the moduli."""
    normal = np.random.default_rng(5).standard_normal((150, 2))
    moduli = np.array([58.9, 31.2]) * np.exp(np.array([0.1, 0.245]) * normal)
    samples = ModulusSamples(
        ("prostate", "bladder"),
        "kPa",
        moduli,
        np.array([[48.0, 71.0], [19.0, np.nan]]),
    )
    case = dataclasses.replace(case_result.case, estimate=Estimate(samples=150))
    estimation = dataclasses.replace(case_result.estimation, samples=samples)
    return dataclasses.replace(case_result, case=case, estimation=estimation)


TESTS = Path(__file__).parent

# Files, and folders of them, with the longest tests, or a process for every one. `make quick` leaves them out; every
# layer has others. They come first, the longest before all, so that no processor waits for another at the end.
SLOW = (TESTS / "slow.txt").read_text(encoding="utf-8").split()
# Tests of over seven seconds each: whole documents, repeated experiments. `make acceptance` runs them, not `make test`.
ACCEPTANCE = tuple(f"tests/{entry}" for entry in (TESTS / "acceptance.txt").read_text(encoding="utf-8").splitlines())


def pytest_collection_finish():
    """What all tests have imported and collected stays: the collector of cycles need not look at it again and again."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items):
    """Mark the slow tests and those of the acceptance, and put them in their order."""
    place = {(TESTS / name).resolve(strict=True): number for number, name in enumerate(SLOW)}

    def order(item) -> int:
        return min((place[path] for path in (item.path, *item.path.parents) if path in place), default=len(SLOW))

    items.sort(key=order)
    for item in items:
        if order(item) < len(SLOW):
            item.add_marker("slow")
        if item.nodeid.startswith(ACCEPTANCE):
            item.add_marker("acceptance")


@pytest.fixture(autouse=True, scope="module")
def images_read_here(request):
    """Images are read in this process, not in one of their own, where reading is not what is tested."""
    apart = {"images", "bad_input", "test_main_job.py", "test_memory.py", "test_identifiers.py"}
    with pytest.MonkeyPatch.context() as patch:
        own = request.path.relative_to(TESTS).parts if request.path.is_relative_to(TESTS) else ()
        if own and (own[0] not in apart or own[-1] == "test_check_first.py"):
            patch.setattr(read, "read_stored", lambda path, _kind, form, _limits, grid: form.stored(path, grid))
        yield


@pytest.fixture(autouse=True, scope="session")
def coarse_pictures():
    """One sample a pixel where rendering is not what is tested: a page is drawn in half of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render, "FINE", 1)
        yield


@pytest.fixture(autouse=True, scope="session")
def warnings_made():
    """Messages of all warnings that the program makes in this process, from any test."""
    made, plain = list[str](), Finding.__init__

    def kept(self, *args, **named):
        plain(self, *args, **named)
        made.append(self.message)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Finding, "__init__", kept)
        yield made


@pytest.fixture(autouse=True)
def every_warning_is_short(warnings_made):
    """At most 60 words and two sentences.

    Whatever a test makes the program warn of is measured, so that no warning escapes for want of a test of its own.
    """
    warnings_made.clear()
    yield
    for message in warnings_made:
        assert words_in(message) <= MOST_WORDS, f"{words_in(message)} words: {message}"
        assert len(SENTENCE_END.split(message)) <= 2, f"more than two sentences: {message}"


@pytest.fixture
def environment(monkeypatch):
    """Sets variables of the environment by their names; None takes one away."""

    def put(**variables: str | None) -> None:
        for name, value in variables.items():
            monkeypatch.delenv(name, raising=False) if value is None else monkeypatch.setenv(name, value)

    return put


@pytest.fixture
def first_place(tmp_path_factory):
    """A folder in which this process, and those that it starts, look for modules first."""
    folder = tmp_path_factory.mktemp("first-place")
    sys.path.insert(0, str(folder))
    yield folder
    sys.path.remove(str(folder))


@pytest.fixture
def registered():
    """Adds things to registries by their names, for one test."""
    added = []

    def add(registry, name, thing):
        registry[name] = thing
        added.append((registry, name))

    yield add
    for registry, name in added:
        del registry[name]


@pytest.fixture
def put_library(monkeypatch):
    """Puts a module in the place of a library by its name."""
    return lambda name, module: monkeypatch.setitem(sys.modules, name, module)


@pytest.fixture
def without(put_library):
    """Makes a library one that is not installed."""
    return lambda name: put_library(name, None)


@pytest.fixture(scope="session")
def twins():
    """The module `twins`, loaded by its path: tests are no package."""
    return loaded("inversion_twins", TESTS / "inversion" / "twins.py")


@pytest.fixture(scope="session")
def toys():
    """The module `toys`: objectives whose minimum is known by hand."""
    return loaded("inversion_toys", TESTS / "inversion" / "toys.py")


@pytest.fixture(scope="session")
def meshes():
    """The module `structured_meshes` of the mechanics' tests."""
    return loaded("structured_meshes", TESTS / "mechanics" / "structured_meshes.py")


@pytest.fixture
def rng():
    return np.random.default_rng(20240511)


@pytest.fixture(scope="session")
def point_motion():
    """The module `point_motion` of the observations' tests: a second kind of observation."""
    return loaded("point_motion", TESTS / "observation" / "point_motion.py")


def loaded(name, path):
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def twin(twins):
    """A linear-element twin at known moduli."""
    return twins.make_twin()


@pytest.fixture(scope="session")
def exact(twins, twin):
    """Its inverse problem with exact targets."""
    return twins.exact_problem(twin)


@pytest.fixture(scope="session")
def voxels(twins, twin):
    """Its inverse problem through voxels."""
    return twins.voxel_problem(twin)
