# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Who may talk to the server of the browser view, what a browser may send, and what it may save."""

from __future__ import annotations

import csv
import http.client
import io
import socket
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="needs viser")

import numpy as np
import viser
from PIL import Image
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from cube_tensor_driver.browser.charts import format_csv
from cube_tensor_driver.browser.controls import ColourControls
from cube_tensor_driver.browser.gate import Gate, find_refusal, make_secret_address
from cube_tensor_driver.browser.history import History
from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.views.figures.panels import draw_panels
from cube_tensor_driver.views.figures.style import render_png
from cube_tensor_driver.views.round_numbers import round_range
from cube_tensor_driver.views.scene import QUANTITIES

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
    found = find_refusal(host, origin)
    assert word in found and bool(word) == bool(found)


TOKEN = "a-token"


@pytest.fixture(params=["", TOKEN])
def port(request: pytest.FixtureRequest) -> Iterator[int]:
    """Return a gate before viser, with the token or without one."""
    address = make_secret_address()
    server = viser.ViserServer(address, 0, verbose=False)
    gate = Gate(HERE, 0, request.param, (address, server.get_port()))
    yield gate.port
    server.stop()
    gate.close()


def asked(port: int, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(HERE, port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    answer.text = answer.read()
    connection.close()
    return answer


def connected(port: int, origin: str | None, **headers: str) -> bool:
    protocols = [f"viser-v{viser.__version__}"]
    try:
        with connect(
            f"ws://{HERE}:{port}",
            origin=origin,
            subprotocols=protocols,
            additional_headers=headers,
        ) as socket:
            return bool(socket.recv(timeout=10))
    except InvalidStatus as refused:
        assert refused.response.status_code == 403
        return False


@pytest.mark.parametrize("port", [""], indirect=True)
def test_the_server_refuses_other_hosts_and_origins(port: int) -> None:
    assert asked(port).status == 200
    assert asked(port, Host="evil.example").status == 403
    assert asked(port, Origin="http://evil.example").status == 403
    assert connected(port, None) and connected(port, f"http://{HERE}:{port}")
    assert not connected(port, "http://evil.example")


@pytest.mark.parametrize("port", [TOKEN], indirect=True)
def test_on_other_addresses_a_browser_needs_the_token(port: int) -> None:
    """In the address of the page; its websocket brings the cookie that came with the page."""
    for path in ("/", "/?token=", "/?token=b-token", "/?token=%ff", "/?", "//["):
        refused = asked(port, path, Cookie="cube_view_1=\xff")
        assert refused.status == 403 and b"with ?token=" in refused.text
    page = asked(port, f"/?token={TOKEN}", Host=f"skin.example:{port}")
    assert page.status == 200 and b"<html" in page.text
    cookie, *rules = page.headers["Set-Cookie"].split("; ")
    assert set(rules) == {"HttpOnly", "SameSite=Lax"}
    assert asked(port, Cookie=f"another=1; {cookie}").status == 200
    assert not connected(port, None)
    assert connected(port, f"http://{HERE}:{port}", Cookie=cookie)
    assert not connected(port, "http://evil.example", Cookie=cookie)


@pytest.mark.parametrize("host", ["192.0.2.1", "a" * 64 + ".b"])
def test_an_address_that_cannot_be_had_is_refused(host: str) -> None:
    with pytest.raises(ConfigError, match="--host"):
        Gate(host, 0, "", (HERE, 1))


def test_the_next_port_is_taken_and_a_silent_browser_does_not_hinder_the_end(caplog) -> None:
    first = Gate(HERE, 0, "", (HERE, 1))
    second = Gate(HERE, first.port, "", (HERE, 1))
    assert second.port > first.port
    with socket.create_connection((HERE, second.port)) as silent:
        silent.sendall(b"GET")
        # Whoever came before an answer is connected by then.
        assert asked(second.port, Host="evil.example").status == 403
        second.close()
    first.close()
    assert not caplog.records


def test_viser_itself_listens_at_no_address_that_a_page_could_guess(caplog) -> None:
    first, second = make_secret_address(), make_secret_address()
    assert not caplog.messages and first != second and HERE not in (first, second)
    server = viser.ViserServer(first, 0, verbose=False)
    for address in (HERE, second):
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((address, server.get_port()))
    server.stop()


def test_a_system_without_secret_addresses_has_the_view_too(caplog) -> None:
    """No machine has an address of 240.x.x.x, which is reserved, as macOS has none of 127.x.x.x."""
    address = make_secret_address("240.0.0.1")
    (warning,) = caplog.messages
    assert address == HERE and "tries all ports" in warning
    server = viser.ViserServer(address, 0, verbose=False)
    gate = Gate(HERE, 0, "", (address, server.get_port()))
    assert gate.port != server.get_port() and connected(gate.port, f"http://{HERE}:{gate.port}")
    assert not connected(gate.port, "http://evil.example")
    server.stop()
    gate.close()


def test_values_that_no_control_offers_do_no_harm() -> None:
    """A browser may send any."""

    def control(value: object) -> SimpleNamespace:
        return SimpleNamespace(value=value)

    gui = SimpleNamespace(
        add_dropdown=lambda *_: control("no such quantity"),
        add_number=lambda *_, **__: control(float("nan")),
        add_html=control,
    )
    controls = ColourControls(gui)
    assert controls.quantity in QUANTITIES.values()
    assert controls.fixed_top == 0.0


def test_saved_tables_and_pictures_hold_what_the_cubes_showed() -> None:
    """c1 sees σzz and its gradient, no cube sees the others."""
    zz, zz_x = History.COLUMNS.index("zz"), History.COLUMNS.index("zz_x")
    history = History(3)
    for number in range(5):  # two more than are kept
        values = np.full((2, len(COMPONENTS)), np.nan)
        values[1, [zz, zz_x]] = -1000.0 * number, 2e6
        history.add(10 + 0.5 * number, values, np.array([np.nan, 1.25]))
    table = list(csv.reader(io.StringIO(format_csv(history, [1], ["c0", "c1"]).decode())))
    assert table == [
        ["time / s", "c1 zz / Pa", "c1 zz_x / Pa/m", "c1 residual / 1"],
        ["-1", "-2000", "2e+06", "1.25"],
        ["-0.5", "-3000", "2e+06", "1.25"],
        ["0", "-4000", "2e+06", "1.25"],
    ]
    panels = [("normal stress / kPa", {"c1": history.select(1, zz) / 1e3})]
    (axis,) = (figure := draw_panels(history.times, "time before now / s", panels)).axes
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("time before now / s", "normal stress / kPa")
    np.testing.assert_allclose(axis.lines[0].get_xydata(), [[-1, -2], [-0.5, -3], [0, -4]])
    with Image.open(io.BytesIO(render_png(figure))) as picture:
        assert picture.format == "PNG" and min(picture.size) > 400


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((-14.6, 0.01), (-20, 0)),
        ((-14.6, 3.0), (-20, 10)),
        ((-0.01, 4.0), (0, 5)),
        ((0, 0), (0, 0)),
    ],
)
def test_axes_end_at_round_numbers_and_give_noise_no_room(values, expected) -> None:
    np.testing.assert_allclose(round_range(*values), expected, atol=1e-8)
