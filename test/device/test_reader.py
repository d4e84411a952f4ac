# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The reader over real pseudo-terminals and TCP sockets; the test plays the hub on the other end,
frame by frame."""

from __future__ import annotations

import logging
import os
import queue
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from conftest import open_files
from cube_tensor_driver.core.errors import LinkError
from cube_tensor_driver.device.links import reader as reader_module
from cube_tensor_driver.device.links import session as session_module
from cube_tensor_driver.device.links import tcp
from cube_tensor_driver.device.links.link import Link, LinkConfig, LinkState
from cube_tensor_driver.device.links.reader import LinkFrames, LinkRead, NativeSamples, Reader
from cube_tensor_driver.device.wire import native
from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import (
    Ack,
    Command,
    Frame,
    Hello,
    Request,
    Result,
    Sample,
    Stats,
    Time,
    encode,
)

WAIT_S = 5.0  # ends a failing test; nothing is measured with it
BACK_S = 2.0  # limit of the issue: a link is back so soon after its port
SILENT_S = 0.2  # limit of the issue
SCHEDULER_S = 0.3  # what a busy test machine may add to either

F = TypeVar("F", bound=Frame)


class FakeHub:
    """The device's end of a link: frames out, requests in."""

    def __init__(
        self, send: Callable[[bytes], object], receive: Callable[[], bytes], fd: int
    ) -> None:
        self.send, self._receive, self._fd = send, receive, fd
        self._decoder = Decoder()
        self._inbox: list[Frame] = []

    def expect(self, command: Command) -> Request:
        """The next request of this kind; others before it are passed over."""
        until = time.monotonic() + WAIT_S
        while True:
            while self._inbox:
                frame = self._inbox.pop(0)
                if isinstance(frame, Request) and frame.request == command:
                    return frame
            ready, _, _ = select.select([self._fd], [], [], max(0.0, until - time.monotonic()))
            if not ready:
                raise TimeoutError(f"no {command.name} request")
            self._inbox += self._decoder.feed(self._receive())

    def before(self, command: Command) -> list[int]:
        """The requests that come before the next one of this kind."""
        passed: list[int] = []
        until = time.monotonic() + WAIT_S
        while time.monotonic() < until:
            while self._inbox:
                frame = self._inbox.pop(0)
                if isinstance(frame, Request):
                    if frame.request == command:
                        return passed
                    passed.append(frame.request)
            if select.select([self._fd], [], [], 0.1)[0]:
                self._inbox += self._decoder.feed(self._receive())
        raise TimeoutError(f"no {command.name} request")

    def hello(self, uid: int = 0xC0FFEE, period_us: int = 10_000) -> None:
        self.send(encode(Hello(uid, 1, 8, period_us, np.arange(2, dtype="<u8"))))

    def sample(self, *sequences: int) -> None:
        self.send(b"".join(encode(make_sample(sequence)) for sequence in sequences))

    def greet(self, uid: int = 0xC0FFEE, period_us: int = 10_000) -> None:
        self.expect(Command.HELLO)
        self.hello(uid, period_us)
        self.expect(Command.START)


def make_sample(sequence: int) -> Sample:
    frequency = np.full((2, 8), sequence, "<u4")
    return Sample(sequence, 0, 1000 * sequence, frequency, np.zeros(2, "<u4"), np.zeros(2, "<i2"))


class PtyHub(FakeHub):
    """A hub on a pseudo-terminal, under a symbolic link where the test wants it."""

    def __init__(self, path: Path | None = None) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self._path = path
        super().__init__(lambda data: os.write(self.master, data), self._receive_bytes, self.master)
        if path is not None:
            path.symlink_to(self.port)
            self.port = str(path)

    def _receive_bytes(self) -> bytes:
        return os.read(self.master, 4096)

    def unplug(self) -> None:
        if self._path is not None:
            self._path.unlink(missing_ok=True)
            self._path = None
        if self.master >= 0:
            os.close(self.master)
            os.close(self.slave)
        self.master = -1


class Watch:
    """A reader, and what it called back, to be waited for."""

    def __init__(self, *configs: LinkConfig, **options: object) -> None:
        self.batches: list[list[tuple[int, int, Frame]]] = []  # a frame each, as they came
        self.frames: queue.Queue[tuple[int, int, Frame]] = queue.Queue()
        self.states: queue.Queue[tuple[int, LinkState, LinkError | None, float]] = queue.Queue()
        self.reader = Reader(configs, self._on_frames, self._on_state, **options)  # type: ignore[arg-type]

    def _on_frames(self, received: list[LinkFrames], _native: NativeSamples) -> None:
        self.batches.append(
            [
                (link, arrival_ns, frame)
                for link, arrival_ns, frames, *_ in received
                for frame in frames
            ]
        )
        for item in self.batches[-1]:
            self.frames.put(item)

    def mark(self) -> None:
        """Send IDENTIFY, which the reader never sends, to mark a time among the requests."""
        # `Link.write` is for the reader's thread only: it changes the bytes that wait to be sent.
        os.write(self.reader.links[0].fileno(), encode(Request(Command.IDENTIFY)))

    def _on_state(self, link: int, state: LinkState, error: LinkError | None) -> None:
        self.states.put((link, state, error, time.monotonic()))

    def state(self, state: LinkState, kind: str | None = None, link: int = 0):
        """Wait for a state of a link; others before it are passed over."""
        while True:
            index, found, error, at = self.states.get(timeout=WAIT_S)
            if (index, found, error.kind if error else None) == (link, state, kind):
                return error, at

    def frame(self, kind: type[F], link: int = 0) -> F:
        while True:
            index, _, frame = self.frames.get(timeout=WAIT_S)
            if index == link and isinstance(frame, kind):
                return frame


Start = Callable[..., Watch]


@pytest.fixture
def start() -> Iterator[Start]:
    """Start readers that are closed, and seen to have ended in time, when the test is over."""
    watches = []

    def begin(*configs: LinkConfig, **options: object) -> Watch:
        watches.append(Watch(*configs, **options))
        watches[-1].reader.start()
        return watches[-1]

    yield begin
    for watch in watches:
        began = time.monotonic()
        watch.reader.close()
        assert time.monotonic() - began < 1.0
        assert [link.state for link in watch.reader.links] == [LinkState.CLOSED] * len(
            watch.reader.links
        )
    assert not [thread for thread in threading.enumerate() if thread.name == "cube reader"]


@pytest.fixture
def hub() -> Iterator[PtyHub]:
    hub = PtyHub()
    yield hub
    hub.unplug()


def test_session(start: Start, hub: PtyHub) -> None:
    """Hello asked for, period and start sent, samples delivered in order, stop at the end."""
    ticks = iter(range(1_000_000))
    watch = start(LinkConfig("a", hub.port), clock_ns=lambda: next(ticks), period_us=5000)
    hub.expect(Command.HELLO)
    hub.hello()
    assert hub.expect(Command.SET_PERIOD).argument == 5000
    hub.expect(Command.START)
    hub.sample(1, 2, 3)
    assert [watch.frame(Sample).sequence for _ in range(3)] == [1, 2, 3]
    hub.send(encode(Stats(1, 2, 3)) + encode(Ack(2)))
    assert watch.frame(Stats) == Stats(1, 2, 3)
    assert watch.frame(Ack) == Ack(2)
    arrivals = [arrival_ns for batch in watch.batches for _, arrival_ns, _ in batch]
    assert arrivals == sorted(arrivals)
    assert set(arrivals) < set(range(1000)), "arrival must be read from the clock given"
    link = watch.reader.links[0]
    assert link.hello is not None
    assert link.hello.hub_uid == 0xC0FFEE
    assert link.counters["frames"] == 6
    assert (link.state, link.error) == (LinkState.OPEN, None)
    watch.reader.close()
    hub.expect(Command.STOP)


def test_one_callback_for_all_that_is_there(start: Start, hub: PtyHub) -> None:
    watch = start(LinkConfig("a", hub.port))
    hub.greet()
    hub.sample(*range(10))
    assert [watch.frame(Sample).sequence for _ in range(10)] == list(range(10))
    # The kernel may hand over one write in two pieces, not in ten.
    assert (
        sum(any(isinstance(frame, Sample) for _, _, frame in batch) for batch in watch.batches) <= 3
    )


@pytest.mark.alone
@pytest.mark.skipif(native.wire is None, reason="Python waits for nobody")
@pytest.mark.parametrize("period_us", [1_000, 1_000_000])
def test_who_comes_first_waits_for_those_that_deliver(
    start: Start, hub: PtyHub, monkeypatch: pytest.MonkeyPatch, period_us: int
) -> None:
    """At most for a part of the sample period: 0.2 ms of the short one, 0.2 s of the long
    one."""
    monkeypatch.setattr(reader_module, "MAX_WAIT_S", 5.0)
    later = PtyHub()
    watch = start(LinkConfig("a", hub.port), LinkConfig("b", later.port))
    hub.greet(period_us=period_us)
    later.greet(period_us=period_us)
    watch.frame(Hello, link=1)
    for k in range(10):
        hub.sample(k)
        time.sleep(
            0.013
        )  # with the pause no multiple of TICK_S, at which the reader looks up anyway
        later.sample(k)
        watch.frame(Sample, link=1)
        time.sleep(0.01)
    together = [
        {link for link, _, frame in batch if isinstance(frame, Sample)} for batch in watch.batches
    ].count({0, 1})
    if period_us == 1_000:
        assert together <= 2  # the scheduler may have held up the reader
    else:
        assert together >= 8  # the reader may have been awake already
    later.unplug()


def test_what_follows_a_loss_is_not_looked_at(hub: PtyHub) -> None:
    """Two looks of one wake-up may both find the port gone; frames of before the loss are delivered
    all the same."""
    reader = Reader([LinkConfig("a", hub.port)], lambda *batch: None, lambda *state: None)
    (link,) = reader.links
    link.open()
    hello, sample = Hello(0xC0FFEE, 1, 8, 10_000, np.arange(2, dtype="<u8")), make_sample(1)
    lost = LinkError("gone", "lost")
    reads = [(5, [hello, sample]), (6, lost), (7, lost), (8, [sample])]
    read = [LinkRead(0, at, result) for at, result in reads]
    received, failed = reader._handle_reads(read, False)
    assert [(at, frames) for _, at, frames, *_ in received] == [(5, [hello, sample])]
    assert failed == {0: lost}
    # Closed after the frames are delivered: a link that delivers is waited for.
    assert link.is_open
    link.close()


def test_started_before_the_port_exists(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "hub"
    watch = start(LinkConfig("a", str(port)))
    error, _ = watch.state(LinkState.WAITING, "no_port")
    assert "plug the hub in" in str(error)
    hub = PtyHub(port)
    plugged = time.monotonic()
    _, at = watch.state(LinkState.OPEN)
    assert at - plugged < BACK_S
    hub.greet()
    hub.sample(7)
    assert watch.frame(Sample).sequence == 7
    hub.unplug()


def test_replugged_under_a_new_device(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "hub"
    hub = PtyHub(port)
    watch = start(LinkConfig("a", str(port)), period_us=2500)
    hub.greet()
    hub.sample(1)
    watch.frame(Sample)
    for k in range(3):
        hub.send(encode(make_sample(99))[:-9])  # cut off by the unplugging
        watch.state(LinkState.OPEN)
        hub.unplug()
        watch.state(LinkState.WAITING, "lost")
        watch.state(LinkState.WAITING, "no_port")
        hub = PtyHub(port)
        plugged = time.monotonic()
        _, at = watch.state(LinkState.OPEN)
        assert at - plugged < BACK_S
        watch.states.put((0, LinkState.OPEN, None, at))
        hub.expect(Command.HELLO)
        hub.hello()
        assert hub.expect(Command.SET_PERIOD).argument == 2500
        hub.expect(Command.START)
        hub.sample(10 + k)
        assert watch.frame(Sample).sequence == 10 + k
    counters = watch.reader.links[0].counters
    assert (counters["opened"], counters["lost"]) == (4, 3)
    hub.unplug()


def test_return_after_a_long_absence_resets_the_pause(
    start: Start, tmp_path: Path, monkeypatch
) -> None:
    """The pause has grown to its limit; the port's return ends it."""
    monkeypatch.setattr("cube_tensor_driver.device.links.link.MIN_PAUSE_S", 60.0)
    port = tmp_path / "hub"
    watch = start(LinkConfig("a", str(port)))
    watch.state(LinkState.WAITING, "no_port")
    hub = PtyHub(port)
    plugged = time.monotonic()
    _, at = watch.state(LinkState.OPEN)
    assert at - plugged < BACK_S
    hub.unplug()


def test_no_sample_before_hello_is_delivered(start: Start, hub: PtyHub) -> None:
    """Behind a port that was opened anew may be another hub."""
    watch = start(LinkConfig("a", hub.port))
    hub.expect(Command.HELLO)
    hub.sample(1, 2)
    hub.hello()
    hub.sample(3)
    assert watch.frame(Sample).sequence == 3
    assert watch.reader.links[0].counters["before_hello"] == 2
    assert isinstance(watch.batches[0][0][2], Hello)


def test_wrong_hub_is_refused_and_the_right_one_found(start: Start, tmp_path: Path) -> None:
    """Two matches of a pattern, the wanted hub on the second; then it comes back under the first
    one's name."""
    wrong, right = PtyHub(tmp_path / "hub0"), PtyHub(tmp_path / "hub1")
    watch = start(LinkConfig("a", str(tmp_path / "hub*"), hub_uid=0xB))
    wrong.expect(Command.HELLO)
    wrong.sample(66)
    wrong.hello(uid=0xA)
    error, _ = watch.state(LinkState.WAITING, "wrong_hub")
    assert "0x000000000000000a" in str(error)
    assert "0x000000000000000b" in str(error)
    right.greet(uid=0xB)
    right.sample(1)
    assert watch.frame(Sample).sequence == 1
    wrong.unplug()
    right.unplug()
    watch.state(LinkState.WAITING, "no_port")
    back = PtyHub(tmp_path / "hub0")
    back.greet(uid=0xB)
    back.sample(2)
    assert watch.frame(Sample).sequence == 2
    greeted = {
        frame.hub_uid
        for batch in watch.batches
        for _, _, frame in batch
        if isinstance(frame, Hello)
    }
    assert greeted == {0xB}
    back.unplug()


def test_silence_is_noticed_and_healed(start: Start, hub: PtyHub) -> None:
    watch = start(LinkConfig("a", hub.port), period_us=10_000)
    hub.greet()
    hub.sample(1)
    watch.frame(Sample)
    watch.state(LinkState.OPEN)
    last = time.monotonic()
    error, at = watch.state(LinkState.SILENT, "silent")
    assert SILENT_S / 2 < at - last < SILENT_S + SCHEDULER_S
    assert "10000 µs" in str(error)
    # A hub that restarted says HELLO and waits to be told what to do; it is asked at once.
    hub.expect(Command.HELLO)
    assert time.monotonic() - at < SCHEDULER_S
    hub.hello()
    hub.expect(Command.START)
    hub.sample(2)
    watch.state(LinkState.OPEN)
    assert watch.reader.links[0].counters["silences"] == 1


@pytest.mark.parametrize(
    ("result", "period_us", "problem"),
    [
        (Result.DONE, 2501, ""),
        (Result.DONE, 3000, "every 3000 µs, asked for were 2500 µs: set a rate that it can do"),
        (Result.REFUSED, 10_000, "every 10000 µs, asked for were 2500 µs, which it refused"),
        (Result.UNKNOWN, 10_000, "every 10000 µs, asked for were 2500 µs, and it cannot change"),
        (Result.UNKNOWN, 2500, ""),
    ],
)
def test_a_hub_with_another_period_is_asked_once_and_named(
    start: Start, hub: PtyHub, monkeypatch, result: Result, period_us: int, problem: str
) -> None:
    """It may round, and it may refuse: each HELLO says so again, and is not answered."""
    # On a busy machine the link may be silent before the first sample, and HELLO is answered then.
    monkeypatch.setattr(session_module, "SILENT_S", 60.0)
    watch = start(LinkConfig("a", hub.port), period_us=2500)
    hub.greet(period_us=period_us)
    # Of a request that is not known the argument is 0 (rule R2), or that of the request.
    argument = 0 if result == Result.UNKNOWN else period_us
    hub.send(encode(Ack(Command.SET_PERIOD, result, argument)))
    for _ in range(3):
        hub.hello(period_us=period_us)
    hub.sample(1)
    watch.frame(Sample)
    watch.mark()
    between = hub.before(Command.IDENTIFY)
    assert Command.SET_PERIOD not in between
    assert problem in watch.reader.links[0].period_problem
    assert bool(problem) == bool(watch.reader.links[0].period_problem)
    # A hub that restarted and forgot it is told again.
    hub.hello(period_us=period_us + 7)
    assert hub.expect(Command.SET_PERIOD).argument == 2500


def test_hub_that_does_not_answer_is_asked_again(start: Start, hub: PtyHub, monkeypatch) -> None:
    monkeypatch.setattr(session_module, "HELLO_S", 0.05)
    start(LinkConfig("a", hub.port))
    for _ in range(3):
        hub.expect(Command.HELLO)
    hub.greet()


def test_answer_of_the_hub_resets_the_pause(start: Start, hub: PtyHub) -> None:
    watch = start(LinkConfig("a", hub.port))
    watch.state(LinkState.OPEN)
    for _ in range(5):
        watch.reader.links[0].increase_pause()
    hub.greet()
    watch.frame(Hello)
    assert watch.reader.links[0].increase_pause() == 0.25


def test_samples_that_are_handled_in_c_are_no_silence(hub: PtyHub) -> None:
    """They do not come as frames; the session sees their number at its timers."""
    link = Link(LinkConfig("a", hub.port))
    session = session_module.Session(link, None, time.time_ns, lambda *_: None)
    now = time.monotonic()
    assert session.open(now)
    for second in (0.5, 1.0, 1.5):
        link.track.n_native += 1
        session.check_timers(now + second)
        assert link.state is LinkState.OPEN
    session.check_timers(now + 2.0)
    assert link.state is LinkState.SILENT
    link.close()


def test_slow_samples_are_not_silence(start: Start, hub: PtyHub) -> None:
    """At 0.3 s a sample, silence begins after 0.9 s."""
    watch = start(LinkConfig("a", hub.port))
    hub.greet(period_us=300_000)
    hub.sample(1)
    watch.frame(Sample)
    last = time.monotonic()
    watch.states.queue.clear()
    _, at = watch.state(LinkState.SILENT, "silent")
    assert 0.9 - 0.05 <= at - last < 0.9 + SCHEDULER_S


def test_link_without_a_byte_is_opened_anew(start: Start, hub: PtyHub, monkeypatch) -> None:
    monkeypatch.setattr(session_module, "REOPEN_S", 0.4)
    watch = start(LinkConfig("a", hub.port))
    watch.state(LinkState.WAITING, "silent")
    watch.state(LinkState.OPEN)
    hub.greet()


def test_the_period_is_remembered_over_a_reopening(start: Start, tmp_path: Path) -> None:
    port = tmp_path / "hub"
    watch = start(LinkConfig("a", str(port)))
    watch.state(LinkState.WAITING, "no_port")
    watch.reader.set_period(0, 4000)
    for _ in range(2):
        hub = PtyHub(port)
        hub.expect(Command.HELLO)
        hub.hello()
        assert hub.expect(Command.SET_PERIOD).argument == 4000
        hub.expect(Command.START)
        hub.unplug()
        watch.state(LinkState.WAITING, "no_port")
    hub = PtyHub(port)
    hub.greet(period_us=4000)
    watch.reader.set_period(0, 5000)
    assert hub.expect(Command.SET_PERIOD).argument == 5000
    hub.unplug()


def test_busy_port_is_waited_for(start: Start, hub: PtyHub) -> None:
    first = start(LinkConfig("a", hub.port))
    hub.greet()
    second = start(LinkConfig("b", hub.port))
    error, _ = second.state(LinkState.WAITING, "busy")
    assert "another program" in str(error)
    first.reader.close()
    second.state(LinkState.OPEN)


def tcp_hub(server: socket.socket) -> tuple[FakeHub, socket.socket]:
    server.settimeout(WAIT_S)
    peer, _ = server.accept()
    return FakeHub(peer.sendall, lambda: peer.recv(4096), peer.fileno()), peer


def test_tcp_lost_and_back(start: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]
        watch = start(LinkConfig("a", f"socket://127.0.0.1:{number}"))
        hub, peer = tcp_hub(server)
        hub.greet()
        hub.sample(1)
        assert watch.frame(Sample).sequence == 1
    peer.close()
    watch.state(LinkState.WAITING, "lost")
    watch.state(LinkState.WAITING, "refused")
    with socket.create_server(("127.0.0.1", number)) as server:
        returned = time.monotonic()
        hub, peer = tcp_hub(server)
        assert time.monotonic() - returned < BACK_S
        hub.greet()
        hub.sample(2)
        assert watch.frame(Sample).sequence == 2
        peer.close()


def test_slow_links_delay_nobody(start: Start, hub: PtyHub, deaf: str, monkeypatch) -> None:
    """A host that never answers, a name look-up that hangs, a hub that never reads, and one that
    works."""
    hanging = threading.Event()
    look_up = socket.getaddrinfo

    def slow_look_up(host: str, *arguments: object, **options: object) -> list[object]:
        if host == "slow.invalid":
            if options.get("flags") == socket.AI_NUMERICHOST:
                raise socket.gaierror(socket.EAI_NONAME, "not a number")
            hanging.wait(12 * WAIT_S)
            raise socket.gaierror(socket.EAI_AGAIN, "gave up")
        return look_up(host, *arguments, **options)  # type: ignore[arg-type, return-value]

    monkeypatch.setattr(tcp.socket, "getaddrinfo", slow_look_up)
    deaf_hub = PtyHub()
    watch = start(
        LinkConfig("no answer", deaf),
        LinkConfig("no name", "socket://slow.invalid:5"),
        LinkConfig("deaf", deaf_hub.port),
        LinkConfig("good", hub.port),
    )
    hub.greet()
    watch.state(LinkState.OPEN, link=2)
    for _ in range(2000):
        watch.reader.set_period(2, 10_000)
    watch.state(LinkState.WAITING, "overflow", link=2)
    delays = []
    for k in range(200):
        sent = time.monotonic()
        hub.sample(k)
        assert watch.frame(Sample, link=3).sequence == k
        delays.append(time.monotonic() - sent)
    # The median, since any one delay can be the scheduler's: far below every time-out of the
    # slow links.
    assert np.median(delays) < 0.01
    for link in (0, 1):
        assert not watch.reader.links[link].is_open
    began = time.monotonic()
    watch.reader.close()
    assert time.monotonic() - began < 1.0
    hanging.set()
    deaf_hub.unplug()


@pytest.mark.parametrize("port", ["/nowhere/tty", "/nowhere/*", "socket://127.0.0.1:1", "deaf"])
def test_close_in_the_middle_of_a_reconnect(start: Start, port: str, deaf: str) -> None:
    port = deaf if port == "deaf" else port
    watch = start(LinkConfig("a", port))
    watch.state(LinkState.WAITING)
    began = time.monotonic()
    watch.reader.close()
    assert time.monotonic() - began < 0.5
    watch.state(LinkState.CLOSED)


def test_the_answer_to_the_last_question_for_the_time_is_delivered(
    start: Start, hub: PtyHub, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rule T5. Neither twice nor with another number; with the time of the question."""
    monkeypatch.setattr(session_module, "ASK_TIME_S", 0.05)
    clock = iter(range(1, 1_000_000))
    watch = start(LinkConfig("a", hub.port), clock_ns=lambda: next(clock))
    asked: list[tuple[int, int]] = []
    watch.reader._on_frames = lambda received, native: (
        asked.extend(
            (batch.asked_ns, batch.arrival_ns)
            for batch in received
            for frame in batch.frames
            if isinstance(frame, Time)
        ),
        watch._on_frames(received, native),
    )
    hub.greet()
    hub.sample(1)
    first = hub.expect(Command.TIME)
    wrong, right = Time(first.argument + 1, 5), Time(first.argument, 7)
    hub.send(encode(wrong) + encode(right) + encode(right) + encode(Stats(1, 2, 3)))
    watch.frame(Stats)
    times = [frame for batch in watch.batches for _, _, frame in batch if isinstance(frame, Time)]
    assert times == [right]
    ((asked_ns, arrival_ns),) = asked
    assert 0 < asked_ns < arrival_ns
    assert hub.expect(Command.TIME).argument == first.argument + 1


def test_a_hub_that_does_not_know_the_time_is_not_asked_again_until_it_restarts(
    start: Start, hub: PtyHub, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rule T4. The link falls silent after many times the interval of the questions."""
    monkeypatch.setattr(session_module, "ASK_TIME_S", 0.01)
    watch = start(LinkConfig("a", hub.port))
    hub.greet()
    hub.sample(1)
    hub.expect(Command.TIME)
    hub.send(encode(Ack(Command.TIME, Result.UNKNOWN)))
    watch.frame(Ack)
    watch.mark()
    hub.expect(Command.IDENTIFY)
    assert hub.before(Command.HELLO) == []
    hub.hello()
    hub.expect(Command.START)
    hub.sample(2)
    hub.expect(Command.TIME)


def test_failing_callback_does_not_end_the_reader(start: Start, hub: PtyHub, caplog) -> None:
    seen: queue.Queue[int] = queue.Queue()

    def on_frames(received: list[LinkFrames], _native: NativeSamples) -> None:
        for frame in (frame for _, _, frames, *_ in received for frame in frames):
            if isinstance(frame, Sample):
                seen.put(frame.sequence)
                raise RuntimeError("bug of the caller")

    watch = start(LinkConfig("a", hub.port))
    watch.reader._on_frames = on_frames
    hub.greet()
    with caplog.at_level(logging.ERROR):
        for k in range(3):
            hub.sample(k)
            assert seen.get(timeout=WAIT_S) == k
    watch.reader.close()
    assert watch.reader.callback_errors == 3
    assert len(caplog.records) == 1


def test_a_thread_that_ends_unasked_says_why_and_lets_go_of_the_ports(
    hub: PtyHub, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = threading.Event()
    reader = Reader(
        [LinkConfig("a", hub.port)],
        lambda *batch: None,
        lambda link, state, error: closed.set() if state is LinkState.CLOSED else None,
    )
    broken = OSError("not foreseen")

    read = reader_module.Intake.read

    def fail(*arguments: object) -> object:
        result = read(*arguments)
        if result[-1]:
            raise broken
        return result

    monkeypatch.setattr(reader_module.Intake, "read", fail)
    reader.start()
    hub.expect(Command.HELLO)
    assert reader.failure is None
    hub.hello()
    assert closed.wait(WAIT_S)
    assert reader.failure is broken and "not foreseen" in caplog.text
    reader.close()


def test_close_from_a_callback(hub: PtyHub) -> None:
    closed = threading.Event()
    reader = Reader(
        [LinkConfig("a", hub.port)],
        lambda *batch: reader.close(),
        lambda link, state, error: closed.set() if state is LinkState.CLOSED else None,
    )
    reader.start()
    hub.greet()
    assert closed.wait(WAIT_S)
    reader.close()


def test_a_reader_that_is_behind_knows_for_how_long(start: Start, hub: PtyHub) -> None:
    """A callback takes 0.1 s, and meanwhile the next sample comes."""
    watch = start(LinkConfig("a", hub.port))
    hub.greet()
    watch.frame(Hello)
    late: dict[int, bool] = {}

    def on_frames(received: list[LinkFrames], native: NativeSamples) -> None:
        samples = [frame for read in received for frame in read.frames if isinstance(frame, Sample)]
        late.update((sample.sequence, received[0].is_late) for sample in samples)
        if 1 in late and 2 not in late:
            hub.sample(2)
            until = time.monotonic() + 0.1
            while time.monotonic() < until:
                select.select([], [], [], 0.01)
        watch._on_frames(received, native)

    watch.reader.take_lag_s()
    watch.reader._on_frames = on_frames
    hub.sample(1)
    while watch.frame(Sample).sequence != 2:
        pass
    assert late[2]
    assert watch.reader.take_lag_s() >= 0.1


def test_one_thread_and_nothing_left_behind(hub: PtyHub) -> None:
    threads, files = threading.active_count(), open_files()
    for _ in range(30):
        links = [LinkConfig("a", hub.port), LinkConfig("b", "/nowhere")]
        reader = Reader(links, lambda *batch: None, lambda *state: None)
        reader.start()
        assert threading.active_count() == threads + 1
        hub.expect(Command.HELLO)
        reader.close()
        reader.close()
        reader.set_period(0, 5000)  # too late, and harmless
    assert (threading.active_count(), open_files()) == (threads, files)
