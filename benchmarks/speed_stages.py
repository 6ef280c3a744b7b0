"""The time of each stage of a whole case, from label images in memory to intervals, by a profiler."""

from __future__ import annotations

import cProfile
import pstats
from pathlib import Path
from typing import Any

from palpate.body import aligned
from palpate.case import Case
from palpate.images import segment
from palpate.phantoms import Scene
from palpate.study import estimate_states

__all__ = ["shares_of_stages"]

STAGES = {  # functions whose time, with all that they call, is a stage of its own
    "images checked and aligned": ("imaged.py", "aligned"),
    "level sets": ("anatomy.py", "anatomy_of"),
    "tetrahedra": ("tetrahedralise.py", "tetrahedralise"),
    "mesh gate": ("quality.py", "check_mesh"),
    "distance maps and targets": ("surface_distance.py", "surface_distances"),
    "wall modes": ("prescribed_motion.py", "prescribed_motion"),
    "stiffness assembled": ("linear_model.py", "linear_model"),
    "finite-strain model": ("finite_strain.py", "finite_strain_model"),
    "responses and series": ("starts.py", "informed_start"),
    "search": ("search.py", "searched"),
    "minima to which all starts lead": ("starts.py", "started"),
    "equilibrium at the linear estimate": ("estimate.py", "at_finite_strain"),
    "intervals and fits": ("estimation.py", "conclude"),
    "what would change the answer": ("variations.py", "what_would_change"),
}
WITHIN = {  # parts of the stages above
    "tetrahedra remeshed": ("remeshing.py", "remeshed"),
    "tetrahedra smoothed": ("smoothing.py", "smoothed"),
    "closest points": ("surface_residuals.py", "_closest"),
    "voxels of the model": ("voxelise.py", "voxelise"),
    "noise model": ("noise_model.py", "fit_noise_model"),
}


def shares_of_stages(scene: Scene, case: Case) -> dict[str, Any]:
    """Seconds of the whole, and the share of each stage and of what is within several; of JSON."""
    profile = cProfile.Profile()
    profile.enable()
    before, after = (segment(image, scene.tissues) for image in (scene.before, scene.after))
    result = estimate_states([aligned(before, (after,), method="none")], case)
    profile.disable()
    known = pstats.Stats(profile)
    total = known.total_tt  # type: ignore[attr-defined]
    spent = {name: _cumulative(known, *of) for name, of in (STAGES | WITHIN).items()}
    return {
        "dofs": 3 * len(result.space.points),
        "total_s": total,
        "shares": {name: spent[name] / total for name in STAGES},
        "within": {name: spent[name] / total for name in WITHIN},
    }


def _cumulative(stats: pstats.Stats, file: str, function: str) -> float:
    """Seconds in a function and what it calls; raises `KeyError` for one that was never called."""
    rows = stats.stats.items()  # type: ignore[attr-defined]
    called = [row[3] for (path, _, name), row in rows if name == function and Path(path).name == file]
    if not called:
        raise KeyError(f"{file}: {function} was never called; is it still the stage's name?")
    return float(sum(called))
