"""Maps on the page: what is seen in colours, what is not hatched under the tissue's mean, and both in words."""

from __future__ import annotations

import dataclasses
import io
from functools import partial

import matplotlib.image as mpimg
import numpy as np
import pytest

from palpate.report.collect import collect
from palpate.report.cut_mesh import element_moduli
from palpate.report.figures.every import map_sheet
from palpate.report.figures.sheet import figure_files
from palpate.report.page import render
from palpate.report.report_data import ReportData
from palpate.report.scales import modulus_scale
from palpate.report.stiffness_maps import map_chart, map_png, tissue_maps
from palpate.report.svg import draw_svg
from palpate.uncertainty import DifferentRegion, StiffnessMap


@pytest.fixture(scope="module")
def mapped(case_result):
    """The estimate with a map of the prostate: stiff in front, seen on its right half alone."""
    mesh = case_result.space.mesh
    own = np.flatnonzero(mesh.region == mesh.tissue_index("prostate"))
    centres = mesh.nodes[mesh.tets[own]].mean(axis=1)
    away = centres - centres.mean(axis=0)
    stiff, seen = away[:, 1] > 0.0, away[:, 0] > 0.0
    sd = np.where(seen, 0.1, 0.6)
    region = DifferentRegion(own[stiff & seen], 1.2, centres[stiff].mean(axis=0), 2.5, (1.8, 3.4), 0.998)
    found = StiffnessMap("prostate", 0, own, 0.4 * stiff, sd, 1.0 - (sd / 0.7) ** 2, 0.7, 0.6, region)
    return dataclasses.replace(case_result, estimation=dataclasses.replace(case_result.estimation, maps=(found,)))


def test_where_data_tell_the_slices_show_the_map_and_elsewhere_the_tissues_mean(mapped):
    (found,), (of,) = mapped.estimation.maps, tissue_maps(mapped)
    assert of.mean == pytest.approx(58.9)
    resolved = found.resolution >= 0.5
    np.testing.assert_allclose(of.moduli[resolved], 58.9 * np.exp(found.log_ratio[resolved]), rtol=1e-6)
    np.testing.assert_allclose(of.moduli[~resolved], 58.9, rtol=1e-6)
    for cut in of.slices:
        inside = np.isfinite(cut.modulus)
        assert inside.any()
        assert not inside.all()
        blind = inside & (cut.resolution < 0.5)
        np.testing.assert_allclose(cut.modulus[blind], 58.9, rtol=1e-6)
        shown = cut.modulus[inside & ~blind]
        assert (np.isclose(shown, 58.9) | np.isclose(shown, 58.9 * np.exp(0.4))).all()


def test_the_page_has_the_map_with_its_sentence_and_can_be_kept(mapped, tmp_path):
    """Whatever else is drawn: here the mesh alone."""
    data = collect(dataclasses.replace(mapped, estimation=dataclasses.replace(mapped.estimation, starts=())))
    assert not data.missing
    data = dataclasses.replace(data, later=())
    data.save(tmp_path / "data.npz")
    page = render(ReportData.load(tmp_path / "data.npz"))
    assert "Map of stiffness: prostate" in page
    assert "its core is 2.5 times as stiff as the rest of the tissue" in page.replace("\n", " ")
    assert "could not be drawn" not in page
    svg = draw_svg(partial(map_chart, data=data, of=data.maps[0]))
    assert "<pattern" in svg  # the hatching
    assert svg.count("<image") >= 6
    picture = mpimg.imread(io.BytesIO(map_png(data, data.maps[0])))
    assert picture[..., 3].mean() > 0.05


def test_a_map_that_the_data_resolve_has_no_hatching(mapped):
    (found,) = mapped.estimation.maps
    clear = dataclasses.replace(found, resolution=np.full_like(found.resolution, 0.9))
    result = dataclasses.replace(mapped, estimation=dataclasses.replace(mapped.estimation, maps=(clear,)))
    data = collect(result)
    assert "<pattern" not in draw_svg(partial(map_chart, data=data, of=data.maps[0]))


def test_figures_show_the_map_in_the_unit_of_the_report(mapped):
    """On the slices each element has its own modulus; of what is known as a ratio alone all are ratios."""
    data = collect(mapped)
    moduli = element_moduli(data)[data.maps[0].elements]
    np.testing.assert_allclose(moduli, data.maps[0].moduli, rtol=1e-6)
    scale = modulus_scale(data)
    assert scale.low < moduli.min()
    assert moduli.max() < scale.high  # colours tell the ends of the map apart
    first, *others = data.document["estimates"]
    document = dict(data.document) | {"estimates": [first | {"verdict": "ratio only"}, *others]}
    lost = dataclasses.replace(data, document=document)
    np.testing.assert_allclose(element_moduli(lost)[data.maps[0].elements], 0.1 * moduli, rtol=1e-6)
    for each, label in ((data, "Young's modulus (kPa)"), (lost, "E / E of surroundings (ratio)")):
        files, caption = figure_files("map", partial(map_sheet, data=each, of=each.maps[0]), ("svg",), dpi=60)
        assert label in caption
        assert f">{label}</text>" in files["map.svg"].decode()
