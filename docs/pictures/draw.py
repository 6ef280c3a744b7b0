"""The pictures of README and docs, from the report in an output folder, by a headless Chromium.

    make demo && pip install playwright && python docs/pictures/draw.py demo-output [--browser /usr/bin/chromium]

Writes `demo.png` (verdicts and slices) and `report.jpg` (slices and bodies) beside this file.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

WIDTH, HEIGHT, GAP = 1100, 2600, 16  # pixels; all of a part at once
PICTURES = {"demo.png": ("#result .verdicts", "#slices"), "report.jpg": ("#slices", "#organs")}


def main() -> None:
    """Draw both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--browser", help="a Chromium that is installed already")
    arguments = parser.parse_args()
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=arguments.browser, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.goto((arguments.folder / "report.html").resolve().as_uri())
        for name, sections in PICTURES.items():
            parts = []
            for place in sections:
                page.locator(place).first.scroll_into_view_if_needed()
                page.wait_for_timeout(1500)  # until its moving figures stand
                parts.append(Image.open(io.BytesIO(page.locator(place).first.screenshot())))
            width, height = max(p.width for p in parts), sum(p.height for p in parts) + GAP
            whole = Image.new("RGB", (width, height), "white")
            for part, top in zip(parts, (0, parts[0].height + GAP), strict=True):
                whole.paste(part, ((width - part.width) // 2, top))
            whole.save(Path(__file__).with_name(name), quality=85)
        browser.close()


if __name__ == "__main__":
    main()
