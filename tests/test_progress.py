"""Progress: the bar's share and its time left, sentences with stages, and a terminal that is left as it was found."""

from __future__ import annotations

import fcntl
import os
import pickle
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.progress import STAGES, Forecast, Line, Told, about, details, during
from palpate.steps.display import place, shown_in_python

SECONDS = dict(zip(STAGES, (4.0, 8.0, 4.0, 16.0, 30.0, 12.0), strict=True))


def run_of(pace, points=400):
    """The places of a run whose stages take `pace` times what was predicted, at even times; their true shares."""
    took = np.array([SECONDS[stage] for stage in STAGES]) * pace
    began = np.concatenate([[0.0], np.cumsum(took)[:-1]])
    times = np.linspace(0.0, took.sum(), points, endpoint=False)
    begun = [{s: b for s, b in zip(STAGES, began, strict=True) if b <= now} for now in times]
    return [place(SECONDS, b, now) for b, now in zip(begun, times, strict=True)], times / took.sum(), took.sum() - times


def test_where_the_prediction_is_right_share_and_time_left_are():
    places, shares, left = run_of(np.ones(len(STAGES)))
    assert np.abs([at.share for at in places] - shares).max() < 0.06
    assert np.abs([at.left for at in places] - left).max() < 0.06 * sum(SECONDS.values())
    assert [at.stage for at in places][-1] == "intervals"


def test_where_all_takes_longer_by_one_factor_the_time_left_learns_it():
    places, _, left = run_of(np.full(len(STAGES), 3.0))
    later = slice(len(places) // 2, None)
    assert np.allclose([at.left for at in places][later], left[later], atol=0.15 * 3.0 * sum(SECONDS.values()))


@pytest.mark.parametrize("seed", range(20))
def test_a_share_is_below_one_and_within_a_stage_never_falls(seed):
    places, _, _ = run_of(np.exp(np.random.default_rng(seed).normal(0.0, 1.5, len(STAGES))))
    shares, stages = [at.share for at in places], [at.stage for at in places]
    assert 0.0 <= min(shares) <= max(shares) < 1.0
    assert all(b >= a for a, b, s, t in zip(shares, shares[1:], stages, stages[1:], strict=False) if s == t)
    assert min(at.left for at in places) >= 0.0


def test_a_stage_that_is_left_out_is_passed_over():
    seconds = SECONDS | {"check the law": 0.0}
    at = place(seconds, {"read": 0.0, "search": 12.0, "intervals": 32.0}, 32.0)
    assert at.share == pytest.approx((4 + 8 + 4 + 16) / (4 + 8 + 4 + 16 + 12))


def test_a_sentence_keeps_the_stage_that_is_its_own():
    heard = []
    outer = during("search", heard.append)
    outer("a")
    during("check the law", outer)("b")
    outer(Forecast("c", SECONDS))
    outer(Line("d", "intervals"))
    assert heard == ["a", "b", "c", "intervals: d"]
    assert [getattr(each, "stage", None) for each in heard] == ["search", "check the law", None, "intervals"]


def test_of_one_of_many_estimates_every_sentence_is_a_detail():
    heard = []
    for sentence in (Line("17 tetrahedra", "mesh"), Forecast("a minute", SECONDS), "b"):
        details(heard.append)(sentence)
    assert heard == ["mesh: 17 tetrahedra", "a minute", "b"]
    assert {type(each) for each in heard} == {str}


@pytest.mark.parametrize("said", [Line("17 tetrahedra", "mesh"), Line("a"), Told("b", "read"), Forecast("c", SECONDS)])
def test_a_sentence_is_the_same_in_another_process(said):
    found = pickle.loads(pickle.dumps(said))
    assert (type(found), found) == (type(said), said)
    assert all(getattr(found, name) == getattr(said, name) for name in ("stage", "seconds") if hasattr(said, name))


def test_times_are_in_plain_words():
    words = [about(seconds) for seconds in (0, 20, 60, 100, 600, 7200)]
    assert words == ["a few seconds", "half a minute", "a minute", "2 minutes", "10 minutes", "2.0 hours"]


TALK = """
import sys, time
from palpate.steps.display import progress_on_stderr
from palpate.progress import Forecast, Line, during
with progress_on_stderr(quiet=QUIET, verbose=VERBOSE) as progress:
    during("read", progress)("279 modes")
    progress(Line("reading [the] images"))
    progress(Forecast("about a minute", {"read": 1.0, "mesh": 1.0, "intervals": 0.5}))
    progress(Line("größe", "mesh"))
    progress(Forecast("about a minute", {"read": 1.0, "mesh": 1.0, "intervals": 0.5}))
    time.sleep(0.6)
    END
print("done", file=sys.stderr)
"""


def on_a_terminal(end="pass", *, quiet=False, verbose=False, interrupted=False, **variables):
    """What a terminal of 80 columns sees of `TALK`, its exit code, and whether the terminal is set as before."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    before = termios.tcgetattr(follower)
    code = TALK.replace("QUIET", str(quiet)).replace("VERBOSE", str(verbose)).replace("END", end)
    plain = {key: value for key, value in os.environ.items() if key not in ("NO_COLOR", "COLUMNS", "TERM")}
    environment = plain | {"TERM": "xterm", "PYTHONIOENCODING": "utf-8"} | variables
    with subprocess.Popen([sys.executable, "-c", code], stderr=follower, env=environment) as process:
        seen, limit = b"", time.monotonic() + 30.0
        while time.monotonic() < limit:
            if interrupted and b"% " in seen:
                process.send_signal(signal.SIGINT)
                interrupted = False
            if select.select([leader], [], [], 0.05)[0]:
                seen += os.read(leader, 65536)
            elif process.poll() is not None:
                break
        code = process.wait(timeout=5)
    after = termios.tcgetattr(follower)
    os.close(leader)
    os.close(follower)
    return seen.decode(), code, before == after


def screen(text):
    """The lines that stay on a terminal: what is written over or erased is gone."""
    lines, row, column = [""], 0, 0
    for part in re.split(r"(\x1b\[[0-9;?]*[A-Za-z]|\r|\n)", text):
        if part == "\r":
            column = 0
        elif part == "\n":
            row += 1
            lines += [""] * (row + 1 - len(lines))
        elif part == "\x1b[2K":
            lines[row] = ""
        elif part.startswith("\x1b[") and part.endswith("A"):
            row -= int(part[2:-1] or 1)
        elif not part.startswith("\x1b"):
            lines[row] = lines[row][:column].ljust(column) + part + lines[row][column + len(part) :]
            column += len(part)
    return [line.rstrip() for line in lines if line.strip()]


LINES = ["reading [the] images", "about a minute", "mesh: größe"]


def told(text):
    return [re.sub(r"^\[ *[\d.]+ s\] ", "", line) for line in screen(text)]


def test_on_a_terminal_a_bar_stands_below_the_lines_and_goes_away():
    seen, code, as_before = on_a_terminal()
    shares = [int(share) for share in re.findall(r"(\d+) %", seen)]
    assert len(shares) > 2
    assert shares == sorted(shares)
    assert shares[-1] < 100
    assert "a few seconds left" in seen
    assert "?25l" not in seen  # the cursor was never hidden
    assert (told(seen), code, as_before) == ([*LINES, "done"], 0, True)


@pytest.mark.parametrize(
    ("end", "interrupted", "said"), [("raise ValueError(1)", False, "ValueError: 1"), ("", True, "KeyboardInterrupt")]
)
def test_an_error_or_an_interrupt_takes_the_bar_away(end, interrupted, said):
    seen, code, as_before = on_a_terminal(end or "time.sleep(20)", interrupted=interrupted)
    assert re.search(r"\d %", seen)
    lines = told(seen)[: [line[:9] for line in told(seen)].index("Traceback")]
    assert lines == LINES[: len(lines)]  # the interrupt may come before the last of them
    assert told(seen)[-1] == said
    assert (code != 0, as_before) == (True, True)


def test_details_are_seen_by_whoever_asks_for_them():
    seen, _, _ = on_a_terminal(verbose=True)
    assert told(seen) == ["279 modes", *LINES, "about a minute", "done"]


@pytest.mark.parametrize(("variables", "lines"), [({"TERM": "dumb"}, LINES), ({"quiet": True}, [])])
def test_a_terminal_that_cannot_be_written_over_sees_lines_and_a_quiet_run_says_nothing(variables, lines):
    seen, code, _ = on_a_terminal(**variables)
    assert "\x1b" not in seen
    assert (told(seen), code) == ([*lines, "done"], 0)


MUTE = """
import os, time
from palpate.steps.display import progress_on_stderr
from palpate.progress import Forecast, Line
with progress_on_stderr(quiet=QUIET, patience_s=0.02) as progress:
    progress(Line("remeshing", "mesh"))
    SAID
    mine = os.dup(2)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # as the mesher does with what its library prints
    time.sleep(0.3)
    os.dup2(mine, 2)
"""


@pytest.mark.parametrize("quiet", [False, True])
def test_no_stage_is_silent_where_no_bar_moves(quiet):
    code = MUTE.replace("QUIET", str(quiet)).replace("SAID", "pass")
    said = subprocess.run([sys.executable, "-c", code], check=True, stderr=subprocess.PIPE, text=True).stderr
    lines = [re.sub(r"[\d.]+ s", "", line) for line in said.splitlines()]
    assert lines[:1] == ([] if quiet else ["[   ] mesh: remeshing"])
    assert set(lines[1:]) == (set() if quiet else {"[   ] still at work: mesh: remeshing"})


def test_where_no_bar_moves_a_reminder_says_how_far_the_run_is():
    forecast = 'progress(Forecast("a minute", {"mesh": 60.0, "search": 60.0}))'
    code = MUTE.replace("QUIET", "False").replace("SAID", forecast)
    said = subprocess.run([sys.executable, "-c", code], check=True, stderr=subprocess.PIPE, text=True).stderr
    reminders = {line.partition("] ")[2] for line in said.splitlines()[2:]}
    assert reminders == {"still at work: mesh, 0 %, 2 minutes left"}


ASKED = """
import sys
from palpate.progress import Line
from palpate.steps.display import shown_in_python
heard = []
with shown_in_python(WANTED) as tell:
    tell(Line("seen"))
    tell("a detail")
print(heard)
"""


@pytest.mark.parametrize(
    ("wanted", "printed", "heard"),
    [
        ("'auto'", "", "[]"),
        ("None", "", "[]"),
        ("False", "", "[]"),
        ("True", "seen", "[]"),
        ("heard.append", "", "['seen', 'a detail']"),
    ],
)
def test_a_script_without_a_terminal_is_silent_unless_it_asks(wanted, printed, heard):
    code = ASKED.replace("WANTED", wanted)
    said = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert said.stdout.strip() == heard
    assert said.stderr.strip().partition("] ")[2] == printed


def test_a_notebook_without_widgets_shows_lines_and_a_bar_that_goes_away(monkeypatch):
    contents = []
    cell = SimpleNamespace(update=lambda content, **_: contents.append(content))

    def display(content, **_):
        contents.append(content)
        return cell

    kernel = SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=object()))
    monkeypatch.setitem(sys.modules, "IPython", kernel)
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=display))
    with shown_in_python("auto") as progress:
        progress(Line("<b>2 images", "read"))
        progress(Forecast("this takes 2 minutes", {"read": 60.0, "mesh": 60.0}))
        progress("279 modes")
    *_, during_it, at_its_end = contents
    assert "<progress" in during_it["text/html"]
    assert "read, 0 %, 2 minutes left" in during_it["text/plain"]
    for content in (during_it, at_its_end):
        assert "read: &lt;b&gt;2 images" in content["text/html"]
        assert "modes" not in content["text/plain"]
    assert "<progress" not in at_its_end["text/html"]
    assert [line.partition("] ")[2] for line in at_its_end["text/plain"].splitlines()] == [
        "read: <b>2 images",
        "this takes 2 minutes",
    ]


def test_letters_that_a_terminal_lacks_are_escaped():
    seen, code, _ = on_a_terminal(PYTHONIOENCODING="ascii")
    assert (told(seen)[2], code) == ("mesh: gr\\xf6\\xdfe", 0)


def test_a_terminal_that_is_closed_costs_no_run():
    leader, follower = pty.openpty()
    code = TALK.replace("QUIET", "False").replace("VERBOSE", "False").replace("END", "pass")
    environment = os.environ | {"TERM": "xterm"}
    with subprocess.Popen([sys.executable, "-c", code], stderr=follower, env=environment) as process:
        os.close(follower)
        while b"% " not in os.read(leader, 65536):
            pass
        os.close(leader)
        assert process.wait(timeout=30) == 0
