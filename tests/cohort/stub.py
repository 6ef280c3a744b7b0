"""A program in the place of `palpate estimate` for tests of scheduling: it does what the row's id says, in no time."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
import tomllib
from pathlib import Path

threading.Thread(target=lambda: os.read(0, 1) or os._exit(1), daemon=True).start()  # ends with whoever started it
_, command, case, _, output, *_ = sys.argv
folder = Path(output)
folder.mkdir(parents=True, exist_ok=True)
what, _, number = tomllib.loads(Path(case).read_text(encoding="utf-8"))["id"].partition("-")
attempt = 1 + len(list(folder.glob("attempt-*")))
(folder / f"attempt-{attempt}").write_text(str(os.getpid()))
sys.stderr.write("palpate: warning: the stub says something first\n")
if what == "abort":
    os.abort()
if what == "hang":
    time.sleep(1000.0)
if what in ("fill", "swell"):
    held = bytearray(600_000_000)
    held[::4096] = b"x" * len(held[::4096])
    time.sleep(1000.0 if what == "fill" else 0.5)
    os.kill(os.getpid(), signal.SIGKILL)
if what == "die" and attempt <= int(number):
    os.kill(os.getpid(), signal.SIGKILL)
if what == "worker" and attempt <= int(number):
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(1000.0)
if what == "exit":
    sys.stderr.write("palpate: an organ is too thin\n")
    raise SystemExit(int(number))
item = {"tissue": "prostate", "parameter": "youngs_modulus", "value": 30.0, "verdict": "identified"}
item["interval95"] = [25.0, 44.0]
(folder / "result.json").write_text(json.dumps({"estimates": [item]}))
