"""Label names in a NIfTI header extension: names and colours are kept, nothing else is, and no entity is expanded."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import nibabel
import numpy as np
import pytest

from palpate.errors import InputDataError
from palpate.images import readers
from palpate.images.label_image import LabelImage

read_label_image = partial(readers.read_label_image, limits=None)

HEAD = '<?xml version="1.0" encoding="UTF-8"?> <CaretExtension>  <Date><![CDATA[2013-07-14T05:45:09]]></Date>'
HEAD += '   <VolumeInformation Index="0">   <LabelTable>\n'
TAIL = "  </LabelTable>  <VolumeType><![CDATA[Label]]></VolumeType>   </VolumeInformation></CaretExtension>\n     "
ROWS = (
    '<Label Key="21" Red="0.0" Green="0.5019607843137255" Blue="1.0" Alpha="1"><![CDATA[urinary_bladder]]></Label>\n'
    '<Label Key="22" Red="1.0" Green="2.0" Blue="0" Alpha="1"><![CDATA[prostate]]></Label>\n'
    '<Label Key="300"><![CDATA[Blase < ü]]></Label>\n'
)


def saved(path: Path, *extensions: tuple[int, bytes], kind: type = nibabel.Nifti1Image) -> Path:
    values = np.zeros((4, 5, 6), dtype=np.uint8)
    values[:2], values[2:3] = 21, 22
    image = kind(values, np.eye(4))
    for code, content in extensions:
        image.header.extensions.append(nibabel.nifti1.Nifti1Extension(code, content))
    nibabel.save(image, path)
    return path


def read_table(tmp_path: Path, text: str) -> LabelImage:
    return read_label_image(saved(tmp_path / "a.nii.gz", (0, text.encode())))


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
def test_names_and_colours_are_kept(tmp_path: Path, name: str, kind: type) -> None:
    others = ((6, b"a comment"), (0, b"no table"))
    path = saved(tmp_path / name, *others, (0, (HEAD + ROWS + TAIL).encode() + b"\0" * 70), kind=kind)
    for image in (read_label_image(path), readers.read_label_image(path)):
        assert image.names == {21: "urinary_bladder", 22: "prostate", 300: "Blase < ü"}
        assert image.colours == {21: "#0080ff"}  # a colour beyond 1 is none
        assert np.count_nonzero(image.labels == 21) == 60


def test_names_in_the_header_go_before_those_of_a_table(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.nii", (0, (HEAD + ROWS + TAIL).encode()))
    assert read_label_image(path, names={21: "other"}).names[21] == "urinary_bladder"
    assert read_label_image(saved(tmp_path / "b.nii", (6, b"x")), names={21: "other"}).names == {21: "other"}


def test_a_big_endian_header_is_read(tmp_path: Path) -> None:
    content = (HEAD + ROWS + TAIL).encode()
    header = nibabel.Nifti1Header(endianness=">")
    image = nibabel.Nifti1Image(np.zeros((2, 2, 2), dtype=">i2"), np.eye(4), header)
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, content))
    nibabel.save(image, tmp_path / "a.nii")
    assert read_label_image(tmp_path / "a.nii").names[22] == "prostate"


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
FLAWS = {
    "a document type": (BOMB + HEAD[38:] + ROWS.replace("prostate", "x") + TAIL, "declare a document type"),
    "an external entity": (
        '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/hostname">]>' + HEAD[38:] + "<Label>&a;</Label>" + TAIL,
        "declare a document type",
    ),
    "an unknown entity": (HEAD + '<Label Key="1">&a;</Label>' + TAIL, "are no XML"),
    "no end": (HEAD + ROWS, "are no XML"),
    "no number": (HEAD + '<Label Key="1_0">x</Label>' + TAIL, "have the entry '1_0': 'x'"),
    "an endless name": (HEAD + f'<Label Key="1">{"x" * 201}</Label>' + TAIL, "have the entry '1'"),
    "a label twice": (HEAD + ROWS + ROWS.replace("prostate", "rectum") + TAIL, "twice"),
    "no name": (HEAD + '<Label Key="1"> </Label>' + TAIL, "a name of 1 to 200 characters"),
    "depth": (HEAD + "<a>" * 60 + "</a>" * 60 + TAIL, "nested deeper than 50"),
    "size": (HEAD + " " * 2**20 + TAIL, "hold 10.* bytes"),
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_table_that_cannot_be_is_refused(tmp_path: Path, flaw: str) -> None:
    text, words = FLAWS[flaw]
    with pytest.raises(InputDataError, match=words):
        read_table(tmp_path, text)


@pytest.mark.parametrize("size", [-8, 0, 7, 2**30])
def test_an_extension_of_a_size_that_cannot_be_is_passed_over(tmp_path: Path, size: int) -> None:
    path = saved(tmp_path / "a.nii", (0, (HEAD + ROWS + TAIL).encode()))
    content = bytearray(path.read_bytes())
    content[352:356] = size.to_bytes(4, "little", signed=True)
    path.write_bytes(content)
    assert read_label_image(path).names == {}


def test_control_characters_in_names_become_question_marks(tmp_path: Path) -> None:
    assert read_table(tmp_path, HEAD + '<Label Key="1">a\u202eb&#x85;c</Label>' + TAIL).names == {1: "a?b?c"}
