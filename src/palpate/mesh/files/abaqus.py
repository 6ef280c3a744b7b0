"""Meshes of Abaqus and CalculiX, .inp: elements with element sets, node sets and surfaces."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

import numpy as np

from palpate.errors import InputDataError
from palpate.mesh.files.elements import CORNERS, Block, Elements, Numbers

SOLID = re.compile(r"(?:A|DC?|Q|CO)?C?3D(\d+)")
SOLIDS = {4: "tetra", 6: "wedge", 8: "hexahedron", 10: "tetra10", 15: "wedge15", 20: "hexahedron20"}
SHELL = re.compile(r"(?:CPS|CPE|M3D|R3D|SFM3D|S|STRI|DS)(?:(3)|65?)(?!D|\d)")
HOLLOW = re.compile(
    r"CP|CG?AX|M3D|[RF][23]D|RAX|SFM|S[3-9]|STRI|DS|[TB][23]|PIPE|ELBOW|SPRING|DASH|MASS|ROT|CONN|GAP|D$|DCOUP"
)
FACES = {"S1": [1, 2, 3], "S2": [1, 4, 2], "S3": [2, 4, 3], "S4": [3, 4, 1]}
MADE = ("INCLUDE", "SYSTEM", "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "PARAMETER")
MOST_MEMBERS = 10**7
FLAT = "write one part, all of whose nodes and elements are listed"
NONE = np.zeros(0, dtype=np.int64)
Options = dict[str, str]
Table = tuple[str, Numbers]
Rows = list[list[str]]


class _Sets(dict[str, Numbers]):
    """Numbers by the name of their set, in capitals, for the case of letters does not count."""

    def add(self, name: str | None, numbers: Numbers) -> None:
        """Some members, where there is a name."""
        if name is not None:
            self[name.upper()] = np.union1d(self.get(name.upper(), NONE), numbers)

    def listed(self, rows: Rows) -> Numbers:
        """The members that rows list, by number or by set."""
        words = [word.upper() for row in rows for word in row]
        if unknown := [word for word in words if word not in self and not word.isdecimal()]:
            raise InputDataError(f"it names a set '{unknown[0][:80]}' that it does not define")
        return np.concatenate([NONE, *(self[word] if word in self else np.array([int(word)]) for word in words)])


def read_abaqus(content: bytes, _: str | None) -> Elements:
    """Elements with their sets and surfaces; raises `InputDataError` for what is none, or is not listed in it."""
    nodes, points, tables, surfaces = list[int](), list[list[str]](), list[Table](), list[tuple[str, Numbers]]()
    known, n_parts = {"NSET": _Sets(), "ELSET": _Sets()}, 0
    for keyword, options, rows in _keywords(content.decode(errors="replace")):
        n_parts += keyword == "PART"
        moved = (keyword == "INSTANCE" and rows) or (keyword == "NODE" and "SYSTEM" in options)
        if keyword in MADE or n_parts > 1 or moved:
            raise InputDataError(f"it places nodes or elements by *{keyword}, which is not supported: {FLAT}")
        if keyword == "NODE":
            nodes += (own := [int(row[0]) for row in rows])
            points += [[*row[1:], "0", "0", "0"][:3] for row in rows]
            known["NSET"].add(options.get("NSET"), np.array(own, dtype=np.int64))
        elif keyword == "ELEMENT":
            tables.append(_table(options.get("TYPE", "").upper(), rows))
            known["ELSET"].add(options.get("ELSET"), tables[-1][1][:, 0])
        elif keyword in known:
            numbers = _generated(rows) if "GENERATE" in options else known[keyword].listed(rows)
            known[keyword].add(options.get(keyword), numbers)
        elif keyword == "SURFACE":
            name, listed = options.get("NAME", "").upper(), [row[:1] for row in rows]
            if options.get("TYPE", "").upper() == "NODE":
                known["NSET"].add(name, known["NSET"].listed(listed))
            else:
                surfaces += [(name, faces) for faces in _faces(rows, known["ELSET"], tables)]
    numbers, at = np.concatenate([NONE, *(table[:, 0] for _, table in tables)]), {n: at for at, n in enumerate(nodes)}
    if len(at) < len(nodes) or len(np.unique(numbers)) < len(numbers):
        raise InputDataError(f"two nodes or two elements have the same number; {FLAT}")
    placed = np.vectorize(lambda number: at.get(number, -1), otypes=[np.int64])
    cells = [(kind, table[:, 0], placed(table[:, 1:])) for kind, table in tables]
    blocks: list[Block] = [(kind, rows, ()) for kind, _, rows in cells]
    for name, members in known["ELSET"].items():
        blocks += [(kind, rows[np.isin(number, members)], [name]) for kind, number, rows in cells if kind in CORNERS]
    blocks += [("triangle", placed(faces), [name]) for name, faces in surfaces]
    blocks += [("node", placed(np.intersect1d(of, nodes))[:, None], [name]) for name, of in known["NSET"].items()]
    return Elements(np.array(points, dtype=float), blocks)


def _generated(rows: Rows) -> Numbers:
    """The members that rows give as first, last and step."""
    steps = [range(first, last + 1, step) for first, last, step in ([*map(int, row), 1][:3] for row in rows)]
    if sum(map(len, steps)) > MOST_MEMBERS:
        raise InputDataError(f"a set of over {MOST_MEMBERS:.0e} members is generated; correct its last number")
    return np.concatenate([NONE, *map(np.array, steps)]).astype(np.int64)


def _faces(rows: Rows, sets: _Sets, tables: Sequence[Table]) -> Iterator[Numbers]:
    """The faces (n, 3) of a surface, by their nodes' numbers: rows of a set or an element, and the face's name."""
    tets = [table[:, :5] for kind, table in tables if kind.startswith("tetra")]
    for face, corners in FACES.items():
        wanted = sets.listed([row[:1] for row in rows if row[-1].upper() == face])
        yield from (table[np.isin(table[:, 0], wanted)][:, corners] for table in tets)


def _keywords(text: str) -> Iterator[tuple[str, Options, Rows]]:
    """Keyword, options and rows of words, one after the other; comments are left out."""
    text = re.sub(r"(?m)^[ \t]*\*\*.*$", "", text.replace("\r\n", "\n"))
    for block in re.split(r"(?m)^[ \t]*\*", text)[1:]:
        head, *lines = re.sub(r"\A([^\n]*,)[ \t]*\n", r"\1", block).split("\n")
        keyword, *options = (word.strip() for word in head.split(","))
        pairs = (option.partition("=") for option in options)
        rows = [[word.strip().strip('"') for word in line.split(",") if word.strip()] for line in lines]
        yield keyword.upper(), {k.strip().upper(): v.strip().strip('"') for k, _, v in pairs}, [r for r in rows if r]


def _table(name: str, rows: Rows) -> tuple[str, Numbers]:
    """Kind, and number and nodes (n, 1 + n_nodes) of elements of a type; nothing of what fills nothing."""
    if solid := SOLID.match(name):
        kind, n = SOLIDS.get(int(solid[1]), f"volume of {solid[1]} nodes"), int(solid[1])
    elif shell := SHELL.match(name):
        kind, n = ("triangle", 3) if shell[1] else ("triangle6", 6)
    elif HOLLOW.match(name):
        kind, n, rows = "line", 0, []
    else:
        raise InputDataError(f"its elements of the type '{name[:80]}' are not supported; remove them")
    words = [int(word) for row in rows for word in row]
    if len(words) % (1 + n):
        raise InputDataError(f"its elements of the type '{name[:80]}' do not have {n} nodes each; export it again")
    return kind, np.array(words, dtype=np.int64).reshape(-1, 1 + n)
