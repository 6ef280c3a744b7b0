"""The page in a real browser: it opens in silence, turns, slides, and stands without its scripts."""

from __future__ import annotations

import base64
import io
import shutil
from pathlib import Path

import matplotlib.image as mpimg
import numpy as np
import pytest

from palpate.report.case_report import write_case_report

playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install palpate[browser]")

SOFTWARE_GL = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
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


def test_layers_and_states_can_be_told_apart(opened):
    page = opened()
    figure = alive(page, "slices")
    canvas = figure.locator("canvas").nth(2)
    both = pixels(canvas)
    figure.locator(".modes label", has_text="after").click()
    after = pixels(canvas)
    figure.locator(".modes label", has_text="before").click()
    before = pixels(canvas)
    assert changed(after, before) > 0.005
    assert changed(both, before) > 0.005
    figure.locator(".t-model").uncheck()
    assert changed(before, pixels(canvas)) > 0.002


def test_the_slices_of_a_second_pair_lie_in_its_own_body(browser, two_pairs, tmp_path):
    complaints = []
    page = browser.new_page()
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(write_case_report(two_pairs, tmp_path).as_uri())
    found = page.locator("section.slices").nth(1)
    found.scroll_into_view_if_needed()
    page.wait_for_selector("section.slices[data-later='1'][data-state=live]")
    axial = [float(page.locator("section.slices input[type=range]").nth(3 * k).input_value()) for k in (0, 1)]
    assert axial[1] - axial[0] == pytest.approx(50.0, abs=1.0)
    first = page.locator("section.slices").first
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
    for section in ("slices", "organs", "mesh"):
        alive(page, section)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


def pictures_stand(page):
    for section, count in (("slices", 3), ("organs", 2), ("mesh", 3)):
        still = page.locator(f"section.{section} .still")
        assert still.locator("img:visible, figure > svg:visible").count() == count
        assert page.locator(f"section.{section} canvas:visible").count() == 0


def test_paper_gets_the_pictures(opened):
    page = opened()
    for section in ("slices", "organs", "mesh"):
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
