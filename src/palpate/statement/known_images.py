"""What an estimate leaves in its folder, so that later images can be added to it without the first ones."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from palpate.case.case import Case
from palpate.errors import ConfigurationError
from palpate.inversion import EarlierImages, InverseProblem, InversionSettings
from palpate.mesh.tet_mesh import TetMesh

FORMAT = "palpate.known-images/1"
LEAST = 2  # later images from which the drawing of the reference image is an unknown, which later ones share
ALIKE = 1e-6  # relative difference of the marks of the same modes


@dataclass(frozen=True, slots=True)
class KnownImages:
    """What the later images of an estimate tell, and of which body: the mesh's SHA-256, tissues, and law.

    tissues: names of the log-moduli; relative_to: that of the tissue that sets the scale; marks (n,): a sum over each
    mode of tissues and of the reference's drawing, which tells whether modes are made as they were.
    """

    images: EarlierImages
    mesh: str
    tissues: tuple[str, ...]
    relative_to: str
    law: str
    marks: NDArray[np.float64]

    @classmethod
    def of(cls, images: EarlierImages, problem: InverseProblem, case: Case) -> KnownImages:
        """Of the images of a problem, as the case has it."""
        parameters, mesh = problem.parameters, problem.states[0].model.space.mesh
        own = parameters.tissues, parameters.relative_to, case.mechanics.law
        return cls(images, digest_of(mesh), *own, _marks(problem))

    def problem_with(self, problem: InverseProblem, case: Case) -> InverseProblem:
        """The problem of further images, in which these count; raises `ConfigurationError` where it is another's."""
        here = KnownImages.of(self.images, problem, case)
        pairs = (
            ("the mesh", self.mesh[:12], here.mesh[:12]),
            ("the tissues", ", ".join(self.tissues), ", ".join(here.tissues)),
            ("the tissue that sets the scale", self.relative_to, here.relative_to),
            ("the law", self.law, here.law),
        )
        for what, there, now in pairs:
            if there != now:
                raise ConfigurationError(
                    f"{what} of the earlier estimate differs: '{there}' there, '{now}' here; {TOGETHER}"
                )
        found = self.images.known_in(problem)
        largest = float(np.abs(self.marks).max(initial=0.0))
        if self.marks.shape != here.marks.shape or np.abs(self.marks - here.marks).max(initial=0.0) > ALIKE * largest:
            raise ConfigurationError(
                f"the {len(self.marks)} modes of tissues and drawing come out otherwise than in the earlier estimate,"
                f" by other libraries or on another machine; {TOGETHER}"
            )
        return found


TOGETHER = "estimate all images together: name them in [images] after, and run `palpate estimate` without --add"


@dataclass(frozen=True, slots=True)
class BuiltOn:
    """The result that an estimate builds on: `images` later images, by the SHA-256 of its numbers, its seal.

    case: with all later images, those added among them; inputs: SHA-256 of the earlier result's files, by their keys.
    """

    images: int
    folder: str
    seal: str
    case: Case
    inputs: Mapping[str, str]

    def every_input(self, own: Mapping[str, str]) -> dict[str, str]:
        """The digests of all files by their keys in the case with all images; own: those of the added images' case."""
        later = {key: digest for key, digest in own.items() if key.startswith("after[")}
        moved = {
            f"after[{int(key[6:].split(']')[0]) + self.images}]{key.split(']', 1)[1]}": of for key, of in later.items()
        }
        return {**self.inputs, **{key: of for key, of in own.items() if key not in later}, **moved}

    def to_dict(self) -> dict[str, object]:
        """What result.json says."""
        return {"images": self.images, "folder": self.folder, "seal": self.seal}

    def sentence(self, added: int) -> str:
        """What must stand wherever the numbers do."""
        what = "One later image was" if added == 1 else f"{added} later images were"
        return (
            f"{what} added to an earlier estimate: what its {self.images} later images tell counts as a normal law, and"
            " they are not looked at again."
        )

    def refuse_other_images(self, inputs: Mapping[str, str]) -> None:
        """Raise `ConfigurationError` where the reference image is another one, or an added one is there already."""
        before, known = ({k: v for k, v in of.items() if k.startswith("before")} for of in (inputs, self.inputs))
        if before != known:
            raise ConfigurationError(
                f"the reference image is not that of the result in '{self.folder}' (its SHA-256 differs); {TOGETHER}"
            )
        there = {v: k for k, v in self.inputs.items() if k.startswith("after[")}
        twice = [(k, there[v]) for k, v in inputs.items() if k.startswith("after[") and v in there]
        if twice:
            raise ConfigurationError(
                f"the added image '{self.case.images.after[self.images].name if self.case.images else twice[0][0]}' is"
                f" the {twice[0][1]} of the result in '{self.folder}' already; it would count twice"
            )


@dataclass(frozen=True, slots=True)
class Added:
    """What an estimate of added images is given of the earlier one: what that knows, its mesh, and where it is from."""

    known: KnownImages
    mesh: TetMesh
    built_on: BuiltOn

    def settings(self, settings: InversionSettings) -> InversionSettings:
        """Those of an estimate that begins where the earlier one has ended."""
        bounds = settings.bounds
        begin = np.clip(self.known.images.theta, bounds.lower, bounds.upper)
        return replace(settings, starts=(begin,), further=settings.every_start)


def why_together(case: Case, n_images: int) -> str:
    """Why images of a case with so many earlier later ones are estimated together; empty where they may be added."""
    if n_images < LEAST:
        return "the earlier estimate has one later image, which does not tell how the reference image is drawn"
    if case.pairs:
        return "the case has [[pairs]], whose other reference images have unknowns of their own"
    if case.estimate.seeks_poisson_ratios:
        return "Poisson's ratios are sought, for which models are made anew"
    if case.data or any(load.state is not None for load in case.loads):
        return "the case has [[data]] or [[loads]] of some of its states"
    return ""


def added_name(images: Sequence[Path]) -> str:
    """The folder of an estimate with added images, in that of the earlier one."""
    name = images[0].name.split(".")[0] or "image"
    plain = "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in name)[:60]
    return f"added-{plain}" + (f"-and-{len(images) - 1}-more" if len(images) > 1 else "")


def digest_of(mesh: TetMesh) -> str:
    """SHA-256 (hexadecimal) of the nodes, tetrahedra, regions and outer faces of a mesh."""
    found = hashlib.sha256()
    for array in (mesh.nodes, mesh.tets, mesh.region, mesh.boundary, mesh.beyond):
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def _marks(problem: InverseProblem) -> NDArray[np.float64]:
    state = problem.states[0]
    fields = state.model.material.fields
    marks = [fields.T @ np.cos(np.arange(fields.shape[0]))]
    marks += [modes.T @ np.cos(np.arange(len(modes))) for modes in state.at_rest.values()]
    return np.concatenate([np.asarray(of, dtype=np.float64) for of in marks])
