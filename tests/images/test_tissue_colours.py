"""Colours of tissues: the user's own where they can be seen, else ours, and never the same twice for organs."""

from __future__ import annotations

import pytest

from palpate.images.tissue import Role, Tissue, tissue_colours


def tissue(colour):
    return Tissue("a", Role.ESTIMATE, (1,), colour=colour)


def test_a_tissues_own_colour_is_kept():
    assert tissue_colours((tissue("#12AB9f"),)) == ("#12ab9f",)


@pytest.mark.parametrize("colour", [None, "#000000", "#0a0f20"])
def test_what_cannot_be_seen_is_replaced(colour):
    assert tissue_colours((tissue(colour),)) == ("#e69f00",)


def test_organs_without_colours_differ():
    tissues = tuple(Tissue(str(i), Role.ESTIMATE, (i,)) for i in range(1, 8))
    assert len(set(tissue_colours(tissues))) == 7
