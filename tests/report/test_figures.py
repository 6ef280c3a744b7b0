"""Figures for papers: text that stays text, fonts inside, sizes of journals, true captions, refusals with a way on."""

from __future__ import annotations

import dataclasses
import io
import re

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from palpate.errors import ConfigurationError, EstimationError, InputDataError
from palpate.report.collect import collect
from palpate.report.figures.every import CAPTIONS, write_figures
from palpate.report.figures.moduli import chosen_unit, moduli_sheet
from palpate.report.figures.sheet import COLUMN_MM, PAGE_MM, STYLE
from palpate.report.figures.slices import strip_of
from palpate.report.units import shown_unit

NAMES = (
    "moduli-kpa",
    "moduli-ratio",
    "stiffness-slices",
    "before-after-1",
    "residuals-1",
    "displacement-1",
    "motion-1",
)
DPI = 100


@pytest.fixture(scope="module")
def data(case_result):
    return collect(case_result)


@pytest.fixture(scope="module")
def written(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("figures")
    return folder, write_figures(data, folder, formats=("svg", "pdf", "png"), dpi=DPI)


def with_verdict(data, verdict):
    """The same data, whose first modulus has that verdict."""
    first, *others = data.document["estimates"]
    return dataclasses.replace(
        data, document=dict(data.document) | {"estimates": [first | {"verdict": verdict}, *others]}
    )


def test_every_figure_is_there_in_every_format(written):
    folder, figures = written
    assert [of.name for of in figures] == list(NAMES)
    assert not [of.missing for of in figures if of.missing]
    drawn = {path.name for path in folder.iterdir()}
    assert drawn == {CAPTIONS, *(file for of in figures for file in of.files)}
    assert {len(of.files) for of in figures if of.name != "motion-1"} == {3}


def test_text_is_text_and_fonts_are_inside(written):
    folder, _ = written
    svg = (folder / "moduli-kpa.svg").read_text(encoding="utf-8")
    assert re.search(r"<text[^>]*>Young's modulus \(kPa\), 95 % interval</text>", svg)
    assert "prostate</text>" in svg
    pdf = (folder / "stiffness-slices.pdf").read_bytes()
    assert b"/FontFile2" in pdf  # TrueType, embedded
    assert b"/Type3" not in pdf


@pytest.mark.parametrize(("name", "width_mm"), [("moduli-kpa", COLUMN_MM), ("stiffness-slices", PAGE_MM)])
def test_a_figure_has_the_width_of_one_or_two_columns(written, name, width_mm):
    folder, _ = written
    with Image.open(folder / f"{name}.png") as picture:
        assert picture.width == pytest.approx(DPI * width_mm / 25.4, abs=1.0)
    (points,) = re.findall(r'<svg [^>]*?width="([0-9.]+)pt"', (folder / f"{name}.svg").read_text(encoding="utf-8"))
    assert float(points) == pytest.approx(72.0 * width_mm / 25.4, abs=0.01)


def test_the_same_data_give_the_same_files(data, written, tmp_path):
    folder, _ = written
    write_figures(data, tmp_path, formats=("svg", "pdf"), unit="kPa", dpi=DPI)
    for name in ("moduli-kpa.svg", "moduli-kpa.pdf", "before-after-1.svg"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_each_figure_has_a_caption_with_unit_and_state(written):
    folder, figures = written
    text = (folder / CAPTIONS).read_text(encoding="utf-8")
    for of in figures:
        assert of.caption in text
        assert all(file in text for file in of.files)
    by_name = {of.name: of.caption for of in figures}
    assert "kPa" in by_name["moduli-kpa"]
    assert "ratio to that of surroundings" in by_name["moduli-ratio"]
    assert "from before.nii.gz to after.nii.gz, in mm" in by_name["displacement-1"]
    assert "true value of the simulation" in by_name["moduli-kpa"]
    assert "marks at the moduli" not in by_name["stiffness-slices"], "the bar has round numbers, as every axis has"


def test_the_animation_goes_there_and_back_and_moves(written):
    folder, _ = written
    with Image.open(folder / "motion-1.gif") as film:
        assert film.n_frames == 24
        pictures = []
        for number in (0, 12, 23):
            film.seek(number)
            pictures.append(np.asarray(film.convert("RGB")).astype(int))
    assert (np.abs(pictures[1] - pictures[0]).max(axis=2) > 60).mean() > 0.005
    assert np.abs(pictures[2] - pictures[0]).mean() < np.abs(pictures[1] - pictures[0]).mean()


def test_slices_share_one_scale(data):
    strip = strip_of(data)
    for plane, width, height in zip(strip.planes, strip.widths_mm, strip.heights_mm, strict=True):
        size = plane.high - plane.low
        assert width / size[plane.view.across] == pytest.approx(height / size[plane.view.up])
        assert width / size[plane.view.across] == pytest.approx(
            strip.widths_mm[0] / (strip.planes[0].high - strip.planes[0].low)[0]
        )


def test_what_is_known_as_a_ratio_alone_is_drawn_as_ratios(data, tmp_path):
    lost = with_verdict(data, "ratio only")
    with pytest.raises(ConfigurationError, match=r"'surroundings' alone.*ask for the unit 'ratio'"):
        write_figures(lost, tmp_path, formats=("svg",), unit="kPa", dpi=DPI)
    assert not list(tmp_path.iterdir())
    figures = write_figures(lost, tmp_path, formats=("svg",), dpi=DPI)
    assert not (tmp_path / "moduli-kpa.svg").exists()
    text = "".join(re.findall(r"<text.*?</text>", "".join(path.read_text() for path in tmp_path.glob("*.svg")), re.S))
    assert "E / E of surroundings (ratio)" in text
    assert "kPa" not in text
    assert "kPa" not in "".join(of.caption for of in figures)
    assert ">5.89 (4.71 to 7.36)</text>" in (tmp_path / "moduli-ratio.svg").read_text()


def test_intervals_are_where_the_numbers_are(data):
    with mpl.rc_context(STYLE):
        figure = Figure()
        moduli_sheet(figure, data.document, {}, shown_unit(data.document, "ratio"))
    (axes,) = figure.axes
    lines = [line for line in axes.lines if line.get_gid() == "interval"]
    assert [list(line.get_xdata()) for line in lines] == [
        pytest.approx([4.712, 7.3625]),
        pytest.approx([2.496, 3.9]),
    ]
    (truth,) = [line for line in axes.lines if line.get_gid() == "truth"]
    assert list(truth.get_xdata()) == [6.0, 6.0]


@pytest.mark.parametrize(("unit", "said"), [("MPa", "choose 'kPa' or 'ratio'"), ("$E$", "no unit")])
def test_a_unit_that_is_not_there_is_refused(data, unit, said):
    with pytest.raises(ConfigurationError, match=said):
        chosen_unit(data.document, unit)


def test_what_did_not_converge_is_not_drawn(data, tmp_path):
    failed = dataclasses.replace(
        data, document=dict(data.document) | {"status": "not converged", "reason": "it stopped"}
    )
    with pytest.raises(EstimationError, match="it stopped"):
        write_figures(failed, tmp_path, formats=("png",))


def test_slices_of_no_body_are_refused_before_they_take_memory(data, tmp_path):
    (reference,) = data.references
    box = dataclasses.replace(reference.slices, high=reference.slices.low + 1e7)
    strange = dataclasses.replace(data, references=(dataclasses.replace(reference, slices=box),))
    with pytest.raises(InputDataError, match="no body"):
        write_figures(strange, tmp_path, formats=("png",))


def test_data_of_an_older_version_leave_a_sentence(data, tmp_path):
    bare = dataclasses.replace(data.later[0], motion=np.zeros((0, 3), dtype=np.float32))
    figures = write_figures(dataclasses.replace(data, later=(bare,)), tmp_path, formats=("svg",), dpi=DPI)
    assert {of.name for of in figures if of.missing} == {"displacement-1", "motion-1"}
    assert (tmp_path / CAPTIONS).read_text().count("run the estimate again") == 2


def test_names_are_text_whatever_they_are(data, tmp_path):
    evil = "<script>$x^2$"
    tissues = (dataclasses.replace(data.tissues[0], name=evil), *data.tissues[1:])
    first, *others = data.document["estimates"]
    document = dict(data.document) | {"estimates": [first | {"tissue": evil}, *others]}
    write_figures(dataclasses.replace(data, tissues=tissues, document=document), tmp_path, formats=("svg",), dpi=DPI)
    text = "".join(path.read_text() for path in tmp_path.glob("*.svg"))
    assert "<script" not in text
    assert "&lt;script&gt;$x^2$" in text


def test_a_figure_in_pixels_can_be_read(written):
    folder, _ = written
    for path in folder.glob("*.png"):
        with Image.open(io.BytesIO(path.read_bytes())) as picture:
            picture.load()
            assert len(picture.convert("RGB").getcolors(1 << 24)) > 4
