"""`palpate` as a process that ends with whoever started it: `python -m palpate.cohort.child estimate ...`.

Whoever starts it holds its standard input open, in a process group of its own. When he is gone, however that came, the
process ends with all that it has started.
"""

from __future__ import annotations

import os
import runpy
import signal
import threading


def _end_with_standard_input() -> None:
    os.read(0, 1)
    os.killpg(os.getpgrp(), signal.SIGKILL)


if __name__ == "__main__":
    threading.Thread(target=_end_with_standard_input, daemon=True).start()
    runpy.run_module("palpate", run_name="__main__", alter_sys=True)
