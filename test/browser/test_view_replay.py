# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A jump that a browser asks for is neither overwritten nor forgotten, however late things come."""

from __future__ import annotations

import time
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")
pytest.importorskip("viser", reason="needs viser")

from cube_tensor_driver.browser import clients
from cube_tensor_driver.browser.clients import MAX_ANSWER_S, ReplayClient, ServiceCalls
from cube_tensor_driver.browser.controls import ReplayControls
from cube_tensor_driver.core.latest_stress import STALE_S
from cube_tensor_driver.msg import ReplayState
from cube_tensor_driver.ros.commands.replay import ReplayControl
from cube_tensor_driver.srv import SteerReplay

END_S = 3.0


class Slider:
    """viser's: what a browser sends is its value at once, and an event later."""

    def __init__(self, value: float) -> None:
        self.value = value
        self.max = 1.0

    def on_update(self, callback) -> None:
        self.event = lambda: callback(SimpleNamespace(client="browser"))


@pytest.fixture
def page():
    """Slider and controls of a replay that is held at its end; `jumps` are those asked for."""
    jumps: list[float] = []
    slider = Slider(0.0)
    gui = SimpleNamespace(
        add_folder=lambda *_, **__: _Folder(),
        add_html=lambda _: SimpleNamespace(),
        add_slider=lambda *_: slider,
        add_button=lambda _: SimpleNamespace(on_click=lambda _: None),
    )
    waiting: list = []
    controls = ReplayControls(gui, hold=lambda: None, jump=waiting.append)
    show(controls, END_S)
    assert slider.value == END_S

    def act() -> None:
        jumps.extend(take_position() for take_position in waiting)
        waiting.clear()

    return SimpleNamespace(slider=slider, controls=controls, jumps=jumps, act=act)


class _Folder:
    visible = False

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None: ...


def show(controls: ReplayControls, position: float) -> None:
    controls.show(SimpleNamespace(position=position, length=END_S, paused=True))


def test_a_state_between_a_move_and_its_jump_does_not_overwrite_the_move(page):
    page.slider.value = 0.0
    show(page.controls, END_S)
    show(page.controls, END_S - 0.1)
    page.slider.event()
    show(page.controls, END_S)
    assert page.slider.value == 0.0
    page.act()
    assert page.jumps == [0.0]
    show(page.controls, 0.5)
    assert page.slider.value == 0.5


def test_no_number_is_put_back(page):
    page.slider.value = float("nan")
    page.slider.event()
    page.act()
    assert page.jumps == [END_S] and page.slider.value == END_S
    show(page.controls, 0.5)
    assert page.slider.value == 0.5


@pytest.fixture
def clock(monkeypatch):
    """Time of the client, s; what is added to `late` passes at once."""
    here = SimpleNamespace(late=0.0)
    monkeypatch.setattr(
        clients, "time", SimpleNamespace(monotonic=lambda: time.monotonic() + here.late)
    )
    return here


@pytest.fixture
def client(ros):
    said: list[str] = []

    def say(title: str, text: str, colour: str) -> None:
        said.append(f"{title}: {text}")

    replay = ReplayClient(ros.node, ServiceCalls(say), say)
    states = ros.node.create_publisher(ReplayState, "player/state", 1)

    def is_running() -> bool:
        """The replay says where it is until the client has heard it."""
        if replay.state is None:
            states.publish(ReplayState(position=END_S, length=END_S, paused=True))
        return replay.state is not None

    return SimpleNamespace(said=said, replay=replay, is_running=is_running)


def serve(ros) -> list[float]:
    """A replay that can be steered; the positions it is asked for."""
    asked: list[float] = []

    def steer(request: SteerReplay.Request, response: SteerReplay.Response):
        asked.append(request.position)
        response.success = True
        return response

    ros.node.create_service(SteerReplay, "player/steer", steer)
    return asked


def test_a_jump_waits_for_a_replay_that_is_silent_or_not_found_yet(ros, client, clock):
    ros.wait(client.is_running)
    client.replay.jump_to(0.0)
    assert not client.replay.update()
    clock.late += STALE_S + 0.1
    client.replay.forget_if_silent()
    # Meanwhile the page hides it, as it does all that is silent.
    assert client.replay.state is None and not client.replay.is_jumping
    asked = serve(ros)
    ros.wait(client.is_running)
    assert client.replay.is_jumping
    ros.wait(client.replay.update)
    ros.wait(lambda: asked == [0.0])
    ros.wait(lambda: not client.replay.update() and not client.replay.is_jumping)
    assert client.said == []


def test_the_state_of_a_replay_is_that_of_its_player():
    published = []
    node = Mock()
    node.create_publisher.return_value.publish = published.append
    player = SimpleNamespace(position=1.5, length=4.0, paused=True)
    ReplayControl(node, player)._publish_state()
    assert published == [ReplayState(position=1.5, length=4.0, paused=True)]


def test_a_jump_of_no_replay_is_said(ros, client, clock):
    client.replay.jump_to(0.0)
    assert not client.replay.update() and client.said == []
    clock.late += MAX_ANSWER_S + 0.1
    assert not client.replay.update()
    assert client.said == ["jump not possible: no replay is running"]
    ros.wait(client.is_running)
    assert not client.replay.is_jumping


def test_a_jump_without_an_answer_is_said_and_the_next_one_is_asked_for(ros, client, clock):
    asked = serve(ros)
    ros.wait(client.is_running)
    client.replay.jump_to(0.0)
    ros.wait(client.replay.update)
    client.replay.jump_to(1.0)
    assert not client.replay.update()
    # Nothing is spun: the answer does not come.
    clock.late += MAX_ANSWER_S + 0.1
    assert client.replay.update()
    assert client.said == ["jump failed: no answer within 10 s"]
    ros.wait(lambda: asked == [0.0, 1.0])
