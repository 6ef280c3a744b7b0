"""What a run says while it works: lines for the person who waits, details for the log, and how long it will take.

Whatever is said is a text. A `Line` or a `Forecast` is for everybody; any other text is a detail, for the log.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

Progress = Callable[[str], None]  # is called with a sentence
Wanted = (
    Progress | Literal["auto"] | bool | None
)  # of a function in Python, see `palpate.steps.display.shown_in_python`
Stage = Literal["read", "mesh", "assemble", "search", "check the law", "intervals"]
STAGES: tuple[Stage, ...] = get_args(Stage)


def silent(sentence: str) -> None:
    """A listener that says nothing."""
    del sentence


class Told(str):
    """A detail that is said during a stage."""

    __slots__ = ("stage",)

    def __new__(cls, sentence: str, stage: Stage) -> Told:
        """The sentence with its stage."""
        made = super().__new__(cls, sentence)
        made.stage = stage
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        """How it is made in another process."""
        return Told, (str(self), self.stage)

    stage: Stage


class Line(str):
    """A sentence for the person who waits, in plain words; of a stage, whose name it then begins with."""

    __slots__ = ("stage",)

    def __new__(cls, sentence: str, stage: Stage | None = None) -> Line:
        """The sentence with its stage, if it has one."""
        made = super().__new__(cls, f"{stage}: {sentence}" if stage else sentence)
        made.stage = stage
        return made

    def __reduce__(self) -> tuple[Any, ...]:
        """How it is made in another process: the whole sentence, then its stage."""
        return Line, (str(self),), (None, {"stage": self.stage})

    stage: Stage | None


class Forecast(str):
    """A sentence on what a run will take; `seconds`: what is expected of each stage, in their order."""

    __slots__ = ("seconds",)

    def __new__(cls, sentence: str, seconds: Mapping[Stage, float]) -> Forecast:
        """The sentence with its seconds."""
        forecast = super().__new__(cls, sentence)
        forecast.seconds = dict(seconds)
        return forecast

    def __reduce__(self) -> tuple[Any, ...]:
        """How it is made in another process."""
        return Forecast, (str(self), self.seconds)

    seconds: dict[Stage, float]


def during(stage: Stage, progress: Progress) -> Progress:
    """What takes the details of a stage; lines, and details that tell their own stage, are handed on as they are."""

    def tell(sentence: str) -> None:
        """Hand the sentence on."""
        progress(sentence if isinstance(sentence, Told | Line | Forecast) else Told(sentence, stage))

    return tell


def details(progress: Progress) -> Progress:
    """What takes every sentence as a detail: those of one of many estimates, which nobody wants to read one by one."""

    def tell(sentence: str) -> None:
        """Hand the text on."""
        progress(str(sentence))

    return tell


def grouped(number: int) -> str:
    """A whole number with spaces between its thousands: 17 283."""
    return f"{number:,}".replace(",", " ")


def counted(number: int, noun: str) -> str:
    """A number with its noun: 1 image, 17 283 images."""
    return f"{grouped(number)} {noun}{'' if number == 1 else 's'}"


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
