"""The page in a real browser: it opens in silence, turns, slides, and stands without its scripts."""

from __future__ import annotations

import base64
import dataclasses
import io
import shutil
from pathlib import Path
from xml.etree import ElementTree as ET

import matplotlib.image as mpimg
import numpy as np
import pytest

from bodies import ELSEWHERE, STILL, body
from palpate.body.imaged import brought
from palpate.case.case import Case, CaseTissue, Images
from palpate.images.readers import write_scalar_image
from palpate.observation.contract import PointMotions
from palpate.report.case_report import write_case_report
from palpate.report.collect import collect
from palpate.report.preview import preview_page
from palpate.report.scales import modulus_scale
from palpate.statement.estimation import PointFit
from palpate.study.check import Checked, CheckReport

playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install palpate[browser]")

SOFTWARE_GL = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
IMAGES = Images(Path("before.nii.gz"), (Path("after.nii.gz"),))
NAMES = ("chromium", "chromium-browser", "google-chrome")


def launch(engine, *arguments):
    """A headless Chromium: playwright's own, else the system's; skips where there is none."""
    own = engine.chromium.executable_path
    path = own if Path(own).exists() else next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("no Chromium here; playwright install chromium")
    return engine.chromium.launch(executable_path=path, args=["--no-sandbox", *arguments])


@pytest.fixture(scope="module")
def engine():
    with playwright.sync_playwright() as engine:
        yield engine


@pytest.fixture(scope="module")
def browser(engine):
    browser = launch(engine, *SOFTWARE_GL)
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def address(case_result, tmp_path_factory):
    return write_case_report(case_result, tmp_path_factory.mktemp("browser")).as_uri()


@pytest.fixture
def opened(browser, address):
    """Opens the page in a context of the given settings; complains of anything on the console or off the machine."""
    contexts, complaints = [], []

    def open_page(**settings):
        context = browser.new_context(**({"viewport": {"width": 1100, "height": 900}} | settings))
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: None if request.url == address else complaints.append(request.url))
        page.goto(address)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not complaints


def alive(page, section):
    """The section, when its moving figure runs."""
    found = page.locator(f"section.{section}").first
    found.scroll_into_view_if_needed()
    page.wait_for_selector(f"section.{section}[data-state=live]")
    page.wait_for_timeout(300)
    return found


def pixels(locator):
    return mpimg.imread(io.BytesIO(locator.screenshot()))[..., :3]


def drawn(canvas):
    """The canvas's own pixels, wherever on the page it stands."""
    data = canvas.evaluate("canvas => canvas.toDataURL('image/png')")
    return mpimg.imread(io.BytesIO(base64.b64decode(data.split(",")[1])))[..., :3]


def changed(before, after):
    return float((np.abs(before - after).max(axis=2) > 0.05).mean())


def drag(page, canvas):
    box = canvas.bounding_box()
    x, y = box["x"] + box["width"] / 3, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 90, y + 40, steps=5)
    page.mouse.up()
    page.wait_for_timeout(300)


@pytest.mark.parametrize("section", ["organs", "mesh"])
def test_bodies_turn_under_a_drag_and_come_back(opened, section):
    page = opened()
    figure = alive(page, section)
    canvas = figure.locator("canvas")
    first = pixels(canvas)
    drag(page, canvas)
    turned = pixels(canvas)
    assert changed(first, turned) > 0.02
    figure.locator(".reset").click()
    page.mouse.move(5, 5)
    page.wait_for_timeout(300)
    assert changed(first, pixels(canvas)) < 0.005


def test_bodies_turn_under_the_arrow_keys(opened):
    page = opened()
    canvas = alive(page, "organs").locator("canvas")
    first = pixels(canvas)
    canvas.focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    page.wait_for_timeout(300)
    assert changed(first, pixels(canvas)) > 0.02


def test_the_cut_moves_and_the_mesh_changes_its_colours(opened):
    page = opened()
    figure = alive(page, "mesh")
    canvas = figure.locator("canvas")
    tissue = pixels(canvas)
    figure.locator("label", has_text="Young's modulus").click()
    page.wait_for_timeout(300)
    modulus = pixels(canvas)
    assert changed(tissue, modulus) > 0.02
    figure.locator(".segments label", has_text="strain").click()
    page.wait_for_timeout(300)
    strain = pixels(canvas)
    assert changed(modulus, strain) > 0.02
    assert figure.locator(".live [data-bar=strain]").is_visible()
    assert not figure.locator(".live [data-bar=modulus]").is_visible()
    figure.locator(".cut-position").fill("30")
    page.wait_for_timeout(300)
    assert changed(strain, pixels(canvas)) > 0.02
    assert figure.locator(".cut-value").inner_text() == "x = 30.0 mm"


def test_the_slider_moves_the_slice_and_a_click_the_others(opened):
    page = opened()
    figure = alive(page, "slices")
    axial, coronal = (figure.locator("canvas").nth(i) for i in (0, 1))
    sliders = figure.locator("input[type=range]")
    first, other = pixels(axial), pixels(coronal)
    sliders.nth(0).fill("29")
    assert changed(first, pixels(axial)) > 0.02
    axial.click(position={"x": 20, "y": 20})
    assert changed(other, pixels(coronal)) > 0.02


def test_the_wheel_goes_through_the_slices_and_at_their_end_scrolls_the_page(opened):
    page = opened()
    figure = alive(page, "slices")
    axial, slider = figure.locator("canvas").nth(0), figure.locator("input[type=range]").nth(0)
    axial.scroll_into_view_if_needed()
    page.wait_for_timeout(400)
    axial.hover()
    first, before, top = drawn(axial), float(slider.input_value()), page.evaluate("scrollY")
    page.mouse.wheel(0, 120)
    page.wait_for_timeout(300)
    assert float(slider.input_value()) == before - 3.0  # a millimetre for every 40 pixels
    assert page.evaluate("scrollY") == top
    assert changed(first, drawn(axial)) > 0.01
    assert slider.get_attribute("aria-valuetext") == f"z = {before - 3.0:.1f} mm"
    slider.fill(slider.get_attribute("min"))
    page.mouse.wheel(0, 120)
    page.wait_for_timeout(300)
    assert page.evaluate("scrollY") > top


def test_every_slider_says_what_it_stands_at(opened):
    page = opened()
    for section in ("alignment", "slices", "organs", "mesh"):
        alive(page, section)
    sliders = page.locator(".live input[type=range]:visible")
    words = [sliders.nth(i).get_attribute("aria-valuetext") for i in range(sliders.count())]
    assert len(words) >= 8
    assert all(words)


def test_slices_show_stiffness_or_displacement_with_its_own_bar(opened):
    page = opened()
    figure = alive(page, "slices")
    canvas, bars = figure.locator(".live canvas").nth(2), figure.locator(".live .colour-bar:visible .bar-label")
    assert bars.all_inner_texts() == ["Young's modulus (kPa)"]
    stiffness = drawn(canvas)
    figure.locator(".colours label", has_text="displacement").click()
    assert bars.all_inner_texts() == ["fitted motion (mm)"]
    motion = drawn(canvas)
    figure.locator(".colours label", has_text="contours only").click()
    assert not bars.all_inner_texts()
    bare = drawn(canvas)
    assert min(changed(stiffness, motion), changed(motion, bare), changed(stiffness, bare)) > 0.05
    figure.locator(".colours label", has_text="displacement").click()
    figure.locator(".states label", has_text="after.nii.gz").click()
    assert changed(motion, drawn(canvas)) > 0.005  # the model lies where the motion has brought it


def test_the_colours_of_a_slice_are_those_of_its_bar(opened, case_result):
    """Over the label image of an organ lies, by 0.6, the colour that the shared scale gives its modulus."""
    page = opened()
    figure = alive(page, "slices")
    for layer in ("before", "after", "model"):
        figure.locator(f".t-{layer}").set_checked(False)
    coloured = drawn(figure.locator(".live canvas").nth(2))
    figure.locator(".colours label", has_text="contours only").click()
    bare = drawn(figure.locator(".live canvas").nth(2))
    (colours,) = {
        tuple(np.rint(colour * 50)) for colour in (modulus_scale(collect(case_result)).colours(np.array([58.9])))
    }
    found = np.rint(50 * (coloured - 0.4 * bare) / 0.6).reshape(-1, 3)
    assert (np.abs(found - np.array(colours)).max(axis=1) <= 2).mean() > 0.03


@pytest.mark.parametrize(
    ("place", "ending"),
    [
        ("section.slices .live figure", ".png"),
        ("section.organs .stage", ".png"),
        ("#result .charts figure, #residuals .charts figure", ".svg"),
    ],
)
def test_a_figure_saves_itself_by_the_keyboard(opened, tmp_path, place, ending):
    page = opened()
    for section in ("slices", "organs"):
        alive(page, section)
    figure = page.locator(place).first
    button = figure.locator(".save")
    assert button.get_attribute("aria-label").startswith(f"Save {ending[1:].upper()}: ")
    button.focus()
    with page.expect_download() as download:
        page.keyboard.press("Enter")
    assert download.value.suggested_filename.endswith(ending)
    assert download.value.suggested_filename.startswith("sub-01-")
    path = tmp_path / f"figure{ending}"
    download.value.save_as(path)
    if ending == ".png":
        assert float(np.ptp(mpimg.imread(path)[..., :3])) > 0.5
    else:
        assert ET.parse(path).getroot().tag == "{http://www.w3.org/2000/svg}svg"


def test_every_figure_with_a_picture_has_one_button(opened):
    page = opened()
    counts = page.evaluate(
        "[...document.querySelectorAll('main figure, main .stage')].map((f) => [f.querySelectorAll('.save').length,"
        " Boolean(f.querySelector('svg, canvas, img'))])"
    )
    assert len(counts) > 12
    assert all(number == int(has) for number, has in counts)


def test_layers_and_states_can_be_told_apart(opened):
    page = opened()
    figure = alive(page, "slices")
    canvas = figure.locator("canvas").nth(2)
    both = drawn(canvas)
    figure.locator(".modes label", has_text="after.nii.gz").click()
    after = drawn(canvas)
    figure.locator(".modes label", has_text="before.nii.gz").click()
    before = drawn(canvas)
    assert changed(after, before) > 0.005
    assert changed(both, before) > 0.005
    figure.locator(".modes label", has_text="after.nii.gz").click()
    figure.locator(".t-model").uncheck()
    assert changed(after, drawn(canvas)) > 0.002


def test_arrows_of_measured_points_are_drawn_asked_for_and_found(browser, case_result, tmp_path):
    rest = np.random.default_rng(1).uniform(6.0, 34.0, (60, 3))
    observed = np.tile([0.0, 3.0, 0.0], (60, 1))
    fitted = observed.copy()
    fitted[7] += [1.0, 0.0, 0.5]
    fit = PointFit("landmarks", 0, PointMotions(rest, observed, fitted, np.tile(np.eye(3), (len(rest), 1, 1))), 1.0)
    estimation = dataclasses.replace(case_result.estimation, points=(fit,))
    complaints = []
    page = browser.new_page(viewport={"width": 390, "height": 900})
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(write_case_report(dataclasses.replace(case_result, estimation=estimation), tmp_path).as_uri())
    figure = page.locator("section.points")
    for part in ("in-slices", "in-space"):
        figure.locator(f".{part}").scroll_into_view_if_needed()
        page.wait_for_selector(f"section.points .{part}[data-state=live]")
    canvases = [figure.locator("canvas").nth(i) for i in (0, 1, 2, 3)]
    motion = [drawn(canvas) for canvas in canvases]
    figure.locator(".what").select_option("left")
    page.wait_for_timeout(300)
    for before, canvas in zip(motion, canvases, strict=True):
        assert changed(before, drawn(canvas)) > 0.002
    figure.locator("[data-place]").focus()
    page.keyboard.press("Enter")
    sliders = [float(figure.locator(".in-slices input[type=range]").nth(i).input_value()) for i in (2, 1, 0)]
    assert sliders == pytest.approx(rest[7].tolist(), abs=0.3)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.close()
    assert not complaints


def test_the_slices_of_a_second_pair_lie_in_its_own_body(browser, two_pairs, tmp_path):
    complaints = []
    page = browser.new_page()
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(write_case_report(two_pairs, tmp_path).as_uri())
    alive(page, "slices")
    found = page.locator("section.slices").nth(1)
    found.scroll_into_view_if_needed()
    page.wait_for_selector("section.slices[data-later='1'][data-state=live]")
    axial = [float(page.locator("section.slices input[type=range]").nth(3 * k).input_value()) for k in (0, 1)]
    assert axial[1] - axial[0] == pytest.approx(50.0, abs=1.0)
    first = page.locator("section.slices").first
    first.locator(".colours label", has_text="contours only").click()  # the mesh that is kept is that of the first pair
    coronal = [drawn(section.locator("canvas").nth(1)) for section in (first, found)]
    assert changed(*coronal) < 0.03  # the same body: nothing but the millimetres in the corner may differ
    assert changed(coronal[1], np.zeros_like(coronal[1])) > 0.2
    page.close()
    assert not complaints


def test_flicker_shows_both_states_in_turn(opened):
    page = opened()
    figure = alive(page, "slices")
    canvas = figure.locator("canvas").nth(2)
    figure.locator(".modes label", has_text="flicker").click()
    shots = []
    for _ in range(8):
        shots.append(pixels(canvas))
        page.wait_for_timeout(200)
    assert max(changed(shots[0], shot) for shot in shots) > 0.005


def test_one_image_fades_into_the_other_by_hand_and_by_itself(opened):
    page = opened()
    figure = alive(page, "alignment")
    canvas, fade, play = figure.locator("canvas").nth(2), figure.locator(".fade"), figure.locator(".play")
    earlier = pixels(canvas)
    fade.fill("100")
    later = pixels(canvas)
    assert changed(earlier, later) > 0.005
    play.click()
    page.wait_for_timeout(2200)
    assert 0 <= float(fade.input_value()) < 95
    assert play.inner_text() == "Stop"
    play.click()
    held = fade.input_value()
    page.wait_for_timeout(300)
    assert fade.input_value() == held


def test_bodies_go_from_one_state_to_the_other_with_arrows(opened):
    page = opened()
    figure = alive(page, "organs")
    canvas, share = figure.locator("canvas"), figure.locator(".motion")
    fitted = pixels(canvas)
    share.focus()
    page.keyboard.press("Home")
    page.wait_for_timeout(300)
    assert share.input_value() == "0"
    assert "0 % of the motion to after.nii.gz" in figure.inner_text()
    rest = pixels(canvas)
    halves = [part.reshape(rest.shape[0], 2, rest.shape[1] // 2, 3) for part in (rest, fitted)]
    assert changed(halves[0][:, 0], halves[0][:, 1]) < 0.05  # both pictures show the earlier state
    assert changed(halves[1][:, 0], halves[1][:, 1]) > 0.05
    figure.locator(".arrows").select_option("3")
    page.wait_for_timeout(300)
    assert changed(rest, pixels(canvas)) > 0.02


def test_the_later_image_can_be_told_from_the_model(opened):
    page = opened()
    figure = alive(page, "organs")
    canvas = figure.locator("canvas")
    plain = pixels(canvas)
    figure.locator("[data-show=image]").check()
    page.wait_for_timeout(300)
    lined = pixels(canvas)
    new = np.abs(lined - plain).max(axis=2) > 0.2
    assert new.mean() > 0.005
    green = lined[new]
    assert np.median(green[:, 1] - green[:, 0]) > 0.1  # of no colour that the distances have


def test_window_and_level_change_the_greys(browser, case_result, tmp_path):
    grid = case_result.before.grid
    write_scalar_image(tmp_path / "ct.nii.gz", np.random.default_rng(4).normal(40, 400, grid.shape), grid)
    images = dataclasses.replace(case_result.case.images, intensities_before=tmp_path / "ct.nii.gz")
    result = dataclasses.replace(case_result, case=dataclasses.replace(case_result.case, images=images))
    page = browser.new_page(viewport={"width": 1100, "height": 900})
    complaints = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(write_case_report(result, tmp_path).as_uri())
    figure = alive(page, "slices")
    canvas = figure.locator("canvas").first
    soft = drawn(canvas)
    figure.locator("[data-window='400 1800']").click()
    bone = drawn(canvas)
    assert bone.std() < 0.7 * soft.std()
    figure.locator("[data-window='40 400']").click()
    figure.locator(".window-width").fill("1")
    assert drawn(canvas).std() > soft.std()
    figure.locator(".modes label", has_text="after.nii.gz").click()
    assert drawn(canvas)[60:90, 20:60].max() == 0.0  # no grey image of that state, and none of another in its place
    page.close()
    assert not complaints


def test_the_methods_and_their_bibtex_can_be_copied(opened):
    page = opened(permissions=["clipboard-read", "clipboard-write"])
    for name, begin in (("methods-text", "Young's moduli of"), ("bibtex", "@software{palpate,")):
        page.locator(f"[data-copy={name}]").click()
        page.wait_for_timeout(200)
        assert page.evaluate("navigator.clipboard.readText()").startswith(begin)


@pytest.mark.parametrize(("scheme", "dark"), [("light", False), ("dark", True)])
def test_the_page_is_light_or_dark_as_the_reader_likes(opened, scheme, dark):
    page = opened(color_scheme=scheme)
    assert bool(pixels(page)[5, 5].mean() < 0.3) is dark
    theme = page.locator("#theme")
    theme.click()
    assert pixels(page)[5, 5].mean() > 0.7
    theme.click()
    assert pixels(page)[5, 5].mean() < 0.3


def test_a_telephone_shows_it_without_scrolling_sideways(opened):
    page = opened(viewport={"width": 390, "height": 844}, is_mobile=True, has_touch=True)
    for section in ("alignment", "slices", "organs", "mesh"):
        alive(page, section)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


def pictures_stand(page):
    planes = 3  # slices are drawn with lines, with the modulus and with the displacement
    for section, count in (("alignment", planes), ("slices", 3 * planes), ("organs", 2), ("mesh", 3)):
        still = page.locator(f"section.{section} .still")
        assert still.locator("img:visible, figure > svg:visible").count() == count
        assert page.locator(f"section.{section} canvas:visible").count() == 0


def test_paper_gets_the_pictures(opened):
    page = opened()
    for section in ("alignment", "slices", "organs", "mesh"):
        alive(page, section)
    page.emulate_media(media="print")
    pictures_stand(page)
    assert not page.locator("nav").is_visible()


def test_without_scripts_the_pictures_stand(opened):
    pictures_stand(opened(java_script_enabled=False))


def test_without_webgl_the_bodies_stand_as_pictures(engine, address):
    browser = launch(engine, "--disable-3d-apis")
    page = browser.new_page()
    complaints = []
    page.on("console", lambda message: complaints.append(message.text))
    page.goto(address)
    alive(page, "slices")
    page.locator("section.mesh").scroll_into_view_if_needed()
    page.wait_for_timeout(300)
    assert page.locator("section.mesh .still img:visible").count() == 3
    assert page.locator("section.organs canvas:visible").count() == 0
    browser.close()
    assert not complaints


@pytest.fixture(scope="module")
def preview(tmp_path_factory):
    """The preview of a body that lay elsewhere in its later image."""
    states = brought(body(STILL), (body(ELSEWHERE, filling=4.0, seed=1),), method="surfaces")
    tissues = tuple(
        CaseTissue(t.name, t.labels or "remaining", t.role, youngs_modulus_kpa=t.youngs_modulus_kpa)
        for t in states.before.tissues
    )
    checked = Checked(CheckReport("preview", ()), Case("preview", images=IMAGES, tissues=tissues), (states,))
    path = tmp_path_factory.mktemp("preview") / "preview.html"
    path.write_text(preview_page(checked, created="now", version="0"), encoding="utf-8")
    return path.as_uri()


@pytest.fixture
def previewed(browser, preview):
    """Its page, on a telephone or not, in silence."""
    pages, complaints = [], []

    def open_page(**settings):
        page = browser.new_page(**({"viewport": {"width": 1100, "height": 900}} | settings))
        pages.append(page)
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: None if request.url == preview else complaints.append(request.url))
        page.goto(preview)
        return page

    yield open_page
    for page in pages:
        page.close()
    assert not complaints


@pytest.mark.parametrize(
    ("section", "change"),
    [
        ("organs", lambda of: of.locator(".fade").fill("100")),
        ("organs", lambda of: of.locator("[data-show=names]").uncheck()),
        ("organs", lambda of: of.locator("[data-show=arrows]").uncheck()),
        ("organs", lambda of: of.locator("[data-show=before]").uncheck()),
        ("organs", lambda of: of.locator("[data-show=aligned]").uncheck()),
        ("organs", lambda of: of.locator("label", has_text="tissue").last.click()),
        ("whole", lambda of: of.locator(".fade").fill("100")),
        ("whole", lambda of: of.locator("[data-show=field]").uncheck()),
    ],
)
def test_every_control_of_a_preview_changes_the_picture(previewed, section, change):
    page = previewed()
    figure = page.locator(f"section.preview[data-box={section}]")
    figure.scroll_into_view_if_needed()
    page.wait_for_selector(f"section.preview[data-box={section}][data-state=live]")
    page.wait_for_timeout(300)
    canvas = figure.locator("canvas").nth(0)
    first = drawn(canvas)
    change(figure)
    page.wait_for_timeout(200)
    assert changed(first, drawn(canvas)) > 0.0005


def test_a_preview_fits_a_telephone(previewed):
    page = previewed(viewport={"width": 390, "height": 900})
    for section in ("organs", "whole"):
        page.locator(f"section.preview[data-box={section}]").scroll_into_view_if_needed()
        page.wait_for_selector(f"section.preview[data-box={section}][data-state=live]")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
