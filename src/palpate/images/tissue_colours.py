"""One colour a tissue, the same in every figure and table."""

from __future__ import annotations

import re
from collections import Counter

from palpate.images.tissue import Role, Tissue

__all__ = ["tissue_colours"]

# They stay apart on black, on white and for the colour-blind; after Okabe & Ito, "Color Universal Design" (2008).
ORGANS = ("#e69f00", "#56b4e9", "#cc79a7", "#2ba888", "#d55e00", "#8f8ff0", "#c5b800")
KNOWN = ("#6d7278", "#85786c", "#6c8075", "#7b6f85")
RIGID = "#cfc8b8"
VOID = "#303438"
DARKEST = 64  # of the brightest channel of a tissue's own colour


def tissue_colours(tissues: tuple[Tissue, ...]) -> tuple[str, ...]:
    """A colour (#rrggbb) for each tissue: its own, or one of ours, bright for estimated ones and drivers.

    A colour of its own that is almost black, and could not be seen on an image, is replaced by one of ours.
    """
    fixed = {Role.RIGID: (RIGID,), Role.VOID: (VOID,), Role.KNOWN: KNOWN}
    ranked = sorted(range(len(tissues)), key=lambda i: (tissues[i].role is not Role.ESTIMATE, i))
    colours = [""] * len(tissues)
    used: Counter[Role] = Counter()
    for i in ranked:
        role = Role.ESTIMATE if tissues[i].role is Role.DRIVER else tissues[i].role
        palette = fixed.get(role, ORGANS)
        own = tissues[i].colour or ""
        seen = re.fullmatch("#[0-9a-fA-F]{6}", own) and max(bytes.fromhex(own[1:])) >= DARKEST
        colours[i] = own.lower() if seen else palette[used[role] % len(palette)]
        used[role] += 1
    return tuple(colours)
