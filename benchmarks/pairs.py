"""How much further image pairs of a patient reduce the error, and how much one spoilt pair adds.

    python benchmarks/pairs.py [--patients 20] [--first-seed 701] [--law linear] [--output FILE] [--json]

Simulated pelves: a patient has one body and four pairs of label images, each with a motion and a noise of its own (0.3
mm over 6 mm, voxels of 1 x 1 x 2.5 mm). Estimated are the first pair alone, all four together, and the same with the
prostate of the fourth pair's later image shifted by 3 mm. The robust estimate is the random-effects mean of the pairs
that are no outliers (`image_pairs` of a result); a pair is named by the warnings `pair-outlier` and `pair-noise`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from accuracy import NOISE
from rows import Job, Result, collected, mean, parser_of, printed, rms, seeds_of

from palpate.body import ImagedStates, aligned
from palpate.case import Case, Mechanics, Phantom
from palpate.images import LabelImage, segment
from palpate.phantoms import PelvisOptions, Scene, pelvis, pelvis_grid, reimaged
from palpate.study import estimate_states

PAIRS = 4
SHIFT_MM, SHIFTED = 3.0, "prostate"
TRUTH_EDGE_MM = 5.0
TRIED = ("one", "four", "spoilt")


def main() -> int:
    """Run what was asked for and print the summary."""
    parser = parser_of(__doc__ or "", output="pairs.jsonl", first_seed=701, seeds=20, name="--patients")
    parser.add_argument("--law", default="linear")
    asked = parser.parse_args()
    jobs = (Job({"law": asked.law, "seed": seed}, partial(_patient, seed, asked.law)) for seed in seeds_of(asked))
    summary = summary_of([line for line in collected(jobs, asked, ("law", "seed")) if line["law"] == asked.law])
    printed({asked.law: summary}, asked, {name: partial(_cell, name) for name in summary})
    return 0


def _patient(seed: int, law: str) -> Result:
    """Errors of ln E: of the first pair, of all four, and of all with a spoilt one."""
    rng = np.random.default_rng([seed, 5])
    scenes = [_scene(seed, number, law, float(rng.uniform(6.0, 8.0))) for number in range(PAIRS)]
    states = [_states(scene, scene.after) for scene in scenes]
    last = scenes[-1]
    spoilt = [*states[:-1], _states(last, _shifted(last, rng))]
    case = Case(f"patient-{seed}", phantom=Phantom("pelvis", seed), mechanics=Mechanics(law))
    tried = {"one": states[:1], "four": states, "spoilt": spoilt}
    return {name: _estimated(case, pairs, scenes[0].moduli_kpa) for name, pairs in tried.items()}


def _scene(seed: int, number: int, law: str, filling_mm: float) -> Scene:
    """One pair of images of a patient, with a noise of its own."""
    options = PelvisOptions(seed, filling_mm, (1.0, 1.0, 2.5), truth_edge_mm=TRUTH_EDGE_MM, law=law, motion_seed=number)
    return reimaged(replace(pelvis(options), seed=seed + 1000 * number), pelvis_grid(options), noise=NOISE)


def _states(scene: Scene, after: LabelImage) -> ImagedStates:
    return aligned(segment(scene.before, scene.tissues), (segment(after, scene.tissues),), method="none")


def _shifted(scene: Scene, rng: np.random.Generator) -> LabelImage:
    """The later image with one organ drawn 3 mm away from its place, along a direction in the slice."""
    label = scene.mesh.tissue_index(SHIFTED) + 1
    rest = scene.mesh.tissue_index("surroundings") + 1
    axis, sign = int(rng.integers(2)), int(rng.choice([-1, 1]))
    steps = sign * round(SHIFT_MM / float(scene.after.grid.spacing[axis]))
    organ = scene.after.labels == label
    labels = np.where(organ, rest, scene.after.labels)
    return replace(scene.after, labels=np.where(np.roll(organ, steps, axis), label, labels))


def _cell(name: str, row: Result) -> str:
    """A figure of a row."""
    return f"{row[name]:.3g}"


def _estimated(case: Case, pairs: Sequence[ImagedStates], truth: Mapping[str, float]) -> Result:
    """Errors of ln E by organ, of the joint estimate, of every pair alone in it, and of the robust mean."""
    began = time.perf_counter()
    estimation = estimate_states(pairs, case, truth=truth).estimation
    found: Result = {"status": estimation.status, "seconds": round(time.perf_counter() - began, 1)}
    found["joint"] = [
        None if e.value is None else float(np.log(e.value / truth[e.tissue])) for e in estimation.estimates
    ]
    together = estimation.image_pairs
    if together is not None:
        names = [e.tissue for e in estimation.estimates]

        def errors(moduli: Mapping[str, float]) -> list[float]:
            """Of ln E by organ."""
            return [float(np.log(moduli[name] / truth[name])) for name in names]

        found |= {"alone": [errors(pair.moduli) for pair in together.alone], "robust": errors(together.mean)}
        found |= {"p": together.heterogeneity_p, "noise_mm": [dict(pair.noise_mm) for pair in together.alone]}
        said = [finding.message for finding in estimation.remarks if finding.code in ("pair-outlier", "pair-noise")]
        found["named"] = [any(f"'after[{k}]'" in message for message in said) for k in range(1, len(pairs) + 1)]
    return found


def summary_of(rows: Sequence[Result]) -> Result:
    """Root mean squares over patients whose three estimates all converged, and how often the spoilt pair was named."""
    whole = [row for row in rows if all(row[name]["status"] == "converged" for name in TRIED)]

    def error(name: str, kind: str) -> float | None:
        """RMS of ln E of one estimate."""
        return rms(np.ravel([row[name][kind] for row in whole]))

    return {
        "patients": len(rows),
        "converged": len(whole),
        "one pair": error("one", "joint"),
        "every pair alone": error("four", "alone"),
        "four pairs": error("four", "joint"),
        "robust mean of four": error("four", "robust"),
        "robust mean, one of four spoilt": error("spoilt", "robust"),
        "joint, one of four spoilt": error("spoilt", "joint"),
        "spoilt pair named": mean([row["spoilt"]["named"][-1] for row in whole]),
        "good pair named": mean(np.ravel([row["four"]["named"] for row in whole])),
    }


if __name__ == "__main__":
    raise SystemExit(main())
