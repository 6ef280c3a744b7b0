"""A result as it is used in Python: saved, drawn, shown in a notebook, put into a table."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from palpate import report
from palpate.errors import ResourceError
from palpate.export.notebook import notebook_viewer
from palpate.images.tissue import Role, Tissue, tissue_colours
from palpate.progress import counted
from palpate.report.rows import moduli_in, number
from palpate.statement import result
from palpate.steps.saving import save_estimate
from palpate.steps.warning_lines import warning_lines
from palpate.study.earlier import refuse_other_case
from palpate.study.outputs import OutputFolder

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


COLUMNS = ("patient", "id", "stage", "status")


def _short(item: Mapping[str, Any]) -> str:
    """A modulus in a few words."""
    if item["value"] is not None and item["verdict"] != "ratio only":
        return f"{item['tissue']} {number(item['value'])} kPa"
    found = "no value" if item["ratio"] is None else f"{number(item['ratio'])} x {item['relative_to']}"
    return f"{item['tissue']} {found}"


class _Shown:
    """What a person does with the document of a result: text, cards for notebooks, a table, a figure."""

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """The document result.json."""
        raise NotImplementedError

    @property
    def colours(self) -> dict[str, str]:
        """Colour (#rrggbb) of each tissue."""
        raise NotImplementedError

    def to_dataframe(self) -> pd.DataFrame:
        """A row a modulus: case, tissue, value and 95 % interval in kPa and as a ratio, verdict, truth.

        What is not stated, an interval or a value, is NaN. Raises `ResourceError` where pandas is not installed.
        """
        try:
            pandas = import_module("pandas")
        except ImportError as error:
            raise ResourceError(
                "a table of results needs pandas, which is not installed: pip install 'palpate[dataframe]'; without it,"
                " to_dict()['estimates'] holds the same numbers"
            ) from error
        document = self.to_dict()
        heading = {key: document[key] for key in COLUMNS}
        rows = []
        for item in moduli_in(document):
            (low, high), (least, most) = (item[key] or (None, None) for key in ("interval95", "ratio_interval95"))
            rows.append(
                heading
                | {"tissue": item["tissue"], "value_kpa": item["value"], "low_kpa": low, "high_kpa": high}
                | {"ratio": item["ratio"], "ratio_low": least, "ratio_high": most, "relative_to": item["relative_to"]}
                | {"verdict": item["verdict"], "why": item["why"], "truth_kpa": item["truth"]}
            )
        numbers = ["value_kpa", "low_kpa", "high_kpa", "ratio", "ratio_low", "ratio_high", "truth_kpa"]
        table: pd.DataFrame = pandas.DataFrame(rows).astype(dict.fromkeys(numbers, float))
        return table

    @overload
    def plot(self, ax: None = None, *, unit: str | None = None) -> Figure: ...

    @overload
    def plot(self, ax: Axes, *, unit: str | None = None) -> Axes: ...

    def plot(self, ax: Axes | None = None, *, unit: str | None = None) -> Figure | Axes:
        """The moduli with their 95 % intervals on a logarithmic axis; open ends are arrows.

        ax: axes of matplotlib to draw on, which are given back; None: a figure of its own, which a notebook shows and
        `savefig("moduli.png")` writes without a display. unit: "kPa" or "ratio"; None: that of the report. Raises
        `ConfigurationError` for a unit in which the result has no numbers.
        """
        if ax is not None:
            return report.moduli_axes(ax, self.to_dict(), self.colours, unit)
        return report.moduli_figure(self.to_dict(), self.colours, unit)

    def __str__(self) -> str:
        """Each tissue's value, interval, verdict and why on a line; then the warnings, the most harmful one first."""
        document = self.to_dict()
        note = [document["note"]] if document.get("note") else []
        return "\n".join([report.result_lines(document), *warning_lines(document).splitlines(), *note])

    def __repr__(self) -> str:
        """One line: the case, its moduli, and how many warnings there are."""
        document = self.to_dict()
        found = ", ".join(map(_short, moduli_in(document)))
        status = "" if document["status"] == "converged" else f"{document['status']}; "
        return f"<result of '{document['id']}': {status}{found}; {counted(len(document['warnings']), 'warning')}>"

    def _repr_html_(self) -> str:
        """The verdict of each tissue as a card and the warnings, for notebooks."""
        return report.result_cards(self.to_dict(), self.colours)


@dataclass(frozen=True, slots=True, repr=False)
class SavedResult(_Shown):
    """What an earlier estimate left in a folder: its document result.json."""

    document: Mapping[str, Any]
    folder: Path

    def to_dict(self) -> dict[str, Any]:
        """The document result.json."""
        return dict(self.document)

    @property
    def colours(self) -> dict[str, str]:
        """Colour (#rrggbb) of each tissue that was estimated; those of label tables are not kept."""
        names = [item["tissue"] for item in moduli_in(self.document)]
        tissues = tuple(Tissue(name, Role.ESTIMATE) for name in names)
        return dict(zip(names, tissue_colours(tissues), strict=True))


@dataclass(frozen=True, slots=True, repr=False)
class CaseResult(_Shown, result.CaseResult):
    """The outcome of `palpate.estimate`: what the study found, and what a person does with it.

    Everything in it is described in `palpate.study.CaseResult`, whose fields it has.
    """

    def to_dict(self) -> dict[str, Any]:
        """The document result.json."""
        return result.CaseResult.to_dict(self)

    @property
    def colours(self) -> dict[str, str]:
        """Colour (#rrggbb) of each tissue."""
        return {t.name: colour for t, colour in zip(self.tissues, tissue_colours(self.tissues), strict=True)}

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> tuple[Path, ...]:
        """Write result.json, report.html, mesh.vtu ... into `folder`, as `palpate estimate` does, all or none of them.

        overwrite: replace the result of another case there. Gives the paths that were written. Raises
        `ConfigurationError` where the folder holds the result of another case, or a case.toml of somebody's own,
        `ResourceError` where another run works there or the disk refuses.
        """
        outputs = OutputFolder(Path(folder), overwrite=overwrite)
        with outputs.held():
            refuse_other_case(self.case, outputs)
            save_estimate(self, outputs)
        return tuple(outputs.path / name for name in outputs.written)

    def view(self, background: str | os.PathLike[str] | None = None, *, opacity: float = 0.6) -> Any:
        """A widget for notebooks: slices and volume of the first image, Young's modulus over it.

        background: a grey image (NIfTI ...) in the place of the tissues in their colours; opacity: of the modulus, 0 to
        1. Raises `ResourceError` without ipyniivue: pip install 'palpate[notebook]'.
        """
        return notebook_viewer(self, background=None if background is None else Path(background), opacity=opacity)
