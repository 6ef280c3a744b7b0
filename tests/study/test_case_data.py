"""Markers and displacement fields beside the images: they narrow what surfaces leave open, and hold."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from case_texts import LINEAR, ORGAN, REST, case_text
from palpate.case.case import DriverMotion, MeshSettings
from palpate.case.data import CaseData
from palpate.case.file import read_case
from palpate.errors import ConfigurationError, InputDataError
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.readers import write_label_image
from palpate.images.readers.nifti import write_displacement_field
from palpate.mesh.locate import located, point_interpolation
from palpate.observation.contract import DataFile
from palpate.observation.registry import SOURCES, SourceKind
from palpate.report.collect import collect
from palpate.report.methods import methods_text
from palpate.study.check import check_case
from palpate.study.run import estimate
from palpate.study.simulate import simulate

TOY = Path(__file__).parents[1] / "observation" / "point_motion.py"
CASE = case_text(
    {
        "core": ORGAN | {"youngs_modulus_kpa": 20.0},
        "shell": REST | {"label": 2},
        "tube": {"label": 3, "role": "driver"},
    },
    after=None,
    images={"align": "none"},
    motion={"filling_mm": 4.0},
    mechanics=LINEAR,
    domain={"outer_boundary": "fixed"},
    mesh={"edge_length_mm": 7.0},
    discrepancy={"heterogeneity_sd": 0.0, "poisson_sd": 0.0, "layer_sd": 0.0},
    noise={"surface_sd_mm": 0.3},
    driver={"modes": 20},
    estimate={"start_ratios": [4.0]},
)
TRUTH = 20.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A core in a shell beside a tube that fills, with its simulated later image."""
    folder = tmp_path_factory.mktemp("core")
    grid = VoxelGrid((34, 34, 34), np.diag([1.6, 1.6, 1.6, 1.0]))
    x, y, z = 1.6 * np.moveaxis(np.indices(grid.shape).astype(float), 0, 0)
    labels = np.full(grid.shape, 2)
    labels[(x - 24.0) ** 2 + (y - 34.0) ** 2 + (z - 27.0) ** 2 < 10.0**2] = 1
    labels[((x - 27.0) ** 2 + (y - 14.0) ** 2 < 6.0**2) & (np.abs(z - 27.0) < 17.0)] = 3
    write_label_image(folder / "before.nii.gz", LabelImage(labels.astype(np.int32), grid, {}))
    (folder / "case.toml").write_text(CASE)
    made = simulate(read_case(folder / "case.toml"), progress=lambda _: None)
    write_label_image(folder / "after.nii.gz", made.after)
    rng = np.random.default_rng(1)
    points = rng.uniform(4.0, 50.0, (4000, 3))
    points = points[located(made.space.mesh, points).inside]
    moved = point_interpolation(made.space, located(made.space.mesh, points)) @ made.displacements[-1]
    few = slice(0, 60)
    table(folder / "markers.csv", points[few], moved[few] + 0.1 * rng.standard_normal((60, 3)))
    table(folder / "back.csv", points + moved, -moved)
    centres = grid.world(np.indices(grid.shape).reshape(3, -1).T.astype(float))
    places = located(made.space.mesh, centres)
    field = np.zeros((len(centres), 3))
    inside = replace(places, tet=places.tet[places.inside], barycentric=places.barycentric[places.inside])
    field[places.inside] = point_interpolation(made.space, inside) @ made.displacements[-1]
    field[places.inside] += 0.2 * rng.standard_normal(field[places.inside].shape)
    write_displacement_field(folder / "field.nii.gz", field.reshape(*grid.shape, 3), grid)
    return folder


def table(path: Path, points, moved):
    head = "before_x,before_y,before_z,after_x,after_y,after_z"
    np.savetxt(path, np.concatenate([points, points + moved], axis=1), delimiter=",", header=head, comments="")


@pytest.fixture(scope="module")
def case(folder):
    case = read_case(folder / "case.toml", ["images.after=['after.nii.gz']"])
    return replace(case, motion=None)


def test_what_is_seen_inside_narrows_what_surfaces_leave_open(case, folder):
    """Surfaces alone, with markers, with a field: the truth inside, and said which share each kind of data has.

    One test, so that each estimate is made once, however the tests are shared out.
    """
    markers = CaseData("landmarks", folder / "markers.csv", sd_mm=0.1)
    field = CaseData("displacement-field", folder / "field.nii.gz", sd_mm=0.2)
    results = [estimate(replace(case, data=data)) for data in ((), (markers,), (field,))]
    for result in results[1:]:
        low, high = result.estimation.estimates[0].interval95
        assert low < TRUTH < high
    surfaces, with_markers, with_field = (np.sqrt(r.estimation.covariance.total[0, 0]) for r in results)
    assert with_markers < 0.9 * surfaces
    assert with_field < 0.7 * surfaces
    document = results[2].to_dict()
    shares = document["information_shares"]["core"]
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares["displacement-field"] > 0.5
    changes = {(change["cause"], change["setting"]): change["changes"] for change in document["variations"]}
    assert changes["known_modulus", "x 1.2"]["core"] == pytest.approx(np.log(1.2))
    assert {cause for cause, _ in changes} >= {"poisson_ratio", "segmentation", "law"}
    far = document["fit"][0]["displacement-field"]["end"]["rms_mm"]  # of means, which err by less
    assert 0.02 * 3**0.5 < far < 0.2 * 3**0.5
    assert json.dumps(document, allow_nan=False)
    assert "data[0]" in results[2].provenance.inputs


def point_motion(*arguments, **options):
    """The toy observation of the contract's tests."""
    spec = importlib.util.spec_from_file_location("point_motion", TOY)
    module = sys.modules.setdefault(spec.name, importlib.util.module_from_spec(spec))
    spec.loader.exec_module(module)
    return module.point_motion(*arguments, **options)


@dataclass(frozen=True)
class Dot:
    """Another kind of data, which only tests know: one node of the mesh, seen to stand still, by a toy observation."""

    file: DataFile
    digests: tuple[str, ...] = ()
    in_words: str = "one dot"

    def brought(self, _motion):
        return self

    def against(self, _before, _after):
        pass

    def on(self, space, _reaction_of):
        point = int(np.argmin(np.linalg.norm(space.points, axis=1)))
        return point_motion(point, space.points[point], np.zeros(3), sd_mm=self.file.sd_mm), ()


def test_another_kind_is_one_file_and_one_line_and_two_files_of_one_keep_their_own_errors(case, folder, registered):
    """The first markers say nothing beside the second, which are a hundred times better; a held corner tells nothing.

    Which is said of it, and no layer asks what it is.
    """
    registered(SOURCES, "dot", SourceKind(Dot, needs=("sd_mm",), may_have=()))
    vague, sharp = (CaseData("landmarks", folder / "markers.csv", sd_mm=sd) for sd in (10.0, 0.1))
    coarse = replace(case, mesh=MeshSettings(9.0), driver=DriverMotion(modes=8))
    result = estimate(replace(coarse, data=(vague, sharp, CaseData("dot", sd_mm=0.1))))
    shares = result.estimation.information_shares["core"]
    assert shares["landmarks"] < 1e-2 * shares["landmarks 2"]
    assert shares["point motion"] < 1e-12
    assert result.estimation.fits[0][-1].tissue == "landmark"
    assert len(result.estimation.points) == 2  # the dot has nothing that could be drawn
    assert "displacement of points" in " ".join(methods_text(collect(result)).paragraphs)
    with pytest.raises(ConfigurationError, match="has no 'force_n'"):
        CaseData("dot", sd_mm=0.1, force_n=1.0)


@pytest.mark.usefixtures("case")
def test_check_says_what_was_read(folder):
    path = folder / "with_data.toml"
    text = CASE.replace('align = "none"', 'align = "none"\nafter = ["after.nii.gz"]')
    more = '\n[[data]]\nkind = "landmarks"\nfile = "markers.csv"\nsd_mm = 0.1\n'
    path.write_text(text.replace("[motion]\nfilling_mm = 4.0", "") + more)
    report = check_case(path, [], progress=lambda _: None)
    assert report.exit_code == 0
    assert "landmarks: 60 pairs of points" in report.text()


def test_a_field_that_leads_back_is_refused(case, folder):
    back = CaseData("displacement-field", folder / "back.csv", sd_mm=0.2)
    with pytest.raises(InputDataError, match="from the later state"):
        estimate(replace(case, data=(back,)))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("data=[{kind='landmarks', file='markers.csv', sd_mm=0.1, state=2}]", "has 1 later state"),
        ("data=[{kind='landmark', file='markers.csv', sd_mm=0.1}]", "did you mean"),
        (
            "data=[{kind='landmarks', file='m.csv', covariance_mm2=[[1,0,0],[0,1,0],[0,0,-1]]}]",
            "positive definite",
        ),
    ],
)
def test_data_that_make_no_sense_are_refused_by_their_key(folder, override, words):
    with pytest.raises(ConfigurationError, match=words):
        read_case(folder / "case.toml", ["images.after=['after.nii.gz']", override])
