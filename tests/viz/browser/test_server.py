"""Who is let in, at which ports, and that nothing but the page and its data is served."""

from __future__ import annotations

import json
import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import Future

import numpy as np
import pytest
import umsgpack

from pipelines.errors import DyObError
from viz.browser.live_server import LiveServer
from viz.browser.recorded import RecordedServer
from viz.browser.records import page_setup
from viz.browser.server import PageServer

WAIT_S = 10.0


def fetch(url: str, **headers: str) -> tuple[int, bytes]:
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=WAIT_S) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as refused:
        return refused.code, refused.read()


def knock(server: PageServer, path: str, origin: str) -> str:
    """The first line that a websocket's request is answered with."""
    with socket.create_connection(("127.0.0.1", server.port), WAIT_S) as connection:
        lines = [
            f"GET {path} HTTP/1.1",
            f"Host: 127.0.0.1:{server.port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
            "Sec-WebSocket-Version: 13",
            f"Origin: {origin}",
        ]
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        return connection.recv(400).decode("latin-1").splitlines()[0]


@pytest.fixture(scope="module")
def local(result) -> Iterator[RecordedServer]:
    server = RecordedServer(result)
    server.start()
    yield server
    server.stop()


@pytest.fixture(scope="module")
def shared(result) -> Iterator[RecordedServer]:
    """Reachable from other machines."""
    server = RecordedServer(result, host="0.0.0.0")
    server.start()
    yield server
    server.stop()


@pytest.fixture(scope="module")
def live() -> Iterator[LiveServer]:
    server = LiveServer(page_setup("a run", None, None), host="0.0.0.0")
    server.start()
    yield server
    server.stop()


def test_a_result_is_served_whole(local, result):
    status, page = fetch(local.url)
    assert status == 200 and b"MeshCat" in page and b"dyob-data" not in page.split(b"<script>")[0]
    data = json.loads(fetch(local.url + "data")[1])
    assert [frame["index"] for frame in data["frames"]] == list(range(8))
    assert data["pictures"] == [True] * 4 + [False] + [True] * 3
    told = umsgpack.unpackb(fetch(local.url + "map")[1])
    (geometry,) = told["object"]["geometries"]
    position = np.frombuffer(geometry["data"]["attributes"]["position"]["array"].data, np.float32)
    assert len(position) == 3 * data["map"]["n_points"] > 1000
    assert fetch(local.url + "picture/2")[1][:3] == b"\xff\xd8\xff"  # a JPEG
    assert [fetch(local.url + f"picture/{k}")[0] for k in (4, 8, 10**8)] == [404] * 3


@pytest.mark.parametrize(
    "path",
    ["data/", "static/x", "frames/000002.png", "..%2fREADME.md", "picture/..%2f000002.png", "live"],
)
def test_nothing_else_is_served(local, path):
    assert fetch(local.url + path)[0] == 404


def test_by_default_only_this_machine_is_served(local, shared):
    assert local.url == f"http://127.0.0.1:{local.port}/" and local.token == ""
    other_name = {"Host": f"elsewhere.example:{local.port}"}
    assert fetch(local.url, **other_name)[0] == 403  # as a page would come by DNS rebinding
    assert fetch(local.url, Host=f"localhost:{local.port}")[0] == 200
    addresses = {address for s in local._sockets for address in [s.getsockname()[0]]}
    assert addresses <= {"127.0.0.1"}


@pytest.mark.parametrize("path", ["", "data", "map", "picture/1"])
def test_others_need_the_token(shared, path):
    address = f"http://127.0.0.1:{shared.port}/{path}"
    assert len(shared.token) >= 32 and shared.url.endswith(f"/?token={shared.token}")
    for wrong in ("", "?token=", "?token=wrong", f"?token={shared.token[:-1]}", "?token=%C3%A4"):
        status, said = fetch(address + wrong)
        assert status == 403 and b"token" in said
    assert fetch(f"{address}?token={shared.token}")[0] == 200


def test_a_live_view_is_guarded_as_well(live):
    own = f"http://127.0.0.1:{live.port}"
    right = f"/live?token={live.token}"
    assert " 101 " in knock(live, right, own)
    for path, origin in (
        ("/live", own),
        ("/live?token=wrong", own),
        (right, "http://elsewhere.example"),
        (right, f"http://127.0.0.1:{live.port + 1}"),
    ):
        assert " 403 " in knock(live, path, origin)
    assert fetch(f"{own}/")[0] == 403
    assert fetch(live.url.replace("0.0.0.0", "127.0.0.1").split("?")[0])[0] == 403


def test_a_browser_that_lags_gets_the_newest_picture_alone(live):
    """Else the last one of a run might never come."""
    (handler,) = (rule[1] for rule in live.rules() if rule[0] == "/live")
    browser, said = handler.__new__(handler), []
    browser.say = said.append
    browser.writing = 1
    browser.show(b"first")
    browser.show(b"second")
    assert said == []
    sent: Future[None] = Future()
    sent.set_result(None)
    browser._said(sent)
    assert said == [b"second"]
    browser.show(b"third")
    assert said == [b"second", b"third"] and browser.owed is None


def test_each_run_has_a_token_of_its_own(shared, live):
    assert shared.token != live.token


def test_viewers_at_once_take_different_ports(local, shared, live):
    assert len({local.port, shared.port, live.port}) == 3
    with pytest.raises(DyObError, match=rf"port {local.port}, found 'Address .*name another"):
        PageServer(port=local.port)


def test_a_port_is_free_again_when_its_server_has_stopped(result):
    first = RecordedServer(result)
    first.start()
    first.stop()
    second = RecordedServer(result, port=first.port)
    second.start()
    assert fetch(second.url)[0] == 200
    second.stop()


def test_an_address_of_another_machine_is_refused_in_words():
    with pytest.raises(DyObError, match=r"192\.0\.2\.1.*address of this machine as --host"):
        PageServer(host="192.0.2.1")
