"""The classes of TotalSegmentator's tasks `total` (version 2, CT) and `total_mr`: facts, from its table `class_map`.

https://github.com/wasserth/TotalSegmentator, totalsegmentator/map_to_binary.py. A class's number is its place in the
list, from 1. No class of either task is the rectum.
"""

from __future__ import annotations

from collections.abc import Mapping


def _sides(names: str, sides: tuple[str, str] = ("left", "right")) -> list[str]:
    return [f"{name}_{side}" for name in names.split() for side in sides]


_SOLID = ("right", "left")
_ABDOMEN = ["spleen", *_sides("kidney", _SOLID), *["gallbladder", "liver", "stomach", "pancreas"]]
_ABDOMEN += _sides("adrenal_gland", _SOLID)
_GUT = ["small_bowel", "duodenum", "colon", "urinary_bladder", "prostate"]
_LIMBS = _sides("humerus scapula clavicula femur hip")
_MUSCLES = _sides("gluteus_maximus gluteus_medius gluteus_minimus autochthon iliopsoas")

_TOTAL = [
    *_ABDOMEN,
    *["lung_upper_lobe_left", "lung_lower_lobe_left"],
    *["lung_upper_lobe_right", "lung_middle_lobe_right", "lung_lower_lobe_right"],
    *["esophagus", "trachea", "thyroid_gland"],
    *_GUT,
    *_sides("kidney_cyst"),
    *["sacrum", "vertebrae_S1"],
    *(f"vertebrae_{part}{n}" for part, most in (("L", 5), ("T", 12), ("C", 7)) for n in range(most, 0, -1)),
    *["heart", "aorta", "pulmonary_vein", "brachiocephalic_trunk"],
    *_sides("subclavian_artery common_carotid_artery", _SOLID),
    *_sides("brachiocephalic_vein"),
    *["atrial_appendage_left", "superior_vena_cava", "inferior_vena_cava", "portal_vein_and_splenic_vein"],
    *_sides("iliac_artery iliac_vena"),
    *_LIMBS,
    "spinal_cord",
    *_MUSCLES,
    *["brain", "skull"],
    *(f"rib_{side}_{n}" for side in ("left", "right") for n in range(1, 13)),
    *["sternum", "costal_cartilages"],
]

_TOTAL_MR = [
    *_ABDOMEN,
    *_sides("lung"),
    "esophagus",
    *_GUT,
    *["sacrum", "vertebrae", "intervertebral_discs", "spinal_cord"],
    *["heart", "aorta", "inferior_vena_cava", "portal_vein_and_splenic_vein"],
    *_sides("iliac_artery iliac_vena"),
    *_LIMBS,
    *_MUSCLES,
    "brain",
]

CLASSES: Mapping[str, Mapping[str, int]] = {
    task: {name: number for number, name in enumerate(names, start=1)}
    for task, names in (("total", _TOTAL), ("total_mr", _TOTAL_MR))
}
