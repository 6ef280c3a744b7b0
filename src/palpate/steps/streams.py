"""Words on standard streams that may be closed, and the logger of the package."""

from __future__ import annotations

import errno
import logging
import os
from contextlib import suppress
from typing import TextIO

LOGGER = logging.getLogger("palpate")


def tell(text: str, stream: TextIO | None) -> OSError | None:
    """Print lines on a standard stream; letters that it cannot hold are escaped. Gives why they were not printed."""
    if stream is None:  # closed from the start
        return OSError(errno.EBADF, "it is closed")
    encoding = getattr(stream, "encoding", None) or "utf-8"
    try:
        stream.write(text.encode(encoding, "backslashreplace").decode(encoding) + "\n")
        stream.flush()
    except (OSError, ValueError) as error:  # ValueError: closed meanwhile
        give_up(stream)
        return error if isinstance(error, OSError) else OSError(errno.EBADF, str(error))
    return None


def give_up(stream: TextIO) -> None:
    """What a stream still holds leads nowhere."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
