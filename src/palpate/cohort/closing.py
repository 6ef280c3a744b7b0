"""The files that tell of a whole cohort: its tables, its statistics, its page."""

from __future__ import annotations

from pathlib import Path

from palpate.cohort.page import cohort_page
from palpate.cohort.plan import Plan
from palpate.cohort.records import Record, records_of
from palpate.cohort.statistics.document import statistics_document
from palpate.cohort.tables import CSV, PARQUET, write_csv, write_parquet
from palpate.study.outputs import staged, write_json, write_text
from palpate.study.provenance import software_versions

__all__ = ["STATISTICS", "close_cohort"]

STATISTICS, PAGE = "statistics.json", "cohort.html"


def close_cohort(plan: Plan, folder: Path, *, tables_only: bool = False) -> tuple[Record, ...]:
    """Write cohort.csv, cohort.parquet, statistics.json and cohort.html, all or none, from the rows' files.

    tables_only: the first two alone. Raises `ResourceError` when the disk refuses, or a library is missing.
    """
    records = records_of(plan, folder)
    with staged(folder) as staging:
        write_csv(records, staging.area / CSV)
        write_parquet(records, staging.area / PARQUET)
        if not tables_only:
            document = statistics_document(records)
            write_json(staging.area / STATISTICS, document)
            version = software_versions().get("palpate", "")
            page = cohort_page(records, document, created=plan.began, version=version)
            write_text(staging.area / PAGE, page)
        staging.commit()
    return records
