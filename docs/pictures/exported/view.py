"""Pictures of the report that `palpate view` serves, and of the notebook's widget, in a headless Chromium."""

from __future__ import annotations

import base64
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
# A stand-in for the notebook: each widget's state by its number, and the one to draw.
NOTEBOOK = """
async ({ source, states, own }) => {
  const bytes = (text) => new DataView(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const models = {};
  const nothing = () => {};
  for (const [id, state] of Object.entries(states)) {
    for (const [key, value] of Object.entries(state)) if (value && value.bytes) state[key] = bytes(value.bytes);
    models[id] = {
      model_id: id, get: (key) => state[key], set: (key, value) => { state[key] = value; },
      save_changes: nothing, send: nothing, on: nothing, onChange: nothing, off: nothing,
      widget_manager: { get_model: async (other) => models[other] },
    };
  }
  const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
  const widget = (await import(url)).default;
  await widget.initialize({ model: models[own] });
  await widget.render({ model: models[own], el: document.body });
}
"""


def view(folder: Path, picture: Path) -> None:
    """The page at the address that `palpate view` prints."""
    command = [sys.executable, "-m", "palpate", "view", str(folder), "--no-browser"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:  # noqa: S603 - our own
        try:
            assert server.stderr is not None
            address = next(line.strip() for line in server.stderr if line.startswith("http://"))
            with _page(760, 436) as page:
                page.goto(address)
                page.locator("#result").scroll_into_view_if_needed()
                page.wait_for_timeout(1500)  # until its figures stand
                page.screenshot(path=picture, type="jpeg", quality=75)
        finally:
            server.terminate()


def notebook(folder: Path, picture: Path) -> None:
    """What `result.view(CT)` gives, drawn by ipyniivue's own JavaScript; the case of the folder is estimated for it."""
    import ipyniivue

    import palpate

    case = palpate.read_case(folder / "case.toml")
    assert case.images is not None, "the demo's case has images"
    viewer = palpate.estimate(case).view(case.images.intensities_before)
    states = {widget.model_id: _plain(widget.get_state()) for widget in (viewer, *viewer.volumes)}
    source = (Path(ipyniivue.__file__).parent / "static" / "widget.js").read_text(encoding="utf-8")
    with _page(700, 400) as page:
        page.set_content("<body style='margin: 0'></body>")
        page.evaluate(NOTEBOOK, {"source": source, "states": states, "own": viewer.model_id})
        page.wait_for_timeout(1500)
        page.screenshot(path=picture, type="jpeg", quality=75)


@contextmanager
def _page(width: int, height: int) -> Iterator[Page]:
    """A page of a headless Chromium, the system's or else playwright's own, drawn finer than a screen does."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=browser, args=FLAGS)
        try:
            size: Any = {"width": width, "height": height}
            yield chromium.new_page(viewport=size, device_scale_factor=1.7, color_scheme="light")
        finally:
            chromium.close()


def _plain(state: dict[str, Any]) -> dict[str, Any]:
    """A widget's state as JSON, without its JavaScript, which goes on its own."""
    packed = {k: {"bytes": base64.b64encode(v).decode()} if isinstance(v, bytes) else v for k, v in state.items()}
    return {key: value for key, value in packed.items() if key != "_esm"}
