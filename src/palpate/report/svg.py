"""The templates of pages, and matplotlib figures as SVG that stands in them and takes their colours."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import jinja2
import matplotlib as mpl
from markupsafe import Markup, escape
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from palpate.findings import CODES, help_on
from palpate.images.registration import length_text
from palpate.report.rows import interval_text, number
from palpate.report.ticks import MOST, log_marks, mark_text

INK = "#010203"  # stands for the page's text colour, which differs between light and dark pages
STYLE = {
    "svg.fonttype": "path",
    "svg.hashsalt": "palpate",
    "text.parse_math": False,  # a tissue called $x is a name, not a formula
    "font.size": 9.0,
    "font.family": "DejaVu Sans",
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "grid.color": INK,
    "grid.alpha": 0.15,
    "grid.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
}


SIZE = (3.9, 2.5)  # inches, of a chart
LINK = "palpate-link-"
PREFIX = "palpate-figure-"  # of a figure's identifiers, until the page has given it a number

Chart = Callable[[Figure], str]
"""Paints on an empty figure of `SIZE`, or makes that larger, and gives what it shows in words."""


@cache
def template_of(name: str, package: str = "palpate.report") -> jinja2.Template:
    """A page's template, of that package or ours, all that is put into it escaped; a quarter of a page's time."""
    loader = jinja2.ChoiceLoader([jinja2.PackageLoader(package), jinja2.PackageLoader("palpate.report")])
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters |= {"number": number, "length_text": length_text, "code_link": code_link}
    environment.filters["interval"] = lambda ends: interval_text(None if ends is None else tuple(ends))
    return environment.get_template(name)


def page_of(template: str, package: str = "palpate.report", **parts: Any) -> str:
    """A page: the parts put into a template, and the identifiers of each figure in it kept apart by its number."""
    figures = template_of(template, package).render(**parts).split("<svg ")
    return "<svg ".join(text.replace(PREFIX, f"f{number}-") for number, text in enumerate(figures))


def code_link(code: str) -> Markup:
    """The code of a warning as HTML, with a link to its explanation where there is one."""
    name = Markup("<code>{}</code>").format(code)
    return Markup('<a href="{}" rel="noreferrer">{}</a>').format(help_on(code), name) if code in CODES else name


def link_url(number: int) -> str:
    """What an artist's url is until a figure's link of that number takes its place."""
    return f"{LINK}{number}-"


def mark_decades(axis: Axis, *, most: int = MOST) -> None:
    """Round numbers along a logarithmic axis as far as it reaches now, `most` at the most, written plainly."""
    low, high = sorted(float(end) for end in axis.get_view_interval())
    axis.set_major_locator(FixedLocator(log_marks(low, high, most=most)))
    axis.set_major_formatter(FuncFormatter(lambda mark, _: mark_text(mark)))
    axis.set_minor_locator(NullLocator())


def draw_svg(chart: Chart, links: Sequence[tuple[str, str]] = ()) -> str:
    """The SVG element that a chart paints, which says its words to who cannot see.

    Its identifiers begin with `PREFIX`. Elements that the chart gave the gid "layer-X" get the class "layer-X". links:
    address of each and what it says, where the chart gave artists the url `link_url` of its number. No state of
    matplotlib outlives the call.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=SIZE, layout="constrained")
        says = chart(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = text.getvalue()
    element = svg[svg.index("<svg") :]
    element = re.sub(r"<!--.*?-->", "", element, flags=re.DOTALL)  # comments repeat names
    element = re.sub(r"<metadata>.*?</metadata>", "", element, flags=re.DOTALL)
    element = re.sub(r'id="(layer-[a-z]+)[^"]*"', r'class="\1"', element)
    element = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", element, count=1)
    element = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", element, count=1)
    element = re.sub(r'\bid="', f'id="{PREFIX}', element)
    element = re.sub(r"url\(#", f"url(#{PREFIX}", element)
    element = re.sub(r'(xlink:)?href="#', f'href="#{PREFIX}', element)
    role = "group" if LINK in element else "img"  # an image hides what is in it from who cannot see
    for k, (address, words) in enumerate(links):
        link = f'<a href="{escape(address)}" aria-label="{escape(words)}">'
        element = element.replace(f'<a xlink:href="{link_url(k)}" target="_blank">', link)
    element = element.replace("<svg", f'<svg role="{role}" aria-label="{escape(says)}"', 1)
    return element.replace(INK, "currentColor")
