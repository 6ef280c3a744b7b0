"""The demo: a complete estimate on a real anatomy, whose later state is simulated with known moduli."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from palpate.case.file import read_case
from palpate.images import Role, Tissue
from palpate.progress import Line, Progress
from palpate.statement.result import CaseResult
from palpate.study.run import estimate

__all__ = ["DATA", "FILLING_MM", "LAW", "TISSUES", "TRUTH_EDGE_MM", "run_demo"]

DATA = Path(__file__).parent / "data"
# how the later state was simulated, and the true moduli (kPa)
FILLING_MM = 8.0
LAW = "neo-hookean"
TRUTH_EDGE_MM = 5.0
TISSUES = (
    Tissue("prostate", Role.ESTIMATE, (1,), 0.45, 30.0),
    Tissue("bladder", Role.ESTIMATE, (2,), 0.45, 20.0),
    Tissue("rectum", Role.DRIVER, (3,)),
    Tissue("bones", Role.RIGID, (6, 7, 8, 9, 10)),
    Tissue("outside", Role.VOID, (0,)),
    Tissue("surroundings", Role.KNOWN, (), 0.45, 10.0),
)

NOTE = (
    "The anatomy is a real male pelvis CT (Wasserthal et al. 2023) with automatic labels of 3 mm voxels, smoothed; what"
    " the scan cuts off of the prostate is the mirror image of its upper part. The later state is simulated: the rectum"
    f" was filled by {FILLING_MM:g} mm in a neo-Hookean body on a finer mesh ({TRUTH_EDGE_MM:g} mm) with known moduli,"
    " and both states were turned into 1 mm label images, which is all that the estimate sees."
)


def run_demo(output: Path, progress: Progress) -> CaseResult:
    """Estimate prostate and bladder of the simulated pelvis; the result holds the true moduli beside the estimates.

    `output`: the folder where the caller writes the result. The images are part of the package.
    """
    progress(Line(f"demo: a real anatomy with a simulated later state; the results go to {output}"))
    case = read_case(DATA / "demo.toml")
    truth = {t.name: t.youngs_modulus_kpa for t in TISSUES if t.role is Role.ESTIMATE and t.youngs_modulus_kpa}
    return replace(estimate(case, progress=progress, truth=truth), note=NOTE)
