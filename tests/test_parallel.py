"""Work on several processors gives what one would."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

import palpate
from palpate import parallel
from palpate.parallel import blas_on_one_thread, mapped, processors


def test_results_come_in_the_order_of_the_items():
    assert mapped(lambda n: n * n, range(100)) == [n * n for n in range(100)]
    assert mapped(str, []) == []


def test_what_a_call_raises_is_raised():
    with pytest.raises(ZeroDivisionError):
        mapped(lambda n: 1 // n, [2, 1, 0])


def test_the_limit_of_the_linear_algebra_holds(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert processors() == 1


def test_nothing_else_counts_the_processors():
    """What a queue or a container allows is known in one place."""
    counting = [path.name for path in Path(palpate.__file__).parent.rglob("*.py") if "cpu_count" in path.read_text()]
    assert counting == ["parallel.py"]


def test_a_limit_that_is_no_plain_number_is_none(monkeypatch):
    monkeypatch.setenv("MKL_NUM_THREADS", "1")
    monkeypatch.setenv("OMP_NUM_THREADS", "\u00b2")
    assert processors() == 1


class Libraries:
    """One number of threads for the whole process, as a BLAS has it."""

    threads = 2

    def limit(self, *, limits, user_api):
        assert user_api == "blas"
        before, self.threads = self.threads, limits
        return Limit(self, before)


class Limit:
    """What sets back the number of threads that it found."""

    def __init__(self, libraries, before):
        self.libraries, self.before = libraries, before

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.libraries.threads = self.before


@pytest.fixture
def libraries(monkeypatch):
    found = Libraries()
    monkeypatch.setattr(parallel, "_libraries", lambda: found)
    return found


def test_blas_computes_on_one_thread_until_the_last_of_several_callers_has_ended(libraries):
    """The first one sets the limit, and ends before the second."""
    inside, over = threading.Event(), threading.Event()

    def first():
        with blas_on_one_thread():
            inside.set()
            over.wait(10.0)

    other = threading.Thread(target=first)
    other.start()
    assert inside.wait(10.0)
    with blas_on_one_thread():
        over.set()
        other.join(10.0)
        assert libraries.threads == 1
    assert libraries.threads == 2


def test_an_error_inside_lifts_the_limit(libraries):
    @blas_on_one_thread()
    def failing():
        with blas_on_one_thread():
            assert libraries.threads == 1
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        failing()
    assert libraries.threads == 2
