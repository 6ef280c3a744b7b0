"""The kinds of observations that are made of images; a new one is registered by a line here."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain

from palpate.observation.contract import ImagedBody, Observation
from palpate.observation.surface_distance import surface_distances

__all__ = ["KINDS", "observations"]

KINDS: tuple[Callable[[ImagedBody], tuple[tuple[Observation, ...], ...]], ...] = (surface_distances,)


def observations(imaged: ImagedBody) -> tuple[tuple[Observation, ...], ...]:
    """What each later image shows, kind after kind."""
    return tuple(tuple(chain(*of_image)) for of_image in zip(*(made(imaged) for made in KINDS), strict=True))
