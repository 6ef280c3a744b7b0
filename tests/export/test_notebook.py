"""The widget for notebooks shows the tissues and the modulus on the grid of the first image."""

from __future__ import annotations

import base64
import gzip
import io
import shutil
from pathlib import Path

import matplotlib.image as mpimg
import nibabel
import numpy as np
import pytest

from palpate.errors import ResourceError
from palpate.export.notebook import notebook_viewer


def test_the_widget_holds_tissues_and_moduli_on_the_image(case_result):
    pytest.importorskip("ipyniivue")
    under, over = notebook_viewer(case_result).volumes
    for volume, expected in ((under, case_result.before.index), (over, None)):
        image = nibabel.Nifti1Image.from_bytes(gzip.decompress(volume.data))
        np.testing.assert_allclose(image.affine, case_result.before.grid.affine, atol=1e-5)
        values = np.asarray(image.dataobj)
        if expected is not None:
            np.testing.assert_array_equal(values, expected)
        else:
            np.testing.assert_allclose(np.unique(values), [0.0, 10.0, 31.2, 58.9], rtol=1e-6)
    assert under.colormap_label.labels == [tissue.name for tissue in case_result.tissues]
    assert (over.cal_min, over.cal_max) == (pytest.approx(5.0), pytest.approx(58.9))


def test_without_its_library_a_sentence_says_what_to_install(case_result, without):
    without("ipyniivue")
    with pytest.raises(ResourceError, match=r"pip install 'palpate\[notebook\]'"):
        notebook_viewer(case_result)


GLUE = """
async ({ source, states, own }) => {
  const bytes = (text) => new DataView(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const models = {};
  for (const [id, state] of Object.entries(states)) {
    for (const [key, value] of Object.entries(state)) if (value && value.b64) state[key] = bytes(value.b64);
    models[id] = {
      get: (key) => state[key], set: (key, value) => { state[key] = value; }, model_id: id,
      save_changes() {}, send() {}, on() {}, onChange() {},
      off() {}, widget_manager: { get_model: async (id) => models[id] },
    };
  }
  const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
  const widget = (await import(url)).default;
  await widget.initialize({ model: models[own] });
  await widget.render({ model: models[own], el: document.getElementById("here") });
}
"""


def plain(state):
    """A widget's state as JSON: bytes under a mark, JavaScript left out, which goes on its own."""
    packed = {key: {"b64": base64.b64encode(v).decode()} if isinstance(v, bytes) else v for key, v in state.items()}
    return {key: value for key, value in packed.items() if key != "_esm"}


def test_the_widget_draws_the_organs_in_a_browser(case_result):
    """Its own JavaScript in a headless Chromium, with a stand-in for the notebook's models."""
    ipyniivue = pytest.importorskip("ipyniivue")
    playwright = pytest.importorskip("playwright.sync_api", reason="no playwright; pip install palpate[browser]")
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        pytest.skip("no Chromium here")
    viewer = notebook_viewer(case_result)
    assert viewer.opts.is_colorbar
    assert [volume.colorbar_visible for volume in viewer.volumes] == [False, True]
    states = {widget.model_id: plain(widget.get_state()) for widget in (viewer, *viewer.volumes)}
    source = (Path(ipyniivue.__file__).parent / "static" / "widget.js").read_text()
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with playwright.sync_playwright() as engine:
        browser = engine.chromium.launch(executable_path=path, args=flags)
        page = browser.new_page(viewport={"width": 600, "height": 420})
        requests, errors = [], []
        page.on("request", lambda request: requests.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.set_content("<div id=here style='width:600px'></div>")
        page.evaluate(GLUE, {"source": source, "states": states, "own": viewer.model_id})
        page.wait_for_timeout(500)
        picture = mpimg.imread(io.BytesIO(page.screenshot()))[..., :3]
        browser.close()
    assert errors == []
    assert [url for url in requests if not url.startswith(("blob:", "data:", "about:"))] == []
    red, green, blue = np.moveaxis(picture, 2, 0)
    yellow, teal = (green > blue + 0.2) & (red > 0.5), (green > red + 0.1) & (blue > red)
    assert yellow.mean() > 0.01  # viridis: the prostate of the largest modulus
    assert teal.mean() > 0.01  # and the bladder; crosshair, letters and the rest have neither colour
