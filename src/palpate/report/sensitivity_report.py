"""sensitivity.html: how much of each modulus is assumption, one self-contained page without scripts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jinja2
from markupsafe import Markup

from palpate.report.rows import interval_text, main_numbers, number
from palpate.report.tornado import NAMES, effect_text, tornado_rows, tornado_svg


def sensitivity_page(document: Mapping[str, Any]) -> str:
    """The page of a document sensitivity.json; all names in it are escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("palpate.report"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    tissues = []
    for place, item in enumerate(document["estimates"]):
        value, interval = main_numbers(item)
        tissue, sobol = item["tissue"], document["sobol"]
        indices = []  # name of each input with its first and total index, the largest total first
        if sobol is not None:
            parts = [sobol[key][tissue] for key in ("total", "total_half", "first", "first_half")]
            named = zip([NAMES[of["cause"]].format(of["subject"]) for of in sobol["inputs"]], *parts, strict=True)
            ranked = sorted(named, key=lambda row: -row[1])
            indices = [(name, f"{a:.3f} ± {ah:.3f}", f"{b:.3f} ± {bh:.3f}") for name, b, bh, a, ah in ranked]
        tissues.append(
            {
                "name": tissue,
                "value": number(value),
                "unit": "kPa" if item["unit"] == "kPa" else f"× {item['relative_to']}",
                "interval": interval_text(interval),
                "chart": Markup(tornado_svg(document, tissue, name=f"tornado{place}")),  # noqa: S704 - ours
                "rows": [(row, effect_text(row)) for row in tornado_rows(document, tissue)],
                "sobol": indices,
            }
        )
    return str(environment.get_template("sensitivity.html").render(document=document, tissues=tissues))
