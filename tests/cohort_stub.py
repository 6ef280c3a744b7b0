"""Work for the tests of scheduling: it does what a row's column `does` says, in no time, and computes nothing.

It writes the mark of a row by itself: what `palpate.cohort.plan` imports takes longer than all else that is done here.
"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from palpate.cohort.task import Outcome, Task
from palpate.errors import GeometryError
from palpate.study.outputs import RESULT, OutputFolder, sha256_of, write_json


def work(task: Task, tell) -> Outcome:
    folder, key = Path(task.folder), task.key
    what, _, number = task.row.covariates.get("does", "").partition(" ")
    (folder / f"attempt-{task.attempt}").touch()
    need = float(number or 0.1) if what == "needs" else 0.1
    if task.room_gb is not None and need > task.room_gb:
        return Outcome(task.row.id, "failed", key, "resources", cause="room", expected_gb=need)
    tell(need, 0.1)
    if what == "abort":
        os.abort()
    if what == "hang":
        time.sleep(1000.0)
    if what == "fill" and task.coarser == 1.0:
        held = bytearray(int(float(number) * 1e9))
        held[::4096] = b"x" * len(held[::4096])
        time.sleep(1000.0)
    if what == "swell":
        held = bytearray(int(float(number) * 1e9))
        held[::4096] = b"x" * len(held[::4096])
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "allocate" and task.coarser == 1.0:
        return Outcome.failed(task, "resources", "memory was short", cause="memory")
    if what == "die" and task.attempt <= int(number):
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "refuse":
        return Outcome.failed(task, "geometry", str(GeometryError("an organ is too thin")))
    item = {
        "tissue": "prostate",
        "parameter": "youngs_modulus",
        "value": 30.0 + task.row.stage,
        "verdict": "identified",
        "interval95": [25.0, 44.0],
    }
    outputs = OutputFolder(folder)
    with outputs.held(), outputs.new_files() as area:
        write_json(area / RESULT, {"id": task.row.id, "estimates": [item]})
        digest = sha256_of(area / RESULT)
        outcome = Outcome(task.row.id, "done", key, message="; ".join(task.remarks), result=digest)
        write_json(area / "done.json", {"schema": "palpate.done/1"} | outcome.to_dict())
    return outcome
