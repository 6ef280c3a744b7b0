"""The works that the methods text cites: as a line below it, and as BibTeX."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

REPOSITORY = "https://github.com/palpate/palpate"


@dataclass(frozen=True, slots=True)
class Source:
    """A cited work: BibTeX's kind of entry, its authors (family name, then given names), its title and other fields.

    An author without a given name is a body, as "The Palpate developers".
    """

    kind: str
    authors: tuple[tuple[str, str], ...]
    title: str
    fields: Mapping[str, str]


SOURCES = {
    "palpate": Source(
        "software",
        (("The Palpate developers", ""),),
        "Palpate: elasticity of several organs at once from segmented images",
        {"url": REPOSITORY},
    ),
    "yang": Source(
        "misc",
        (("Yang", "Shan"), ("Lin", "Ming C.")),
        "Simultaneous Estimation of Elasticity for Multiple Deformable Bodies",
        {},
    ),
    "mmg": Source(
        "article",
        (("Dapogny", "C."), ("Dobrzynski", "C."), ("Frey", "P.")),
        "Three-dimensional adaptive domain remeshing, implicit domain meshing, and applications to free and moving"
        " boundary problems",
        {"journal": "Journal of Computational Physics", "volume": "262", "year": "2014", "pages": "358-378"},
    ),
    "kernel": Source(
        "article",
        (("Harbrecht", "H."), ("Peters", "M."), ("Schneider", "R.")),
        "On the low-rank approximation by the pivoted Cholesky decomposition",
        {"journal": "Applied Numerical Mathematics", "volume": "62", "year": "2012", "pages": "428-440"},
    ),
    "variation": Source(
        "article",
        (("Rudin", "L. I."), ("Osher", "S."), ("Fatemi", "E.")),
        "Nonlinear total variation based noise removal algorithms",
        {"journal": "Physica D", "volume": "60", "year": "1992", "pages": "259-268"},
    ),
    "huber": Source("book", (("Huber", "P. J."),), "Robust Statistics", {"publisher": "Wiley", "year": "1981"}),
    "nocedal": Source(
        "book",
        (("Nocedal", "J."), ("Wright", "S. J.")),
        "Numerical Optimization",
        {"edition": "2nd", "publisher": "Springer", "year": "2006"},
    ),
    "byrd": Source(
        "article",
        (("Byrd", "R. H."), ("Lu", "P."), ("Nocedal", "J."), ("Zhu", "C.")),
        "A limited memory algorithm for bound constrained optimization",
        {"journal": "SIAM Journal on Scientific Computing", "volume": "16", "year": "1995", "pages": "1190-1208"},
    ),
    "reduced": Source(
        "book",
        (("Quarteroni", "A."), ("Manzoni", "A."), ("Negri", "F.")),
        "Reduced Basis Methods for Partial Differential Equations",
        {"publisher": "Springer", "year": "2016"},
    ),
    "white": Source(
        "article",
        (("White", "H."),),
        "A heteroskedasticity-consistent covariance matrix estimator and a direct test for heteroskedasticity",
        {"journal": "Econometrica", "volume": "48", "year": "1980", "pages": "817-838"},
    ),
}


def reference_line(source: Source) -> str:
    """The source as a line of a list of references."""
    authors = ((family, "".join(part[0] for part in given.split())) for family, given in source.authors)
    names = ", ".join(f"{family} {initials}".strip() for family, initials in authors)
    fields = source.fields
    title = f"{source.title}, {fields['edition']} ed." if "edition" in fields else f"{source.title}."
    rest = ""
    if source.kind == "article":
        rest = f" {fields['journal']} {fields['volume']} ({fields['year']}) {fields['pages']}."
    elif source.kind == "book":
        rest = f" {fields['publisher']}, {fields['year']}."
    elif "version" in fields:
        rest = f" Version {fields['version']}, {fields['url']}"
    return f"{names}. {title}{rest}"


def bibtex(key: str, source: Source) -> str:
    """The source as an entry of a BibTeX file under `key`; braces keep the names of bodies and the title's capitals."""
    names = " and ".join(f"{family}, {given}" if given else f"{{{family}}}" for family, given in source.authors)
    fields = {"author": names, "title": f"{{{source.title}}}", **source.fields}
    if "pages" in fields:
        fields["pages"] = fields["pages"].replace("-", "--")
    lines = [f"  {name} = {{{value}}}" for name, value in fields.items()]
    return f"@{source.kind}{{{key},\n" + ",\n".join(lines) + "\n}"
