"""Parts of an experiment that any process can import: each doubles its key."""

from __future__ import annotations

import os

from palpate.errors import GeometryError


def doubled(key, progress):
    progress(f"doubling {key}")
    if key == "bad":
        raise GeometryError("this one cannot be doubled")
    if key == "dead":
        os._exit(3)
    return {"x": 2 * int(key)}
