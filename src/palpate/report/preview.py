"""The page that shows a case before it is estimated: who is who, how all lies, what is held, what can be expected."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from palpate.body.imaged import ImagedStates
from palpate.case.case import Case
from palpate.errors import InputDataError
from palpate.images.checks import VOLUME_CHANGE
from palpate.images.registration import length_text
from palpate.images.tissue import Role, Tissue, tissue_colours
from palpate.report.collect import MOST_LATER
from palpate.report.page import page_scripts, policy_of, slices_of, widths_of
from palpate.report.payload import payload
from palpate.report.preview_data import ROLE_COLOURS, PreviewImage, preview_data, preview_image
from palpate.report.report_data import ReportData
from palpate.report.rows import NONE, EstimateRow, estimate_rows, number, scale_marks
from palpate.report.slices import alignment_chart, slice_chart
from palpate.report.svg import page_of
from palpate.report.units import shown_unit
from palpate.report.volume import Grey, grey_of
from palpate.study.check import Checked, Problem
from palpate.study.first_look import FrameLook, TissueLook, frame_look, tissue_looks
from palpate.study.prediction import Prediction

GENERATOR = '<meta name="generator" content="Palpate preview">'  # by which a page of ours is known
SCRIPTS = ("report.js", "slices.js", "preview.js", "start.js")
LEAST_SHARE = 0.005  # of a variance, that is told
MEANING = {
    Role.ESTIMATE: "its stiffness is sought",
    Role.KNOWN: "its stiffness is given",
    Role.DRIVER: "its wall moves the others",
    Role.RIGID: "bone; held, or moved as one body",
    Role.VOID: "not part of the body",
    Role.SLIDING: "the body glides along it",
}


def preview_page(checked: Checked, *, created: str, version: str, no_prediction: str = "") -> str:
    """The preview of a case that was checked, one self-contained page with all names escaped.

    no_prediction: why the report has no predicted intervals, where it has none. Of several pairs of images the first is
    drawn.
    """
    shown = _shown_of(checked, created)
    report, prediction = checked.report, checked.report.predicted
    images = shown.images if shown else ()
    scripts = page_scripts(SCRIPTS) if images else ()
    drawn, later = len(images), sum(len(pair.after) for pair in checked.states)
    tissues = shown.states.before.tissues if shown else ()
    expected, marks, axis = _expected(prediction, shown.states if shown else None)
    return page_of(
        "preview.html",
        id=report.id,
        patient=checked.case.patient if checked.case else report.id,
        version=version,
        created=created,
        policy=policy_of(scripts),
        scripts=scripts,
        live=payload(shown.data, images) if shown and shown.data and images else None,
        banner=_banner(report.problems, prediction),
        problems=report.problems,
        predicted=expected,
        marks=marks,
        axis=axis,
        prediction=prediction,
        no_prediction=no_prediction or "There is no prediction.",
        cost=report.cost,
        meshed=bool(checked.bodies),
        tissues=tuple(_rows(tissues, shown.looks)) if shown else (),
        names=shown.names if shown else (),
        roles=[
            (role, ROLE_COLOURS.get(role, "#888888"), ", ".join(t.name for t in tissues if str(t.role) == role))
            for role in dict.fromkeys(str(tissue.role) for tissue in tissues)
        ],
        held=shown.frame.held if shown else (),
        later=tuple(_later(shown, k, image) for k, image in enumerate(images)) if shown else (),
        left_out=f"{drawn} of {later} later images are drawn, those of the first pair." if 0 < drawn < later else "",
    )


@dataclass(frozen=True, slots=True)
class _Shown:
    """The first pair of images of a case as a preview shows it; data, images: where it has later ones."""

    states: ImagedStates
    names: tuple[str, ...]
    frame: FrameLook
    looks: tuple[TissueLook, ...]
    data: ReportData | None = None
    images: tuple[PreviewImage, ...] = ()


def _shown_of(checked: Checked, created: str) -> _Shown | None:
    """None of a case whose images cannot be read, or that comes as a mesh."""
    case, states = checked.case, next(iter(checked.states), None)
    if case is None or states is None or states.mesh is not None:
        return None
    frame = frame_look(case, states.before, states.after)
    # names of the first image and of its later ones, each once
    images = case.images
    given = [] if images is None else [images.before.name, *(path.name for path in images.after)]
    plain = ["before", *(f"after {k}" if len(states.after) > 1 else "after" for k in range(1, len(states.after) + 1))]
    distinct = len(given) == len(plain) and len(set(given)) == len(given)
    names = tuple(given if distinct else plain)
    looks = tissue_looks(states.before, states.after, frame.box)
    if not states.after:
        return _Shown(states, names, frame, looks)
    data = preview_data(states, names, {"id": checked.report.id}, created=created)
    data = replace(data, later=data.later[:MOST_LATER])
    box = data.references[0].slices
    assert box is not None, "the images of a preview have a box"
    first = _grey(case, states, None)
    return _Shown(
        states,
        names,
        frame,
        looks,
        data,
        tuple(
            preview_image(states, k, box, looks, frame, (first, _grey(case, states, k))) for k in range(len(data.later))
        ),
    )


def _banner(problems: Sequence[Problem], prediction: Prediction | None) -> dict[str, Any]:
    """What a reader must know first."""
    refused = sum(problem.exit_code > 0 for problem in problems)
    warned = len(problems) - refused
    if refused:
        title = "An estimate would refuse this case."
        return {"kind": "bad", "title": title, "sentences": (f"{_count(refused, 'problem')} must be solved first.",)}
    sentences: tuple[str, ...] = ("No problem was found.",)
    if warned:
        sentences = (f"Read {_count(warned, 'warning')} first.",)
    if prediction is None:
        return {"kind": "fair" if warned else "good", "title": "The case can be estimated.", "sentences": sentences}
    lost = [of.tissue for of in prediction.moduli if of.verdict == "not identified"]
    weak = [of.tissue for of in prediction.moduli if of.verdict == "weak"]
    if lost:
        title = f"These images can hardly fix the stiffness of {' and '.join(lost)}."
        return {"kind": "bad", "title": title, "sentences": sentences}
    title = "The case can be estimated."
    if weak:
        sentences = (f"The interval of {' and '.join(weak)} will be wide.", *sentences)
    return {"kind": "fair" if warned or weak else "good", "title": title, "sentences": sentences}


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


def _rows(tissues: tuple[Tissue, ...], looks: Sequence[TissueLook]) -> Iterator[Mapping[str, Any]]:
    """Each tissue, as texts: who it is, what is known of it, its volume with its change and its shift in each image."""
    for tissue, look, colour in zip(tissues, looks, tissue_colours(tissues), strict=True):
        modulus = {Role.ESTIMATE: "sought", Role.KNOWN: f"{number(tissue.youngs_modulus_kpa)} kPa"}.get(
            tissue.role, NONE
        )
        if tissue.role is Role.KNOWN and tissue.modulus_sd:
            modulus += f", within a factor of {np.exp(1.96 * tissue.modulus_sd):.2g}"
        states, first = [], look.volumes_ml[0]
        for after, later in enumerate(look.volumes_ml[1:]):
            change = later / first - 1.0 if first and look.middle is not None else None
            shift = np.round(look.shifts_mm[after], 1) + 0.0 if look.shifts_mm else None
            states.append(
                {
                    "volume": number(later),
                    "change": "" if change is None else f"{round(100.0 * change, 1) + 0.0:+.1f} %",
                    "much": change is not None and abs(change) > VOLUME_CHANGE,
                    "shift": NONE if shift is None else f"{np.linalg.norm(look.shifts_mm[after]):.1f}",
                    "parts": "" if shift is None else "R {:+.1f}, A {:+.1f}, S {:+.1f}".format(*shift),
                }
            )
        frame = "" if look.frame_mm is None else number(look.frame_mm, digits=2) if look.frame_mm >= 0.1 else "0"
        yield {
            "name": tissue.name,
            "colour": colour,
            "role": str(tissue.role),
            "role_colour": ROLE_COLOURS.get(str(tissue.role), colour),
            "meaning": MEANING[tissue.role],
            "labels": ", ".join(map(str, tissue.labels)) or "all others",
            "modulus": modulus,
            "volume": number(look.volumes_ml[0]),
            "states": tuple(states),
            "frame": frame or NONE,
            "towards": frame and f"towards the {look.towards}",
        }


def _expected(
    prediction: Prediction | None, states: ImagedStates | None
) -> tuple[tuple[tuple[EstimateRow, str, str, str], ...], tuple[tuple[float, str], ...], str]:
    """A row for each modulus with its interval, guess and unit as texts; marks and label of their common scale."""
    if prediction is None or states is None:
        return (), (), ""
    colours = dict(zip([t.name for t in states.before.tissues], tissue_colours(states.before.tissues), strict=True))
    items = []
    for of in prediction.moduli:
        kpa = of.unit == "kPa"
        interval = list(of.interval95)
        item: dict[str, Any] = {"parameter": "youngs_modulus", "tissue": of.tissue, "unit": of.unit}
        item |= {"value": of.guess if kpa else None, "interval95": interval if kpa else None}
        item |= {"ratio": of.ratio if kpa else of.guess, "ratio_interval95": of.ratio_interval95 if kpa else interval}
        shares = {cause: share for cause, share in of.shares.items() if share >= LEAST_SHARE}
        item |= {"relative_to": of.relative_to, "verdict": of.verdict, "why": of.why}
        items.append(item | {"truth": None, "variance_shares": shares})
    document = {"status": "converged", "estimates": items, "case": {}}
    rows = estimate_rows(document, colours)
    found = [(row, row.shown_interval, row.shown, row.shown_in) for row in rows]
    return tuple(found), scale_marks(document), shown_unit(document).axis


def _grey(case: Case, states: ImagedStates, after: int | None) -> Grey | None:
    """The grey image of the first state, or of a later one brought to it; None where there is none that fits."""
    images = case.images
    if images is None:
        return None
    path = images.intensities_before if after is None else next(iter(images.intensities_after[after : after + 1]), None)
    if path is None:
        return None
    try:
        return grey_of(path, None if after is None else states.later[after].alignment)
    except InputDataError:  # a problem of the report, which says why
        return None


def _later(shown: _Shown, k: int, image: PreviewImage) -> Mapping[str, Any]:
    """The figures and sentences of one later image."""
    data, states, frame = shown.data, shown.states, shown.frame
    assert data is not None, "there are later images"
    reference, later = data.references[0], data.later[k]
    by_role = replace(data, tissues=tuple(replace(t, colour=ROLE_COLOURS.get(t.role, t.colour)) for t in data.tissues))
    backed = replace(by_role, references=(replace(reference, background=image.organs[0]),))
    both = replace(later, both=image.whole[:2])
    found = states.later[k].alignment
    first, second = frame.shared[k]
    lay = (
        "The images are taken as they lie; nothing was aligned." if found is None else f"{later.name} {found.in_words}."
    )
    bones = any(tissue.role == "rigid" for tissue in data.tissues)
    return {
        "name": later.name,
        "slices": slices_of(reference.slices, partial(slice_chart, model=False), backed, later),
        "widths": widths_of(reference.slices),
        "whole": slices_of(reference.whole, alignment_chart, data, both),
        "whole_widths": widths_of(image.view),
        "moved": image.motion is not None,
        "greys": any(image.greys),
        "grey_volumes": image.greys,
        "factor": image.factor,
        "alignment": lay,
        "stands": "the bones stand" if bones else "what does not touch the drivers stands",
        "residuals": ""
        if found is None
        else ", ".join(f"{name} {length_text(mm)} mm" for name, mm in found.residual_by_tissue_mm.items()),
        "fields": f"{later.name} shows {100.0 * first:.0f} % of what {reference.name} shows; {reference.name} shows"
        f" {100.0 * second:.0f} % of what {later.name} shows.",
    }
