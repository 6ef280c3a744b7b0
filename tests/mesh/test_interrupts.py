"""An interrupt during a library's work arrives afterwards, at the handler that was there before."""

from __future__ import annotations

import signal
import threading

import pytest

from palpate.mesh import remeshing
from palpate.mesh.remeshing import interrupts_held


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits_and_finds_the_earlier_handler(number, monkeypatch):
    monkeypatch.setattr(
        remeshing, "_others_take_none", lambda _: True
    )  # other threads of the tests never take this signal
    seen = []
    earlier = signal.signal(number, lambda *_: seen.append("ours"))
    try:
        with interrupts_held():
            signal.signal(number, lambda *_: seen.append("the library's"))
            signal.pthread_kill(threading.get_ident(), number)
            assert seen == []
        assert seen == ["ours"]
    finally:
        signal.signal(number, earlier)
