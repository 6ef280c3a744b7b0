"""Work in a child of the process that tests: it may be killed, and what it changes of its own ends with it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable


def in_a_child(work: Callable[[], int]) -> int:
    """The exit code of a process that is this one up to here, and then does `work`; minus the signal that ended it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads have no part in what the child does
        child = os.fork()
    if child == 0:
        code = 99
        try:
            code = work()
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
