"""An interrupt during a library's work arrives afterwards, at the handler that was there before."""

from __future__ import annotations

import os
import signal

import pytest

from children import in_a_child
from palpate.mesh.remeshing import interrupts_held


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_and_finds_the_earlier_handler(number):
    """In a process of one thread: others of the tests' could take the signal."""

    def interrupted() -> int:
        seen = []
        signal.signal(number, lambda *_: seen.append("ours"))
        with interrupts_held():
            signal.signal(number, lambda *_: seen.append("the library's"))
            os.kill(os.getpid(), number)
            early = list(seen)
        return 0 if (early, seen) == ([], ["ours"]) else 1

    assert in_a_child(interrupted) == 0
