"""report.html: self-contained, safe against names, whole whatever goes wrong."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import math
import re
from html.parser import HTMLParser
from itertools import combinations
from pathlib import Path

import matplotlib.figure
import matplotlib.image
import numpy as np
import pytest
from markupsafe import escape

from bodies import with_first_pair
from palpate.case.case import Mechanics
from palpate.errors import InputDataError, NotConverged
from palpate.findings import Finding
from palpate.images.readers import write_scalar_image
from palpate.report import page as page_module
from palpate.report.case_report import redrawn_page, write_case_report, write_failure_report
from palpate.report.collect import MOST_LATER, collect
from palpate.report.page import render
from palpate.report.pairs import drawn_images
from palpate.report.rows import explanation_rows, number
from palpate.statement.image_pairs import ImagePairs, PairAlone
from palpate.statement.joint import ModulusRegion
from palpate.statement.variations import Variation

EVIL = '</script><img src=x onerror=alert(1)>$\\frac{"&'


class Tags(HTMLParser):
    """Tags and attributes of a page."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))


def tags(page):
    parser = Tags()
    parser.feed(page)
    return parser.found


def without_curves(result):
    """The same result without its starts, whose curves take a fifth of a page's time."""
    return dataclasses.replace(result, estimation=dataclasses.replace(result.estimation, starts=()))


def without_mesh(result):
    """The page without pictures of the mesh and curves of the starts, where neither is looked at."""
    return render(dataclasses.replace(collect(without_curves(result)), mesh=None))


def words_of(result):
    """The page without figures of images, of the mesh and of the starts, where none of them is looked at."""
    return render(dataclasses.replace(collect(without_curves(result)), later=(), mesh=None))


@pytest.fixture(scope="module")
def folder(case_result, tmp_path_factory):
    return write_case_report(case_result, tmp_path_factory.mktemp("report")).parent


@pytest.fixture(scope="module")
def page(folder):
    return (folder / "report.html").read_text(encoding="utf-8")


def test_every_estimate_stands_with_unit_interval_verdict_and_truth(page):
    for text in (
        "58.9",
        "kPa",
        "47.1 to 73.6 kPa",
        "identified",
        "60.0",
        "-1.8 %",
        "× surroundings",
        "a warning to be",
    ):
        assert text in page


def test_the_page_is_self_contained(page):
    assert "default-src 'none'" in page
    for tag, attributes in tags(page):
        assert tag not in ("link", "iframe", "object", "base")
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("src", "href", "xlink:href"):
            assert attributes.get(name, "#").startswith(("#", "data:image/png"))
    assert not re.findall(r"url\((?!#)", page[: page.index("<script")])


def test_the_policy_allows_the_pages_own_scripts_and_no_other(page):
    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    policy = next(a["content"] for _, a in tags(page) if a.get("http-equiv") == "Content-Security-Policy")
    digests = {base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts}
    assert len(scripts) == 10
    assert digests == set(re.findall(r"'sha256-([^']+)'", policy))
    assert "unsafe-inline" not in policy.split("script-src")[1].split(";")[0]


def test_identifiers_are_unique_and_every_reference_is_met(page):
    names = [attributes["id"] for _, attributes in tags(page) if "id" in attributes]
    assert len(names) == len(set(names))
    used = re.findall(r'(?:href="#|url\(#)([^")]+)', page[: page.index("<script")])
    assert set(used) <= set(names)


def test_three_slices_show_before_after_and_model(page):
    for layer in ("layer-before", "layer-after", "layer-model"):
        assert page.count(f'class="{layer}"') >= 3 * 2  # prostate and bladder at least, in each of three views
    for view in ("axial", "coronal", "sagittal"):
        assert f">{view}</figcaption>" in page


def test_every_pair_has_its_own_figures_from_its_own_images(two_pairs, tmp_path):
    page = write_case_report(without_curves(two_pairs), tmp_path).read_text()
    assert "Slices: one/before.nii.gz, first.nii.gz, model" in page
    assert "Slices: two/before.nii.gz, second.nii.gz, model" in page
    assert page.count("3D: distance to first.nii.gz") == page.count("3D: distance to second.nii.gz") == 1
    assert "the mesh of the first pair" in page
    facts = json.loads(re.search(r'id="facts">(.*?)</script>', page, flags=re.DOTALL).group(1))
    assert [later["reference"] for later in facts["later"]] == [0, 1]
    lows = [np.array(reference["slices"]["low"]) for reference in facts["references"]]
    np.testing.assert_allclose(lows[1] - lows[0], [0.0, 0.0, 50.0], atol=1e-9)
    assert "could not be" not in page[: page.index("<script")]


def test_of_many_later_images_the_first_of_each_pair_is_drawn():
    assert drawn_images([3, 1, 2], 4) == ((0, 0), (0, 1), (1, 0), (2, 0))
    assert drawn_images([2], 4) == ((0, 0), (0, 1))
    assert drawn_images([1, 1, 1, 1, 1], 4) == ((0, 0), (1, 0), (2, 0), (3, 0))


@pytest.fixture(scope="module")
def page_of_many(case_result):
    """The page of one more later image than are drawn."""
    later = MOST_LATER + 1
    names = tuple(Path(f"later_{number}.nii.gz") for number in range(later))
    estimation = case_result.estimation
    pair = case_result.pairs[0]
    result = dataclasses.replace(
        with_first_pair(case_result, later=later * pair.later),
        case=dataclasses.replace(case_result.case, images=dataclasses.replace(case_result.case.images, after=names)),
        estimation=dataclasses.replace(
            estimation, fits=later * estimation.fits, displacements=later * estimation.displacements
        ),
    )
    return without_mesh(result)


def test_every_later_image_has_its_own_figures(page_of_many):
    for k in range(MOST_LATER):
        assert f"Slices: before.nii.gz, later_{k}.nii.gz" in page_of_many
        assert f"3D: distance to later_{k}" in page_of_many
    names = [attributes["id"] for _, attributes in tags(page_of_many) if "id" in attributes]
    assert len(names) == len(set(names))


def test_what_is_not_drawn_is_told_of(page_of_many):
    assert f"{MOST_LATER} of {MOST_LATER + 1} later images are drawn" in page_of_many
    assert f"Slices: before.nii.gz, later_{MOST_LATER}.nii.gz" not in page_of_many


def with_name(result, name):
    """The same result, its first tissue called otherwise."""
    mesh = result.space.mesh
    tissues = (dataclasses.replace(mesh.tissues[0], name=name), *mesh.tissues[1:])
    space = dataclasses.replace(result.space, mesh=dataclasses.replace(mesh, tissues=tissues))
    first = dataclasses.replace(result.estimation.estimates[0], tissue=name, why=name)
    estimates = (first, *result.estimation.estimates[1:])
    case_tissues = (dataclasses.replace(result.case.tissues[0], name=name), *result.case.tissues[1:])
    return dataclasses.replace(
        with_first_pair(result, space=space),
        case=dataclasses.replace(result.case, id=name, tissues=case_tissues),
        estimation=dataclasses.replace(result.estimation, estimates=estimates, reason=name),
        note=name,
    )


def test_a_name_can_neither_inject_markup_nor_stop_the_drawing(case_result, tmp_path):
    page = write_case_report(with_name(case_result, EVIL), tmp_path).read_text(encoding="utf-8")
    found = tags(page)
    assert not [tag for tag, attributes in found if "onerror" in attributes or attributes.get("src") == "x"]
    assert len([tag for tag, _ in found if tag == "script"]) == 12  # the page's ten, and two of data
    assert "could not be" not in page[: page.index("<script")]
    assert "&lt;/script&gt;" in page
    facts = re.search(r'id="facts">(.*?)</script>', page, flags=re.DOTALL).group(1)
    assert json.loads(facts)["tissues"][0]["name"] == EVIL


def fail(*_, **__):
    raise RuntimeError("no <canvas>")


def test_figures_that_fail_leave_a_sentence_each_and_a_warning(page, case_result, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", fail)
    monkeypatch.setattr(matplotlib.image, "imsave", fail)
    broken = write_case_report(case_result, tmp_path).read_text()
    figures = len(re.findall("</figcaption><(?:svg|img)", page))  # the others are the page's scripts'
    assert figures > 15
    assert broken.count("could not be drawn (RuntimeError: no &lt;canvas&gt;)") == figures
    assert "58.9" in broken
    assert caplog.text.count("could not be drawn") == figures


def test_data_that_cannot_be_made_leave_sentences(case_result):
    """Of a displacement of another mesh neither distances, outlines nor strains can be made."""
    other = (np.zeros((3, 3)),)
    estimation = dataclasses.replace(case_result.estimation, displacements=other, starts=())
    data = collect(dataclasses.replace(case_result, estimation=estimation))
    assert {part.split()[0] for part in data.missing} == {"distances", "outlines", "mesh"}
    page = render(data)
    assert page.count("could not be made (IndexError: ") >= 2
    assert all(str(escape(sentence)) in page for sentence in data.missing.values())
    assert "58.9" in page


@pytest.mark.parametrize(("law", "words"), [("linear", "estimate again with"), ("neo-hookean", "is made for those")])
def test_the_strain_is_told_of_by_the_law_of_the_case(case_result, law, words):
    case = dataclasses.replace(case_result.case, mechanics=Mechanics(law=law))
    data = collect(without_curves(dataclasses.replace(case_result, case=case)))
    page = render(dataclasses.replace(data, later=()))
    assert words in page
    assert "10 % (linear law)" in page


def test_without_a_fit_there_is_no_strain_to_show(page, case_result):
    nothing = dataclasses.replace(case_result.estimation, displacements=(), starts=())
    still = render(collect(dataclasses.replace(case_result, estimation=nothing)))
    for strain in ("coloured by the largest strain", 'value="strain"'):
        assert strain in page
        assert strain not in still


def test_a_page_whose_payload_fails_is_still_a_page(case_result, monkeypatch):
    monkeypatch.setattr(page_module, "payload", fail)
    page = render(dataclasses.replace(collect(without_curves(case_result)), later=()))
    assert "<script" not in page
    assert "script-src 'none'" in page
    assert "data:image/png" in page


def test_the_page_is_made_again_from_its_data(folder, page, case_result):
    assert redrawn_page(folder, document=case_result.to_dict()) == page


def test_a_page_cannot_be_made_from_nothing(tmp_path):
    with pytest.raises(InputDataError, match="run the estimate"):
        redrawn_page(tmp_path, document={})


def test_every_figure_says_what_good_and_bad_look_like(page):
    for part in re.findall(r"<section.*?</section>", page, flags=re.DOTALL):
        if "<figure" in part:
            assert part.count(">Good:<") >= 1
            assert part.count(">Good:<") == part.count(">Bad:<")


def test_methods_and_provenance_are_there(page):
    for text in ("Yang S, Lin MC", "Mmg [", "seed of random numbers was 0", "ab" * 32, "total", "gauss-newton"):
        assert text in page


def test_warnings_of_one_code_are_folded(case_result):
    remarks = tuple(Finding("example", f"warning number {i}") for i in range(5))
    page = words_of(dataclasses.replace(case_result, remarks=remarks))
    assert "5 more like this" in page
    assert all(f"warning number {i}" in page for i in range(5))


def test_warnings_stand_under_what_they_cost(case_result):
    found = [Finding(code, f"said by {code}") for code in ("earlier-files", "cut-by-border", "thin", "mirrored")]
    estimation = dataclasses.replace(case_result.estimation, remarks=())
    result = dataclasses.replace(case_result, estimation=estimation, remarks=tuple(found))
    page = words_of(result)
    order = ["more than its interval", "said by mirrored", "said by thin"]
    order += ["narrower intervals", "said by cut-by-border", "as good as without", "said by earlier-files"]
    places = [page.index(words) for words in order]
    assert places == sorted(places)


def test_what_did_not_converge_shows_no_number(case_result):
    estimation = dataclasses.replace(case_result.estimation, status="not converged", reason="it stopped early")
    page = without_mesh(dataclasses.replace(case_result, estimation=estimation))
    table = page[page.index("How stiff") : page.index("Correlation of")]
    assert "it stopped early" in page
    assert not any(number in table for number in ("58.9", "31.2", "5.89", "3.12"))
    assert "not identified" in table
    assert "There is no result; these were noticed" in page
    assert page.count("is drawn where it stopped, and is no result") == 2


STEPS = "the iteration reached its largest number of steps"
ENDS = {  # status, reason, number of the minimum, the share of the steps that were made, misfit
    "the answer": ("converged", "ok", 0, 1.0, 0.02),
    "another answer": ("converged", "ok", 1, 1.0, 0.03),
    "a worse fit that was not followed": ("converged", "ok", None, 1.0, 0.3),
    "no end": ("not converged", STEPS, None, 1.0, 0.5),
    "no end near the answer": ("not converged", STEPS, 0, 0.5, 0.021),
    "no number at all": ("not converged", "the objective is not a finite number", None, 0.0, np.nan),
}
MIXES = [*((end,) for end in ENDS), *combinations(ENDS, 2), tuple(ENDS)]


def ended(start, end):
    status, reason, minimum, share, misfit = ENDS[end]
    history = start.history[: round(share * len(start.history))]
    changes = {"status": status, "reason": reason, "minimum": minimum, "history": history}
    return dataclasses.replace(start, objective_mm2=misfit, **changes)


@pytest.mark.parametrize("status", ["converged", "not converged"])
def test_a_report_is_written_however_starts_ended(case_result, status):
    """Of each kind of end alone, of each two of them, of all: a row a start, its number or a dash."""
    first, drawn = case_result.estimation.starts[0], dataclasses.replace(collect(case_result), later=(), mesh=None)
    for mix in MIXES:
        starts = tuple(ended(first, end) for end in mix)
        estimation = dataclasses.replace(case_result.estimation, starts=starts, status=status)
        document = dataclasses.replace(case_result, estimation=estimation).to_dict()
        page = section_of_starts(dataclasses.replace(drawn, document=document))
        minima = re.findall(r'data-k="minimum">([^<]*)<', page)
        assert minima == ["–" if ENDS[end][2] is None else str(ENDS[end][2] + 1) for end in mix]
        assert re.findall(r'data-k="status">([^<]*)<', page) == [ENDS[end][0] for end in mix]


def section_of_starts(data):
    page = render(data)
    assert "could not be drawn" not in page
    return page[page.index('id="starts"') :]


def test_an_estimate_that_failed_has_a_report_too(case_result, tmp_path):
    page = write_failure_report(case_result.case, NotConverged("stopped <here>"), tmp_path).read_text()
    assert "stopped &lt;here&gt;" in page
    assert "Yang S, Lin MC" not in page
    assert "There is no result: the search for the stiffness did not come to an end." in page


def test_a_grey_image_lies_under_the_contours(case_result, tmp_path):
    grid = case_result.before.grid
    write_scalar_image(tmp_path / "ct.nii.gz", np.random.default_rng(4).normal(40, 100, grid.shape), grid)
    images = dataclasses.replace(case_result.case.images, intensities_before=tmp_path / "ct.nii.gz")
    result = dataclasses.replace(case_result, case=dataclasses.replace(case_result.case, images=images))
    page = without_mesh(result)
    assert '"kind": "grey"' in page
    assert "could not be" not in page[: page.index("<script")]


def test_a_grey_image_that_cannot_be_read_does_not_stop_the_report(case_result, tmp_path):
    images = dataclasses.replace(case_result.case.images, intensities_before=tmp_path / "nowhere.nii.gz")
    result = dataclasses.replace(case_result, case=dataclasses.replace(case_result.case, images=images))
    page = without_mesh(result)
    assert '"kind": "labels"' in page
    assert "The labels stand in place of the grey image: " in page
    assert "could not be" not in page[: page.index("<script")]


def test_what_is_not_identified_shows_no_range_and_ratios_are_shown_as_such(case_result):
    first, second = case_result.estimation.estimates
    ratio = {"unit": "ratio", "value": None, "interval95": None}
    ratio |= {"profile": ((2.5, -2.1), (3.1, 0.0), (4.0, 2.2))}
    lost = dataclasses.replace(first, ratio_interval95=None, verdict="not identified", truth=None, **ratio)
    only = dataclasses.replace(second, verdict="ratio only", **ratio)
    corners = tuple((5.9 + np.cos(a), 3.1 + np.sin(a)) for a in np.linspace(0.0, 6.0, 16))
    region = ModulusRegion(("prostate", "bladder"), corners, corners, open=False)
    estimation = dataclasses.replace(case_result.estimation, estimates=(lost, only), regions=(region,))
    page = words_of(dataclasses.replace(case_result, estimation=estimation))
    assert "ratio only" in page
    assert "only ratios can be found" in page
    assert '<div class="banner bad"><p><b>The images do not fix the stiffness of prostate' in page
    card = page[page.index('<span class="name">prostate') : page.index('<span class="name">bladder')]
    assert "interval" not in card
    assert "Profile likelihood of bladder" in page
    assert "Profile likelihood of prostate" not in page
    assert "Joint 95 % region" not in page


def test_every_chart_says_what_it_shows_to_who_cannot_see_it(page):
    body = page[: page.index("<script")]
    charts = [attributes for tag, attributes in tags(body) if tag == "svg" and attributes.get("role") == "img"]
    named = [attributes["aria-label"] for attributes in charts]
    assert len(re.findall(r"<figure[^>]*><figcaption>[^<]*</figcaption><svg", body)) <= len(charts)
    assert all(len(name) > 10 for name in named)
    assert len(set(named)) == len(named)
    silent = [a for tag, a in tags(body) if tag == "svg" and a.get("role") != "img" and a.get("aria-hidden") != "true"]
    assert not silent


def test_every_control_has_a_name(page):
    body = page[: page.index("<script")]
    outside = re.sub(r"<label.*?</label>", "", body, flags=re.DOTALL)
    for tag, attributes in tags(outside):
        if tag in ("input", "select", "canvas"):
            assert attributes.get("aria-label"), attributes
    assert all(attributes.get("alt") for tag, attributes in tags(body) if tag == "img")


def test_an_image_has_one_name_wherever_it_is_told_of(case_result, tmp_path):
    images = dataclasses.replace(
        case_result.case.images, before=Path("one/scan.nii.gz"), after=(Path("two/scan.nii.gz"),)
    )
    result = dataclasses.replace(case_result, case=dataclasses.replace(case_result.case, images=images))
    page = write_case_report(without_curves(result), tmp_path).read_text()
    words = re.sub(r"<[^>]*>", " ", page[page.index("<main>") : page.index("<script")])
    named = set(re.findall(r"[\w/]*scan\.nii\.gz", words))
    assert named == {"one/scan.nii.gz", "two/scan.nii.gz"}
    assert {fit["after"] for fit in result.to_dict()["fit"]} == {"two/scan.nii.gz"}
    assert not re.search(r"\b(earlier|later) image\b|\b(before|after) fitting\b", words)


def test_the_banner_counts_the_warnings_and_leads_to_them(page, case_result):
    assert len(case_result.to_dict()["warnings"]) == 1
    assert '<a href="#warnings">1 warning</a>' in page
    assert 'id="warnings"' in page


def test_the_images_stand_in_a_table_with_voxels_and_volumes(page, case_result):
    table = page[page.index('id="images"') : page.index("</table>", page.index('id="images"'))]
    grid = case_result.before.grid
    assert " × ".join(map(str, grid.shape)) in table
    for image in (case_result.before, *case_result.after):
        assert f"{number(image.volume(0) / 1000.0)}" in table
    assert "palpate 0.1.0" in page[page.index('id="images"') : page.index('class="alignment"')]


def test_the_methods_can_be_copied_with_their_bibtex(page):
    copied = re.findall(r'data-copy="([^"]+)"', page)
    assert copied == ["methods-text", "bibtex"]
    names = {attributes.get("id") for _, attributes in tags(page)}
    assert set(copied) <= names
    assert "@software{palpate," in page


def test_the_profile_and_the_causes_of_the_variance_are_shown_where_they_are_known(case_result):
    first, second = case_result.estimation.estimates
    shares = {"noise": 0.5, "driver": 0.1, "grid": 0.2, "mesh": 0.1, "instrument": 0.05, "known modulus": 0.05}
    seen = dataclasses.replace(first, variance_shares=shares, profile=((40.0, -2.5), (58.9, 0.0), (75.0, 1.96)))
    estimation = dataclasses.replace(case_result.estimation, estimates=(seen, second))
    page = words_of(dataclasses.replace(case_result, estimation=estimation))
    assert page.count("Profile likelihood of") == 1
    assert "Profile likelihood of prostate: lowest at 58.9 kPa, 95 % interval 47.1 to 73.6." in page
    assert page.count("its variance:") == 1
    assert "the drivers&#39; motion 10 %" in page
    bar = page[page.index("its variance:") : page.index("All causes")]
    assert bar.count("swatch") == 4  # the three largest causes, and the others together
    assert "others 20 %" in bar
    assert "the mesh 10 %" in page
    assert "the range of the known modulus 5 %" in page
    assert "could not be drawn" not in page


def test_what_would_change_the_answer_is_drawn_and_a_ratio_leads_where_the_scale_is_a_range(case_result):
    first, second = case_result.estimation.estimates
    ranged = dataclasses.replace(first, verdict="ratio only", ratio=5.89, ratio_interval95=(4.9, 7.1))
    changes = (
        Variation(
            "known_modulus", "surroundings", "x 1.2", "exact", dict.fromkeys(("prostate", "bladder"), math.log(1.2))
        ),
        Variation("law", "", "linear", "linearised", None, reason="the estimate did not converge"),
    )
    estimation = dataclasses.replace(case_result.estimation, estimates=(ranged, second), variations=changes)
    page = words_of(dataclasses.replace(case_result, estimation=estimation))
    assert "Tornado of prostate: modulus of surroundings: x 1.2: no change" in page  # a ratio to it does not follow it
    assert page.count("What would change this answer") == 1
    leads, follows = page.index("5.89 <small>× surroundings"), page.index("58.9 kPa if surroundings has 10.0 kPa")
    assert leads < follows
    assert "over that range 47.1 to 73.6 kPa" in page
    assert "The interval covers none of these." in page
    in_kpa = dataclasses.replace(estimation, estimates=(first, second))
    page_in_kpa = words_of(dataclasses.replace(case_result, estimation=in_kpa))
    assert "Tornado of prostate: modulus of surroundings: x 1.2: +20 %" in page_in_kpa
    assert "could not be drawn" not in page_in_kpa
    assert "could not be drawn" not in page


def test_two_moduli_together_and_what_each_image_says_alone_are_shown_where_they_are_known(case_result):
    turn = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    places = np.column_stack([58.9 * np.exp(0.2 * np.cos(turn)), 31.2 * np.exp(0.1 * np.sin(turn))])
    edge = tuple((float(a), float(b)) for a, b in places)
    region = ModulusRegion(("prostate", "bladder"), edge, edge, open=True)
    alone = [
        PairAlone(
            {"prostate": value, "bladder": 31.0}, {"prostate": (40.0, 80.0), "bladder": (29.0, 33.0)}, out, {}, {}
        )
        for value, out in ((55.0, False), (20.0, True))
    ]
    mean = {"prostate": 56.0, "bladder": 31.0}
    spans = {"prostate": (50.0, 63.0), "bladder": (30.0, 32.0)}
    pairs = ImagePairs(tuple(alone), 0.021, {"prostate": 0.1, "bladder": 0.02}, mean, spans)
    estimation = dataclasses.replace(case_result.estimation, regions=(region,), image_pairs=pairs)
    images = dataclasses.replace(case_result.case.images, after=(Path("after.nii.gz"), Path("later.nii.gz")))
    case = dataclasses.replace(case_result.case, images=images)
    result = dataclasses.replace(case_result, case=case, estimation=estimation)
    page = words_of(result)
    low, high = 58.9 * np.exp(-0.2), 58.9 * np.exp(0.2)
    spans = f"prostate {low:.1f} to {high:.1f} and bladder 28.2 to 34.5"
    assert page.count(f"Joint 95 % region: {spans}, cut by the bounds of the search.") == 1
    assert page.count("prostate by each later image alone, kPa: 1 55.0, 2 20.0 (an outlier); all together 58.9.") == 1
    assert "would have a probability of 0.021" in page.lower()
    assert "prostate 10 %" in page
    assert "could not be drawn" not in page


def test_under_which_explanation_what_stands_in_a_table(page, case_result):
    _, table = page.split("Under which explanation what")
    _, *rows = [re.findall(r"<td[^>]*>(.*?)</td>", row) for row in table.split("</table>")[0].split("<tr>")[1:]]
    assert rows == [
        ["80 %", "patchy tissues, no layers round organs and frame moves", "all drawn alike", "58.0", "31.5"],
        [
            "20 %",
            "nearly homogeneous tissues, layers round organs and frame still",
            "bladder drawn otherwise",
            "64.0",
            "29.0",
        ],
    ]
    none = dataclasses.replace(case_result.estimation, explanations=())
    assert "Under which explanation what" not in words_of(dataclasses.replace(case_result, estimation=none))


def test_of_several_images_those_are_named_that_draw_surfaces_otherwise(case_result):
    document = case_result.to_dict()
    first, second = document["explanations"]
    first["images"] = [{"after": name, "shows": []} for name in ("day 2", "day 9")]
    second["images"] = [{"after": "day 2", "shows": []}, {"after": "day 9", "shows": ["bladder drawn otherwise"]}]
    assert [row.images for row in explanation_rows(document)] == [(), (("day 9", "bladder drawn otherwise"),)]


def test_a_result_of_one_image_says_nothing_of_repeats(page):
    assert "says by itself" not in page


def test_without_measurements_nothing_of_them_is_on_the_page(page):
    words = page[page.index("<body>") : page.index("<script>")]
    assert not re.search(r"Measured points|Forces|what is known of it|layer-seen", words)
    assert "PointSlices =" not in page
