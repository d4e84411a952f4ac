"""Who may talk to the server of the browser view, and what a browser may send."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="needs viser")

import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from cube_tensor_driver.browser.controls import ColourControls
from cube_tensor_driver.browser.gate import guarded_server, refusal
from cube_tensor_driver.core.scene import QUANTITIES

HERE = "127.0.0.1"


@pytest.mark.parametrize(
    ("host", "origin", "word"),
    [
        ("127.0.0.1:8080", None, ""),
        ("127.0.0.1:8080", "http://127.0.0.1:8080", ""),
        ("localhost:9000", "http://localhost:9000", ""),
        ("[::1]:8080", "http://[::1]:8080", ""),
        ("127.0.0.1:8080", "http://127.0.0.1:9000", "origin"),
        ("127.0.0.1:8080", "https://evil.example", "origin"),
        ("127.0.0.1:8080", "null", "origin"),
        ("evil.example:8080", "http://evil.example:8080", "host"),
        ("evil.example:8080", None, "host"),
        ("127.0.0.1.evil.example", None, "host"),
        ("[", None, "host"),
        ("", None, "host"),
    ],
)
def test_only_this_page_is_answered(host: str, origin: str | None, word: str) -> None:
    found = refusal(host, origin)
    assert word in found and bool(word) == bool(found)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    with guarded_server():
        server = viser.ViserServer(HERE, 0, verbose=False)
    yield server.get_port()
    server.stop()


def test_the_server_refuses_other_hosts_and_origins(port: int) -> None:
    def status(**headers: str) -> int:
        connection = http.client.HTTPConnection(HERE, port, timeout=10)
        connection.request("GET", "/", headers=headers)
        answer = connection.getresponse()
        answer.read()
        connection.close()
        return answer.status

    assert status() == 200
    assert status(Host="evil.example") == 403
    assert status(Origin="http://evil.example") == 403

    def connected(origin: str | None) -> bool:
        protocols = [f"viser-v{viser.__version__}"]
        try:
            with connect(f"ws://{HERE}:{port}", origin=origin, subprotocols=protocols) as socket:
                return bool(socket.recv(timeout=10))
        except InvalidStatus as refused:
            assert refused.response.status_code == 403
            return False

    assert connected(None) and connected(f"http://{HERE}:{port}")
    assert not connected("http://evil.example")


def test_values_that_no_control_offers_do_no_harm() -> None:
    """A browser may send any."""

    def control(value: object) -> SimpleNamespace:
        return SimpleNamespace(value=value, on_update=lambda _: None, content="")

    gui = SimpleNamespace(
        add_dropdown=lambda *_: control("no such quantity"),
        add_number=lambda *_, **__: control(float("nan")),
        add_html=control,
    )
    controls = ColourControls(gui, lambda: None)
    assert controls.quantity in QUANTITIES.values()
    assert controls.top == 0.0
