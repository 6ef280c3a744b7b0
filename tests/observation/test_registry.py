"""A registered kind of observation is seen by every case, each later image's own."""

from __future__ import annotations

from types import SimpleNamespace

from palpate.observation import observations


def test_every_registered_kind_is_seen_in_every_later_image():
    two_images = SimpleNamespace(after=("one", "two"))
    kinds = (
        lambda imaged: tuple((f"surface in {image}",) for image in imaged.after),
        lambda imaged: tuple((f"point in {image}", f"another in {image}") for image in imaged.after),
    )
    seen = observations(two_images, kinds)
    assert seen == tuple((f"surface in {i}", f"point in {i}", f"another in {i}") for i in two_images.after)
