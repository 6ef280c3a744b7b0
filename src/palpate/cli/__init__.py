"""The command `palpate`."""

from __future__ import annotations

import os
import signal

TYPE_CHECKING = False  # the module typing takes longer to import than all that is needed here
if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run `palpate` with the arguments `argv` and return its exit code.

    Without `argv` this is the process's own command: its arguments are those of the process, and it is left ready to
    end, with streams that the interpreter can close and signals that no longer matter.
    """
    signals = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
    masks = hasattr(signal, "pthread_sigmask")
    held = signal.pthread_sigmask(signal.SIG_BLOCK, signals) if masks else ()  # until there is a sentence for them
    try:
        if argv is None:
            for file in range(3):  # one that is closed would lend its number to the next file: it leads nowhere instead
                try:
                    os.fstat(file)
                except OSError:
                    os.open(os.devnull, os.O_RDWR)
        from palpate.cli.entry import run

        return run(argv, signals, held)
    finally:
        if argv is None:
            from palpate.cli.console import close_streams

            for number in signals:
                signal.signal(number, signal.SIG_IGN)
            close_streams()
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, held)
