"""`python -m palpate`: the command line where its script is not on the path."""

from __future__ import annotations

import sys

if __name__ == "__main__":
    if not sys.flags.safe_path:  # Python has put the working folder first: its numpy.py is not ours to run
        del sys.path[0]
    from palpate.cli import main

    raise SystemExit(main())
