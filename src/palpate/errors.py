"""The tree of errors; each class carries the exit code that the command line returns.

PalpateError
├── ConfigurationError      2   case.toml, flags, keys, impossible values
├── InputDataError          3   an image or table that cannot be read or used
├── GeometryError           4   organs or meshes that cannot be used in a computation
│   └── MeshQualityError    4   a mesh that failed its quality check
├── EstimationError         5   no result was found
│   ├── SolverError         5   a linear solve failed or did not reach its tolerance
│   └── NotConverged        5   an iteration stopped before its tolerance
└── ResourceError           6   memory, disk, a missing optional library
    └── FolderInUse         6   another run works in the output folder
"""

from __future__ import annotations


class PalpateError(Exception):
    """Anything that Palpate refuses or fails to do; the text says what, where, with which numbers, and what to do."""

    exit_code = 1


class ConfigurationError(PalpateError):
    """The case file or a flag asks for something unknown or impossible."""

    exit_code = 2


class InputDataError(PalpateError):
    """An input file is missing, unreadable or cannot be what it claims to be."""

    exit_code = 3


class GeometryError(PalpateError):
    """The anatomy in the images cannot be turned into a computable geometry."""

    exit_code = 4


class MeshQualityError(GeometryError):
    """A mesh did not pass its quality check."""


class EstimationError(PalpateError):
    """The estimation cannot give a result."""

    exit_code = 5


class SolverError(EstimationError):
    """A linear system could not be solved to its tolerance."""


class NotConverged(EstimationError):  # noqa: N818 - the name of the status in result.json
    """An iteration stopped before it reached its tolerance."""


class ResourceError(PalpateError):
    """The machine lacks memory, disk space or an optional library."""

    exit_code = 6


class FolderInUse(ResourceError):  # noqa: N818 - it may pass by itself
    """Another run of Palpate works in the output folder."""
