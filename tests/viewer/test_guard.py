"""Raw clients at the viewer's door: who has the token and comes from an allowed page gets in, nobody else."""

import asyncio
import logging
import socket
import time
import urllib.error
import urllib.request

import pytest

from pdipc.output.results import open_run
from tests.output import runs

viser = pytest.importorskip("viser", reason="needs viser (extra: viewer)")

from websockets.asyncio.client import connect  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402

from pdipc.viewer import Playback  # noqa: E402
from pdipc.viewer.guard import Guard  # noqa: E402


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    runs.write(folder, steps=2)
    shown = Playback(open_run(folder), port=8750, origins=["https://elsewhere.org"])
    yield shown.view.url
    shown.view.server.stop()


def page(url: str, **headers: str) -> int:
    """Status of a plain request."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def connected(url: str, origin: str | None, **headers: str) -> bool:
    """Whether a connection is taken, and the scene is sent over it."""

    async def first_message() -> bool:
        protocol = f"viser-v{viser.__version__}"
        address = url.replace("http://", "ws://").rstrip("/")
        try:
            async with connect(
                address, origin=origin, subprotocols=[protocol], max_size=None, additional_headers=headers
            ) as socket:
                return len(await asyncio.wait_for(socket.recv(), 30.0)) > 0
        except InvalidStatus as error:
            assert error.response.status_code == 403
            return False

    return asyncio.run(first_message())


def test_the_page_needs_the_token(url):
    base, token = url.rstrip("/").rsplit("/", 1)
    assert len(token) >= 20
    assert page(url) == page(url + "index.html") == page(url.rstrip("/")) == 200
    for wrong in (
        base + "/",
        f"{base}/{token[:-1]}/",
        f"{base}/{token}x/",
        f"{base}/x{token}/",
        f"{base}/index.html",
        f"{base}/?{token}",
    ):
        assert page(wrong) == 403
    assert page(f"{url}../../etc/passwd") == 404
    assert Guard("localhost").path_of("/\udcff\udced/") is None  # what bytes that are no text become
    assert page(url, Origin="https://evil.org") == 403


def test_connections_need_the_token_and_an_allowed_page(url):
    base, port = url.rstrip("/").rsplit("/", 1)[0], url.split(":")[2].partition("/")[0]
    local = (f"http://localhost:{port}", "http://localhost:3000", f"http://127.0.0.1:{port}", "http://[::1]:80")
    for origin in (None, *local, "https://elsewhere.org", "https://ELSEWHERE.org:443"):
        assert connected(url, origin), origin
        assert not connected(base, origin)
    foreign = (
        "https://evil.org",
        "http://elsewhere.org",
        "https://elsewhere.org:444",
        "null",
        "http://localhost.evil.org",
        "file://",
    )
    for origin in foreign:
        assert not connected(url, origin), origin


def test_tokens_are_new_each_time():
    assert Guard("localhost").token != Guard("localhost").token


@pytest.mark.parametrize(
    ("served", "origin", "host", "allowed"),
    [
        ("0.0.0.0", "http://lab.example:8080", "lab.example:8080", True),  # its own page, from another machine
        ("0.0.0.0", "http://evil.org", "lab.example:8080", False),
        ("192.168.1.7", "http://192.168.1.7:8080", "192.168.1.7:8080", True),
        ("localhost", "http://evil.org:8080", "evil.org:8080", False),  # a name that was made to mean this machine
        ("localhost", "http://localhost:8080@evil.org", "localhost:8080", False),
        ("localhost", "http://", "localhost:8080", False),
        ("localhost", "http://[", "localhost:8080", False),
        ("localhost", "http://localhost:99999999", "localhost:8080", False),
    ],
)
def test_origins(served, origin, host, allowed):
    assert Guard(served).allows(origin, host) is allowed


@pytest.mark.parametrize("origin", ["elsewhere.org", "*", "ftp://a", "https://a/b", ""])
def test_what_is_no_origin_is_refused(origin):
    with pytest.raises(ValueError, match="is no origin of a page"):
        Guard("localhost", [origin])


@pytest.mark.parametrize(
    "said",
    [b"", b"SSH-2.0-x\r\n", b"\x16\x03\x01\x02\x00", b"GET / HTTP/1.0\r\n\r\n", b"POST / HTTP/1.1\r\n\r\n", b"\0" * 9000],
)
def test_what_speaks_no_http_is_dropped_without_a_traceback(url, said, caplog, capfd):
    port = int(url.split(":")[2].partition("/")[0])
    with caplog.at_level(logging.INFO, "pdipc.viewer.connections"):
        with socket.create_connection(("localhost", port)) as connection:
            connection.sendall(said)
        end = time.monotonic() + 20.0
        while not (told := [record for record in caplog.records if "opening handshake failed" in record.message]):
            assert time.monotonic() < end
            time.sleep(0.01)
    assert [(record.levelname, record.exc_info) for record in told] == [("INFO", None)]
    assert page(url) == 200
    assert "Traceback" not in capfd.readouterr().err
