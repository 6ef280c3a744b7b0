"""The report and the files of an estimate in a browser: a server for this machine alone, that changes nothing."""

from __future__ import annotations

import hashlib
import html
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote, unquote

from palpate.errors import InputDataError, ResourceError
from palpate.study.outputs import RESULT, is_inside, read_json, read_regular

LOOPBACK = "127.0.0.1"
MOST_BYTES = 2**30  # of a file
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".json": "application/json",
    ".csv": "text/csv; charset=utf-8",
    ".toml": "text/plain; charset=utf-8",
}
HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
}
PAGE = "<!doctype html><meta charset=utf-8><title>Palpate</title><h1>{title}</h1><ul>{items}</ul>"


@dataclass(frozen=True, slots=True)
class Viewing:
    """A server that is bound and waits for `serve`; `url` leads to its list of files, `report` to the page.

    Whoever asks must name this host in the request, and know the random word in the path: a page of another site, or
    another user of this machine, gets nothing.
    """

    server: ThreadingHTTPServer
    word: str

    @property
    def url(self) -> str:
        """Where the list of the files is."""
        return f"http://{LOOPBACK}:{self.server.server_address[1]}/{self.word}/"

    @property
    def report(self) -> str:
        """Where the report is."""
        return f"{self.url}report.html"

    def serve(self) -> None:
        """Answer until `close` is called from another thread, or an interrupt comes."""
        try:
            self.server.serve_forever(poll_interval=0.2)
        finally:
            self.server.server_close()

    def close(self) -> None:
        """End `serve`."""
        self.server.shutdown()


def viewing(folder: Path) -> Viewing:
    """Bind a free port of the loopback for the result in `folder`, which lists the files that are shown.

    Raises `InputDataError` where the folder holds no result, `ResourceError` where no port is to be had.
    """
    document = read_json(folder / RESULT)
    files = {name: entry["sha256"] for name, entry in document.get("files", {}).items() if is_inside(folder, name)}
    word = secrets.token_urlsafe(16)
    items = "".join(f'<li><a href="{quote(name)}">{html.escape(name)}</a></li>' for name in [RESULT, *sorted(files)])
    page = PAGE.format(title=html.escape(str(document.get("id", ""))), items=items).encode()

    class Handler(BaseHTTPRequestHandler):
        """What answers: GET of the list and of the files that the result names, to this host alone."""

        server_version, sys_version = "Palpate", ""

        def do_GET(self) -> None:
            """Answer with a page or a file."""
            hosts = {f"{name}:{self.server.server_address[1]}" for name in (LOOPBACK, "localhost")}  # type: ignore[index]
            if self.headers.get("Host", "") not in hosts or self.headers.get_all("Host", [])[1:]:
                return self._answer(HTTPStatus.FORBIDDEN, b"this host is not served\n")
            given, _, name = self.path.split("?")[0].removeprefix("/").partition("/")
            if not secrets.compare_digest(given.encode(), word.encode()):
                return self._answer(HTTPStatus.NOT_FOUND, b"there is nothing here\n")
            if not name:
                return self._answer(HTTPStatus.OK, page, KINDS[".html"])
            content = _content(folder, unquote(name), files)
            if content is None:
                return self._answer(HTTPStatus.NOT_FOUND, b"the result lists no such file, or it was changed since\n")
            return self._answer(HTTPStatus.OK, content, KINDS.get(Path(name).suffix, "application/octet-stream"))

        def _answer(self, status: HTTPStatus, content: bytes, kind: str = "text/plain; charset=utf-8") -> None:
            self.send_response(status)
            for key, value in {**HEADERS, "Content-Type": kind, "Content-Length": str(len(content))}.items():
                self.send_header(key, value)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the base class's name
            """Say nothing: a browser's requests are of no interest."""

    try:
        server = ThreadingHTTPServer((LOOPBACK, 0), Handler)
    except OSError as error:
        raise ResourceError(f"no port of {LOOPBACK} can be opened: {error.strerror or error}") from error
    server.daemon_threads = True
    return Viewing(server, word)


def _content(folder: Path, name: str, files: Mapping[str, str]) -> bytes | None:
    """The bytes of a file that the result lists, as the run left them; None of any other."""
    if name != RESULT and name not in files:
        return None
    try:
        content = read_regular(folder / name, most_bytes=MOST_BYTES)
    except InputDataError:
        return None
    return content if name == RESULT or hashlib.sha256(content).hexdigest() == files[name] else None
