"""`python -m palpate`: the command line where its script is not on the path."""

from __future__ import annotations

from palpate.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
