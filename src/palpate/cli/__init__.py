"""The command `palpate`."""

from palpate.cli.entry import main

__all__ = ["main"]
