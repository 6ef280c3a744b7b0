"""The classes of TotalSegmentator's tasks `total` (version 2, CT) and `total_mr`: facts, from its table `class_map`.

https://github.com/wasserth/TotalSegmentator, totalsegmentator/map_to_binary.py. A class's number is its place in the
list of totalsegmentator.json, from 1. No class of either task is the rectum.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import resources

FILE = resources.files("palpate.images") / "totalsegmentator.json"
CLASSES: Mapping[str, Mapping[str, int]] = {
    task: {name: number for number, name in enumerate(names, start=1)}
    for task, names in json.loads(FILE.read_text(encoding="utf-8")).items()
}
