"""The result in a browser: this machine alone, the files of the run alone, and as the run left them."""

from __future__ import annotations

import hashlib
import http.client
import json
import signal
import subprocess
import sys
import threading
from urllib.parse import urlsplit

import pytest

from palpate.cli import main
from palpate.errors import InputDataError
from palpate.steps.viewing import viewing

PAGE = b"<h1>a page</h1>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("viewed") / "out"
    tmp_path.mkdir()
    (tmp_path / "report.html").write_bytes(PAGE)
    (tmp_path / "mesh.vtu").write_bytes(b"changed since")
    (tmp_path / "secret.txt").write_bytes(b"not of the run")
    files = {name: {"sha256": hashlib.sha256(PAGE).hexdigest()} for name in ("report.html", "mesh.vtu", "../up.txt")}
    document = {"schema": "palpate.result/1", "id": "<b>sub-01", "files": files}
    (tmp_path / "result.json").write_text(json.dumps(document))
    return tmp_path


@pytest.fixture(scope="module")
def server(folder):
    found = viewing(folder)
    thread = threading.Thread(target=found.serve)
    thread.start()
    yield found
    found.close()
    thread.join()


def ask(url, **headers):
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)
    connection.putrequest("GET", parts.path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read(), answer.headers


def test_the_page_and_the_list_are_served_on_the_loopback(server):
    assert server.server.server_address[0] == "127.0.0.1"
    status, content, headers = ask(server.report)
    assert (status, content) == (200, PAGE)
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["X-Content-Type-Options"] == "nosniff"
    status, content, _ = ask(server.url)
    assert status == 200
    assert b"&lt;b&gt;sub-01" in content
    assert b'href="mesh.vtu"' in content


@pytest.mark.parametrize("host", ["example.org", "example.org:80", "127.0.0.1", "", "127.0.0.1.example.org:1"])
def test_a_request_for_another_host_gets_nothing(server, host):
    status, content, _ = ask(server.report, Host=host)
    assert status == 403
    assert PAGE not in content


def test_without_the_word_nothing_is_there(server):
    port = urlsplit(server.url).port
    for path in ("", "report.html", "x/report.html"):
        assert ask(f"http://127.0.0.1:{port}/{path}")[0] == 404


@pytest.mark.parametrize("name", ["secret.txt", "mesh.vtu", "../up.txt", "..%2fup.txt", "%2fetc%2fpasswd", "log.txt"])
def test_only_files_of_the_run_are_served_and_only_as_it_left_them(server, folder, name):
    (folder.parent / "up.txt").write_bytes(PAGE)
    assert ask(server.url + name)[0] == 404


def test_a_folder_without_a_result_is_refused(tmp_path, capsys):
    with pytest.raises(InputDataError, match="there is no"):
        viewing(tmp_path)
    assert main(["view", str(tmp_path), "--no-browser"]) == 3
    assert "run the estimate first" in capsys.readouterr().err


def test_an_interrupt_ends_the_command_in_peace(folder):
    command = [sys.executable, "-m", "palpate", "view", str(folder), "--no-browser", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stderr:
            if line.startswith("http://127.0.0.1:"):
                assert ask(line.strip())[1] == PAGE
                break
        process.send_signal(signal.SIGINT)
        spoken, _ = process.communicate(timeout=30)
    assert process.returncode == 0
    assert json.loads(spoken)["schema"] == "palpate.view/1"
