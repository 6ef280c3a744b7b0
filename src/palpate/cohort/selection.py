"""Which rows of a cohort enter its statistics, and why the others do not."""

from __future__ import annotations

from collections.abc import Sequence

from palpate.cohort.records import Record
from palpate.findings import Misleading

UNFIT: tuple[Misleading, ...] = ("mirrored", "voxel-size", "units", "large-shift", "volume-implausible", "fold-over")
NOTHING_KNOWN = "not identified, and no end of its interval is known"
OTHER_UNIT = "its scale is not known, that of other rows is"
NOT_ESTIMATED = "not estimated"


def unit_of(records: Sequence[Record], tissue: str) -> str:
    """The unit in which the rows of a tissue are compared: "kPa" where any row has it, else "ratio"."""
    moduli = [record.modulus(tissue) for record in records]
    return "kPa" if any(modulus is not None and modulus.unit == "kPa" for modulus in moduli) else "ratio"


def unfit_codes(record: Record) -> list[str]:
    """The warnings of a row that say that its images or its case are wrong."""
    wrong: frozenset[str] = frozenset(UNFIT)
    return [code for code in record.warnings if code in wrong]


def why_left_out(record: Record, tissue: str, unit: str) -> str:
    """Why a row does not enter the statistics of a tissue, which are in `unit`; empty where it enters."""
    modulus = record.modulus(tissue)
    if record.state != "done":
        return record.state
    if modulus is None:
        return NOT_ESTIMATED
    if modulus.unit != unit:
        return OTHER_UNIT
    if codes := unfit_codes(record):
        return ", ".join(codes)
    return "" if modulus.low95 or modulus.high95 else NOTHING_KNOWN
