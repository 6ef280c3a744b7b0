"""What a run says while it works: sentences, of which each may tell its stage, and one what all stages will take."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, get_args

Progress = Callable[[str], None]  # is called with a sentence
Stage = Literal["reading", "meshing", "linear law", "finite strain", "intervals", "report"]
STAGES: tuple[Stage, ...] = get_args(Stage)


def silent(sentence: str) -> None:
    """A listener that says nothing."""
    del sentence


class Told(str):
    """A sentence that is said during a stage."""

    __slots__ = ("stage",)

    def __new__(cls, sentence: str, stage: Stage) -> Told:
        """The sentence with its stage."""
        made = super().__new__(cls, sentence)
        made.stage = stage
        return made

    stage: Stage


class Forecast(str):
    """A sentence on what a run will take; `seconds`: what is expected of each stage, in their order."""

    __slots__ = ("seconds",)

    def __new__(cls, sentence: str, seconds: Mapping[Stage, float]) -> Forecast:
        """The sentence with its seconds."""
        forecast = super().__new__(cls, sentence)
        forecast.seconds = dict(seconds)
        return forecast

    seconds: dict[Stage, float]


def during(stage: Stage, progress: Progress) -> Progress:
    """Sentences told during a stage; those that tell one of their own, within it, keep that."""

    def tell(sentence: str) -> None:
        """Hand the sentence on."""
        progress(sentence if isinstance(sentence, Told | Forecast) else Told(sentence, stage))

    return tell


def about(seconds: float) -> str:
    """A length of time in plain words, as somebody who waits wants to know it."""
    if seconds < 15.0:
        return "a few seconds"
    if seconds < 45.0:
        return "half a minute"
    if seconds < 90.0:
        return "a minute"
    minutes = round(seconds / 60.0)
    return f"{minutes} minutes" if minutes < 90 else f"{seconds / 3600.0:.1f} hours"
