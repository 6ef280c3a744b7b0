"""Label tables: every way to write one table gives it, and a sentence for each that is none."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from palpate.errors import InputDataError
from palpate.images.label_image import LabelImage, VoxelGrid
from palpate.images.label_table import read_label_table, slicer_table
from palpate.images.named_labels import NamedLabel
from palpate.images.readers import read_label_image, write_label_image


@pytest.mark.parametrize(
    "text",
    [
        '{"labels": {"2": "bladder", "1": "prostate"}, "volumes_mL": {"prostate": 14.8}}',
        '{"1": "prostate", "2": "bladder"}',
        '{"bladder": 2, "prostate": 1}',
        '\ufeff{"1": " prostate ", "2": "bladder"}',
        '{"labels": {"bladder": [2], "prostate": 1}, "regions_class_order": [2, 1]}',
        '{"network": {"outputs": {"pred": {"type": "image", "channel_def": {"1": "prostate", "2": "bladder"}}}}}',
        '{"1": "prostate", "bladder": 2, "prostate": 1}',
    ],
)
def test_every_spelling_gives_the_same_table(tmp_path: Path, text: str) -> None:
    path = tmp_path / "labels.json"
    path.write_text(text, encoding="utf-8")
    assert list(read_label_table(path).items()) == [(1, "prostate"), (2, "bladder")]


TABLES = {
    "snap.txt": '# IDX R G B A VIS MSH "LABEL"\n1 255 0 128 1 1 1 "left hip"\n 2  0  255  0  0.5  1 0  "bladder"\n',
    "snap.label": '1 255 0 128 1 1 1 "left hip"\n2 0 255 0 0.5 1 0 "bladder"\n',
    "slicer.csv": "LabelValue,Name,Color_R,Color_G,Color_B,Color_A\n2,bladder,0,255,0,255\n1,left hip,255,0,128,255\n",
    "terms.csv": "Name,LabelValue,Color_R,Color_G,Color_B,Type_CodeMeaning\r\n"
    '"left hip",1,255,0,128,"Bone, hip"\r\n"bladder",2,0,255,0,\r\n',
    "lines.ctbl": "# Color table file\r\n# 2 values\r\n1 left hip 255 0 128 255 whatever\r\n2 bladder 0 255 0 255\r\n",
    "terms_of_type.csv": "LabelValue;Name;Color_R;Color_G;Color_B\n1;left hip;255;0;128\n2;bladder;0;255;0\n",
    "more.label": '\ufeff1\t255\t0\t128\t1\t1\t1\t0 0.5 "left hip" x\r\n'
    '2 0 255 0 "bladder"\r\n2 0 255 0 1 1 1 "bladder"\r\n',
    "sub-1_dseg.tsv": "index\tname\tabbreviation\tcolor\n1\tleft hip\tH\t#FF0080\n2\tbladder\tB\t#00ff00\n",
}


@pytest.mark.parametrize("name", TABLES)
def test_every_format_gives_names_and_colours(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(TABLES[name], encoding="utf-8")
    table = read_label_table(tmp_path / name)
    assert dict(table) == {1: "left hip", 2: "bladder"}
    assert table.colours == {1: "#ff0080", 2: "#00ff00"}


@pytest.mark.parametrize("name", ["slicer.ctbl", "lut.txt"])
def test_a_colour_table_keeps_its_names_as_they_stand_there(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("# Color table file\n1 left_hip 255 0 128 255\n2 bladder 0 255 0 0\n")
    table = read_label_table(tmp_path / name)
    assert dict(table) == {1: "left_hip", 2: "bladder"}
    assert table.colours == {1: "#ff0080", 2: "#00ff00"}


@pytest.mark.parametrize(
    ("labels", "order", "names", "words"),
    [
        (
            '"background": 0, "gland": [1, 3], "rectum": 2',
            "[1, 2]",
            {0: "background", 2: "rectum"},
            "[1, 3], in a prediction [1]",
        ),
        (
            '"background": 0, "kidney": [1, 2, 3], "tumour": 2',
            "[1, 2]",
            {0: "background", 2: "tumour"},
            "in a prediction [1, 2]",
        ),
        (
            '"whole": [1, 2, 3], "core": [2, 3], "live": 3',
            "[1, 2, 3]",
            {3: "live"},
            "'whole' ([1, 2, 3]), 'core' ([2, 3]).",
        ),
        (
            '"a": [1, 2], "b": 3, "c": 4',
            "[1, 2, 4]",
            {4: "c"},
            "'a' ([1, 2], in a prediction [1]), 'b' ([3], in a prediction [2])",
        ),
        ('"a": [1, 2], "b": 3', '"x"', {3: "b"}, "'a' ([1, 2])."),
    ],
)
def test_regions_are_left_out_and_told_with_what_to_write(tmp_path: Path, labels, order, names, words) -> None:
    path = tmp_path / "dataset.json"
    path.write_text(f'{{"labels": {{{labels}}}, "regions_class_order": {order}}}')
    table = read_label_table(path)
    assert dict(table) == names
    (finding,) = table.findings
    assert finding.code == "names-left-out"
    assert words in finding.message
    image = LabelImage(np.zeros((2, 2, 2), np.uint8), VoxelGrid((2, 2, 2), np.eye(4)))
    write_label_image(tmp_path / "a.nii.gz", image)
    assert read_label_image(tmp_path / "a.nii.gz", names=table).findings == table.findings
    path.write_text('{"labels": {"gland": [1, 3]}}')
    with pytest.raises(InputDataError, match=r"names no label.*'gland' \(\[1, 3\]\)\. Write the numbers"):
        read_label_table(path)


def test_a_table_without_colours_or_with_impossible_ones_has_none(tmp_path: Path) -> None:
    texts = {
        "a.tsv": "index\tname\tcolor\n1\tbladder\tn/a\n",
        "b.tsv": "name\tindex\nbladder\t1\n",
        "c.csv": "LabelValue,Name\n1,bladder\n",
        "d.csv": "LabelValue,Name,Color_R,Color_G,Color_B\n1,bladder,999,0,0\n",
        "e.json": '{"bladder": 1}',
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        table = read_label_table(tmp_path / name)
        assert dict(table) == {1: "bladder"}
        assert table.colours == {}


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.json", b"", "not JSON"),
        ("a.json", b"{", "not JSON"),
        ("a.json", b"[" * 100_000, "not JSON"),
        ("a.json", b"[1, 2]", "names no label"),
        ("a.json", b"{}", "names no label"),
        ("a.json", b'{"1": "a", "1": "b"}', "twice"),
        ("a.json", b'{"1": "a", "2": "a"}', "twice"),
        ("a.json", b'{"-1": "a"}', "from 0"),
        ("a.json", b'{"70000": "a"}', "from 0"),
        ("a.json", b'{"a": "b"}', "from 0"),
        ("a.json", b'{"1": ""}', "characters"),
        ("a.json", b'{"1": {"name": "a"}}', "characters"),
        ("a.json", b'{"1": "a\\u001b[31m"}', "control characters"),
        ("a.json", b'{"1": "\xff"}', "UTF-8"),
        ("a.json", b'{"1": ' + b"9" * 5000 + b"}", "not JSON|from 0"),
        ("a.json", b" " * (2**20 + 1), "larger than"),
        ("a.txt", '1 255 0 0 1 1 1 "a"\n2 0 0 0\n', "line 2"),
        ("a.txt", "1,prostate\n", "line 1 .* not of the form"),
        ("a.txt", "", "names no label"),
        ("a.txt", "1 a" + " " * 2**19 + "b", "line 1 .* not of the form"),
        ("a.txt", '1 255 0 0 1 1 1 "a"\n1 0 255 0 1 1 1 "b"\n', "twice"),
        ("a.txt", '70000 255 0 0 1 1 1 "a"\n', "from 0"),
        ("a.txt", '1 255 0 0 1 1 1 "a\x1b[2J"\n', "control characters"),
        ("a.ctbl", "1 left hip 255 0\n", "line 1 .* not of the form"),
        ("a.ctbl", "1 hip 255 0 0 255\n2 left hip 255 x 0 255\n", "line 2"),
        ("a.csv", "a,b\n1,2\n", "lacks the columns"),
        ("a.csv", "LabelValue,Name\nx,bladder\n", "whole number"),
        ("a.csv", "LabelValue,Name\n1\n", "characters"),
        ("a.csv", 'LabelValue,Name\n1,"' + "x" * 200_000 + '"\n', "damaged"),
        ("a.csv", "LabelValue,Name\n", "names no label"),
        ("a.tsv", "index\tlabel\n1\ta\n", "lacks the columns"),
        ("a.tsv", "index\tname\n-1\ta\n", "whole number"),
        ("a.tsv", "index name\n1 a\n", "lacks the columns"),
    ],
)
def test_a_bad_table_is_refused_with_its_reason(tmp_path: Path, name: str, content: str | bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputDataError, match=words) as caught:
        read_label_table(tmp_path / name)
    assert str(tmp_path / name) in str(caught.value)
    assert str(caught.value).isprintable()


def test_a_written_colour_table_is_read_back_and_computes_nothing_in_a_spreadsheet(tmp_path: Path) -> None:
    rows = [
        NamedLabel(1, "=HYPERLINK(1)", "#ff0080"),
        NamedLabel(2, 'left "hip", lower', None),
        NamedLabel(3, "-x", "#000000"),
        NamedLabel(4, "'quoted'"),
    ]
    path = tmp_path / "labels.csv"
    path.write_text(slicer_table(rows), encoding="utf-8")
    table = read_label_table(path)
    assert dict(table) == {row.label: row.name for row in rows}
    assert table.colours == {1: "#ff0080", 3: "#000000"}
    assert not any(
        cell.startswith(("=", "+", "-", "@")) for row in csv.reader(path.read_text().splitlines()) for cell in row
    )


def test_a_missing_table_or_an_unknown_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputDataError, match="cannot be read"):
        read_label_table(tmp_path / "labels.json")
    with pytest.raises(InputDataError, match=r"\.json"):
        read_label_table(tmp_path / "labels.doc")
