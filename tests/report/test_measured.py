"""Measured points in a report: where they lie, what is said of all, which of many are drawn, what is refused."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import math
import re
import zlib

import matplotlib.image as mpimg
import numpy as np
import pytest

from palpate.case.data import CaseData
from palpate.observation.contract import PointMotions
from palpate.report.collect import collect
from palpate.report.measured import evenly, measured_points, nice_factor
from palpate.report.page import render
from palpate.report.payload import payload
from palpate.report.render import Arrows, Camera, Triangles, render_png
from palpate.report.report_data import MOST_ARROWS, ReportData
from palpate.statement.estimation import ForceFit, PointFit

EVIL = '</script><img src=x onerror=alert(1)>$\\frac{"&'
rng = np.random.default_rng(3)


def fit_of(rest, observed, fitted, *, name="landmarks", state=0, labels=()):
    return PointFit(
        name, state, PointMotions(rest, observed, fitted, np.tile(np.eye(3), (len(rest), 1, 1)), labels), 1.0
    )


def some_points(n, *, off=0.0):
    """Points of the box of 40 mm that move along y, and a model that is `off` mm too far along x of the first one."""
    rest = rng.uniform(4.0, 36.0, (n, 3))
    observed = np.tile([0.0, 2.0, 0.0], (n, 1))
    fitted = observed.copy()
    fitted[0, 0] += off
    return rest, observed, fitted


def with_points(result, *fits, **changes):
    estimation = dataclasses.replace(result.estimation, points=fits, **changes)
    return dataclasses.replace(result, estimation=estimation)


@pytest.fixture(scope="module")
def measured(case_result):
    """The result with five markers, one of which has a name that must do no harm, and a field of many points."""
    markers = fit_of(*some_points(5, off=0.7), labels=(EVIL, *"bcde"))
    field = fit_of(*some_points(3000, off=0.2), name="displacement-field")
    forces = (ForceFit(EVIL, 0, 12.0, 12.4, 0.2), ForceFit("force 2", 0, 3.0, 3.0, 0.0))
    shares = {"prostate": {"prior": 0.1, "surface distance": 0.2, "landmarks": 0.7}}
    case = dataclasses.replace(
        case_result.case, data=(CaseData("force", surface="rectum", force_n=12.0, direction=(0.0, 0.0, 1.0), sd_n=0.2),)
    )
    result = with_points(case_result, markers, field, forces=forces, information_shares=shares)
    return dataclasses.replace(result, case=case)


def facts_of(data):
    packed = payload(data)
    return json.loads(packed.facts), zlib.decompress(base64.b64decode(packed.block))


def floats(entry, block):
    assert entry["type"] == "float32"
    return np.frombuffer(block, "<f4", math.prod(entry["shape"]), entry["offset"]).reshape(entry["shape"])


def test_an_arrow_lies_where_its_marker_lies(measured):
    """In RAS mm, from the estimate to what the page's script is given."""
    facts, block = facts_of(collect(measured))
    (state,) = facts["measured"]
    motions = measured.estimation.points[0].motions
    for name in ("rest", "observed", "fitted"):
        np.testing.assert_allclose(floats(state["points"][0][name], block), getattr(motions, name), rtol=1e-6)
    box = state["box"]
    assert (motions.rest >= box["low"]).all()
    assert (motions.rest <= box["high"]).all()


def test_arrows_of_an_exact_fit_coincide():
    points = measured_points(fit_of(*some_points(50)))
    np.testing.assert_array_equal(points.observed, points.fitted)
    assert points.left_rms_mm == points.largest_mm == 0.0


def test_the_longest_residual_is_named_with_its_place_and_drawn(measured):
    for fit, off in zip(measured.estimation.points, (0.7, 0.2), strict=True):
        points = measured_points(fit)
        assert points.largest_mm == pytest.approx(off)
        assert points.left_rms_mm == pytest.approx(off / np.sqrt(points.total))
        assert points.moved_rms_mm == pytest.approx(2.0)
        np.testing.assert_array_equal(points.largest_at, fit.motions.rest[0])
        assert np.linalg.norm(points.fitted - points.observed, axis=1).max() == pytest.approx(off, rel=1e-5)
        assert points.largest_label == (EVIL if fit.motions.labels else "")


@pytest.mark.parametrize("n", [401, 3000, 20_000])
def test_of_many_points_some_are_drawn_everywhere(n):
    points = rng.uniform(0.0, 50.0, (n, 3))
    kept = evenly(points, 400)
    assert 200 < len(kept) <= 400
    assert len(set(kept.tolist())) == len(kept)
    octants = np.unique((points[kept] > 25.0) @ [1, 2, 4], return_counts=True)[1]
    assert octants.min() > 0.7 * len(kept) / 8
    crowd = np.concatenate([points, rng.uniform(0.0, 5.0, (5 * n, 3))])  # where more were measured no more are drawn
    corner = (crowd[evenly(crowd, 400)] < 25.0).all(axis=1).mean()
    assert corner < 2.0 / 8.0


def test_few_points_are_drawn_all():
    assert evenly(np.zeros((7, 3)), 400).tolist() == list(range(7))
    same = np.concatenate([np.zeros((500, 3)), np.ones((1, 3))])
    assert len(evenly(same, 400)) == 2


def test_arrows_are_as_long_as_can_be_seen_by_a_factor_that_can_be_read():
    assert nice_factor(np.full(9, 1.0), 100.0) == 10.0
    assert nice_factor(np.full(9, 0.7), 100.0) == 10.0
    assert nice_factor(np.full(9, 40.0), 100.0) == 1.0
    assert nice_factor(np.full(9, 1e-9), 100.0) == 1000.0
    assert nice_factor(np.zeros(9), 100.0) == 1.0


def test_an_arrow_of_the_picture_begins_and_ends_where_it_should():
    camera = Camera(*np.eye(3))
    none = Triangles(*[np.zeros((0, 3, 3))] * 3)
    arrow = Arrows(np.array([[1.0, 2.0, 3.0]]), np.array([[40.0, 20.0, 5.0]]), "#ff0000", 1.0)
    content = render_png(none, camera, width=100, height=60, fill=0.8, arrows=[arrow])
    rows, columns = np.nonzero(mpimg.imread(io.BytesIO(content))[..., 3] > 0.5)
    np.testing.assert_allclose([columns.min(), columns.max()], [10, 89], atol=2)
    np.testing.assert_allclose([rows.min(), rows.max()], [10, 49], atol=2)
    assert rows[columns.argmin()] > rows[columns.argmax()]  # it rises to the right


def test_the_page_shows_them_and_says_how(measured):
    """Whatever else is drawn: here nothing but the slices of the later image."""
    estimation = dataclasses.replace(measured.estimation, starts=())
    data = collect(dataclasses.replace(measured, estimation=estimation))
    page = render(dataclasses.replace(data, mesh=None))
    words = page[: page.index("<script>")]
    for layer in ("layer-seen", "layer-fitted"):
        assert words.count(f'class="{layer}"') >= 3
    assert re.search(r"\d+ of the 3000 points of displacement-field are drawn: evenly spread", words)
    assert "times as long as the motion" in words
    assert "landmarks 70 %, surface distance 20 %, what was believed before 10 %" in re.sub(
        r"<[^>]+>|\s+(?=,)", "", re.sub(r'<span class="swatch"[^>]*></span>', "", words)
    )
    assert "+2.00" in words  # 12.4 N less 12.0 N over 0.2 N
    assert "could not be" not in words
    assert "<img src=x" not in page
    assert len(re.findall("<script>", page)) == 11


def test_points_come_back_from_their_file(measured, tmp_path):
    data = collect(measured)
    data.save(tmp_path / "a.npz")
    (state,) = ReportData.load(tmp_path / "a.npz").measured
    for one, other in zip(state.points, data.measured[0].points, strict=True):
        for name in ("rest", "observed", "fitted", "largest_at"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.name, one.total, one.largest_label) == (other.name, other.total, other.largest_label)
    assert data.measured[0].outlines
    with np.load(tmp_path / "a.npz") as arrays:
        stored = [arrays[name] for name in arrays]
    for outline in data.measured[0].outlines:  # which are those of the later image
        assert sum(np.array_equal(array, outline.points) for array in stored) == 1


@pytest.mark.parametrize(
    "change",
    [
        {"rest": np.full((5, 3), np.nan, np.float32)},
        {"fitted": np.zeros((4, 3), np.float32)},
        {"observed": np.zeros((5, 2), np.float32)},
        {"largest_at": np.zeros(2)},
        {"left_rms_mm": float("nan")},
        {"total": 4},
        {name: np.zeros((MOST_ARROWS + 1, 3), np.float32) for name in ("rest", "observed", "fitted")},
    ],
    ids=["nan", "fewer", "flat", "place", "no number", "more than all", "too many"],
)
def test_points_that_make_no_sense_are_refused(measured, change):
    points = measured_points(measured.estimation.points[0])
    with pytest.raises(ValueError, match=r"point|place"):
        dataclasses.replace(points, **change)


def test_a_motion_that_is_no_number_leaves_a_sentence(case_result):
    rest, observed, fitted = some_points(5)
    data = collect(with_points(case_result, fit_of(rest, observed, np.nan * fitted)))
    assert data.measured == ()
    assert "no number" in data.missing["points"]
