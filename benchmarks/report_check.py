"""A report in a real browser: wide and narrow, light and dark, by keyboard, and by axe-core.

    make demo && make report-check [REPORT=demo-output/report.html] [BROWSER=/usr/bin/chromium]

Prints one JSON object and ends with exit code 1 when it found something: a word on the console, a request, anything
wider than a telephone, a serious finding of axe-core, a control that the keyboard does not reach or whose focus cannot
be seen. `--pictures DIR` keeps what it saw: the whole page in each width and theme as PNG, and on paper as PDF.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import sys
from itertools import product
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

WIDTHS, THEMES, HEIGHT = (1400, 390), ("light", "dark"), 900
FLAGS = (
    *("--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-sync"),
    *("--disable-component-update", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
)
NAMES = ("chromium", "chromium-browser", "google-chrome")
MOST_STEPS = 400  # of the tabulator key
# Every control that can be seen, a group of radio buttons as one; what has the focus, and whether that can be seen.
CONTROLS = """() => {
  const known = document.querySelectorAll("a[href], button, input, select, textarea, summary, [tabindex='0']");
  const named = (e) => e.getAttribute("aria-label") || e.innerText || e.closest("label")?.innerText || e.className;
  window.keyOf = (e) => e.type === "radio" ? `radio ${e.name}`
    : `${e.tagName.toLowerCase()} ${[...known].indexOf(e)} ${named(e).trim().slice(0, 40)}`;
  return [...new Set([...known].filter((e) => e.checkVisibility({ visibilityProperty: true })).map(window.keyOf))];
}"""
FOCUSED = """() => {
  const e = document.activeElement;
  if (!e || e === document.body) return null;
  const seen = [e, e.closest("label")].some((x) => x && getComputedStyle(x).outlineStyle !== "none");
  return { key: window.keyOf(e), seen };
}"""
AXE = """async () => (await axe.run(document, { resultTypes: ["violations"] })).violations
  .map((v) => ({ id: v.id, impact: v.impact, help: v.help, where: v.nodes.map((n) => n.target.join(" ")).slice(0, 3) }))
"""


def main() -> None:
    """Look at the page and say what is wrong with it."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("report", type=Path)
    parser.add_argument("--axe", type=Path, required=True, help="axe.min.js of the package axe-core")
    parser.add_argument("--browser", help="a Chromium; without it playwright's own, else the system's")
    parser.add_argument("--pictures", type=Path, help="a folder for what it saw")
    arguments = parser.parse_args()
    address, axe = arguments.report.resolve().as_uri(), arguments.axe.read_text(encoding="utf-8")
    with sync_playwright() as play:
        own = play.chromium.executable_path
        path = arguments.browser or (None if Path(own).exists() else next(filter(None, map(shutil.which, NAMES)), None))
        browser = play.chromium.launch(executable_path=path, args=list(FLAGS))
        views = {
            f"{width}-{theme}": looked_at(browser, address, axe, width, theme, arguments.pictures)
            for width, theme in product(WIDTHS, THEMES)
        }
        if arguments.pictures:
            page = browser.new_page()
            page.goto(address)
            page.pdf(path=str(arguments.pictures / "print.pdf"), prefer_css_page_size=True)
        browser.close()
    findings = [f"{view}: {finding}" for view, found in views.items() for finding in found["findings"]]
    print(json.dumps({"report": str(arguments.report), "views": views}, indent=1))
    sys.exit(1 if findings else 0)


def looked_at(
    browser: Browser, address: str, axe: str, width: int, theme: str, pictures: Path | None
) -> dict[str, Any]:
    """What one reader finds: the findings, and how much was looked at."""
    page = browser.new_page(viewport={"width": width, "height": HEIGHT}, color_scheme=theme)
    findings: list[str] = []
    page.on("console", lambda message: findings.append(f"console, {message.type}: {message.text}"))
    page.on("pageerror", lambda error: findings.append(f"error: {error}"))
    page.on("request", lambda request: findings.append(f"request: {request.url}") if request.url != address else None)
    page.goto(address)
    picture = scrolled_through(page, width)
    if pictures:
        pictures.mkdir(parents=True, exist_ok=True)
        picture.save(pictures / f"{width}-{theme}.png")
    wide = page.evaluate("document.documentElement.scrollWidth")
    if wide > width:
        findings.append(f"{wide} pixels wide in a window of {width}")
    page.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    page.evaluate(axe)
    violations = page.evaluate(AXE)
    findings += [f"axe: {v}" for v in violations if v["impact"] in ("serious", "critical")]
    controls = by_keyboard(page, findings)
    page.close()
    slight = [v["id"] for v in violations if v["impact"] not in ("serious", "critical")]
    return {"findings": findings, "controls": controls, "slight_axe_findings": slight}


def scrolled_through(page: Page, width: int) -> Image.Image:
    """The whole page as one picture; all its moving figures have started then."""
    page.wait_for_timeout(500)
    fixed = page.add_style_tag(content="nav { position: static !important }")
    parts, top = [], 0
    while top < page.evaluate("document.documentElement.scrollHeight"):
        page.evaluate(f"window.scrollTo(0, {top})")
        page.wait_for_timeout(600)
        parts.append((int(page.evaluate("window.scrollY")), Image.open(io.BytesIO(page.screenshot()))))
        top += HEIGHT
    whole = Image.new("RGB", (width, page.evaluate("document.documentElement.scrollHeight")))
    for y, part in parts:
        whole.paste(part, (0, y))
    fixed.evaluate("style => style.remove()")
    return whole


def by_keyboard(page: Page, findings: list[str]) -> int:
    """How many controls there are; those that the tabulator key does not reach, and unseen focus, are findings."""
    wanted = set(page.evaluate(CONTROLS))
    page.evaluate("window.scrollTo(0, 0)")
    reached: set[str] = set()
    for _ in range(MOST_STEPS):
        page.keyboard.press("Tab")
        focused = page.evaluate(FOCUSED)
        if focused is None or (focused["key"] in reached and not wanted - reached):
            break
        if not focused["seen"]:
            findings.append(f"keyboard: the focus on '{focused['key']}' cannot be seen")
        reached.add(focused["key"])
    findings += [f"keyboard: '{key}' is not reached" for key in sorted(wanted - reached)]
    return len(wanted)


if __name__ == "__main__":
    main()
