"""cohort.html: who came in, who failed and why, what the moduli have to do with the stage, every case's report."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from markupsafe import Markup

from palpate.cohort.charts import boxes, forest, scatter
from palpate.cohort.records import Record
from palpate.report.svg import draw_svg, page_of

LOGGER = logging.getLogger(__name__)
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
MOST_ROWS = 2000  # of the table; cohort.csv has all


def cohort_page(records: Sequence[Record], document: Mapping[str, Any], *, created: str, version: str) -> str:
    """The page of a cohort: one file that loads nothing, every name in it escaped.

    document: statistics.json; created: when the run began.
    """
    # address of the report of each patient's first row that has one, and what a link to it says
    pages = dict[str, tuple[str, str]]()
    for record in records:
        if record.page:
            says = f"report of {record.row.id}, patient {record.row.patient}"
            pages.setdefault(record.row.patient, (record.page, says))
    patients, charts = document["patients"], dict[str, list[dict[str, Any]]]()
    links = {name: number for number, name in enumerate(pages)}
    for tissue, organ in document["organs"].items():
        of = {"patients": patients, "tissue": tissue, "unit": organ["unit"], "links": links}
        drawings = {
            "Scans by stage, patients as points": partial(boxes, **of),
            "Patients against the stage": partial(scatter, line=organ["regression"], **of),
            "Patients": partial(forest, **of),
        }
        charts[tissue] = []
        for title, chart in drawings.items():
            body, missing = None, ""
            try:
                body = Markup(draw_svg(chart, list(pages.values())))  # noqa: S704 - drawn by us, names in it as paths
            except ValueError as error:
                missing = str(error)
            except Exception as error:
                LOGGER.exception("a chart could not be drawn")
                missing = f"it could not be drawn ({error})"
            charts[tissue].append({"title": title, "body": body, "missing": missing})
    shown = [record for record in records if record.state == "failed"] + [r for r in records if r.state != "failed"]
    return page_of(
        "cohort.html",
        "palpate.cohort",
        records=shown[:MOST_ROWS],
        left_out=len(shown[MOST_ROWS:]),
        document=document,
        charts=charts,
        created=created,
        version=version,
        policy=POLICY,
    )
