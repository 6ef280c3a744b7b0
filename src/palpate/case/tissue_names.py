"""Words in the names of tissues, however a program or a person spells them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache

SPELLINGS = (
    ("tumor", "tumour"),
    ("esophag", "oesophag"),
    ("edema", "oedema"),
    ("gray", "grey"),
    ("hematoma", "haematoma"),
)
LEAST_PLURAL = 4  # letters of a word whose final s is not counted


@lru_cache(maxsize=4096)
def plain_name(name: str) -> str:
    """The words of a name in one spelling, each between two underscores: "_kidney_" of "Kidneys" or "kidney 2"."""
    parts = re.sub(r"[^a-z]+", " ", re.sub(r"([a-z])([A-Z])", r"\1 \2", name).lower()).split()
    return f"_{'_'.join(map(_spelt, parts))}_"


def _spelt(word: str) -> str:
    for american, british in SPELLINGS:
        if word.startswith(american):
            word = british + word.removeprefix(american)
    plural = len(word) >= LEAST_PLURAL and word.endswith("s") and not word.endswith("ss")
    return word.removesuffix("s") if plural else word


def found_word(name: str, words: Iterable[str]) -> str:
    """The first of `words` (parts of a phrase joined by "_") that a name has, as it is written there; "" for none."""
    plain = plain_name(name)
    return next((word for word in words if plain_name(word) in plain), "")
