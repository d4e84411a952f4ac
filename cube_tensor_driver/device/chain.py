# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The chain from bytes to rows: reader, sample counters, clocks and scans of all links of a skin.

`LiveLinks` calls back with rows in the thread of the reader. The driver node publishes them in that
thread; `live.py` puts them into a queue for a loop in Python.
"""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from ..core.errors import LinkError
from ..core.rows import FrequencyRows
from ..core.status import STAMP
from .clock.host_clock import HostClockWatch
from .clock.hub_clock import HubClock
from .links.intake import NO_SAMPLES, NativeSamples
from .links.link import Link, LinkConfig, LinkState
from .links.link_log import LinkLogger, Log
from .links.reader import LOGGED_ERRORS, LinkFrames, Reader
from .scans.cube_table import CubeAddress
from .scans.row_counts import RowCounts
from .scans.scan import MakeRows, ScanBuilder, make_empty_rows
from .scans.sequence import Arrival, SampleAccount
from .track import LinkTrack
from .wire.decoder import unpack_all
from .wire.native import NOT_COMPILED, wire
from .wire.protocol import VERSION, Ack, Command, Hello, Sample, Stats, Time

MAX_SCANS = 4
"""Maximum number of scans (one sample of every cube) in one call of `on_rows`, or `scans_per_call`
+ 1 if that is larger. After a pause of the process many scans wait; the limit keeps the memory that
one call needs small."""
MAX_EVENTS = 100
"""Number of changes of state (open, silent, closed …) of one link that are kept for the next
`LiveLinks.report`. If there are more, the oldest are discarded."""
MIN_LAG_S = 0.05
"""Minimum delay, in s, of this process in reading received bytes, above which lost samples are
attributed to a host that is too slow. The kernel's buffer of a serial port holds about what a hub
with many cubes sends in this time, so a shorter delay loses nothing."""
OVERLOAD_S = 0.5
"""Delay, in s, of this process in reading received bytes, above which lost samples show that the
host is too slow. The process then drops whole scans (one sample of every cube), until no sample was
lost and no scan dropped for this time. After a shorter delay it catches up without loss."""


@dataclass(frozen=True)
class LinkReport:
    """State of one link at the time of the report, and its problems since the report before.

    Attributes:
        name: Name of the link in the skin file.
        hub_uid: Unique number of the hub; None before its first HELLO frame.
        state: State at the time of the report.
        past_states: States other than OPEN that the link has had since the last report.
        notes: Texts of the problems that exist now or existed since the last report, each with its
            fix.
        values: Counters and clock values by name.
    """

    name: str
    hub_uid: int | None
    state: LinkState
    past_states: tuple[LinkState, ...]
    notes: tuple[str, ...]
    values: dict[str, object]


class _LinkRecord:
    """Data that `LiveLinks` keeps for one link.

    Args:
        name: Name of the link in the skin file.
        log: Logger for events of the link.

    Attributes:
        track: Sample numbers and clock values of the link, which `account` and `clock` change.
        account: Counters of the samples of the link: delivered, missing, duplicate.
        clock: Conversion of the device times of the hub to host time.
        logger: Logger of the link, which counts the lines that it left out.
        problems: Texts about the cubes of the hub that do not fit the skin file.
        events: States other than OPEN since the last report, and the reason of each.
        logged_version: Protocol version, other than the driver's, that was logged last for this
            link; None before.
        hub_changes: Number of HELLO frames that reported other cubes than the one before; the first
            HELLO counts, too.
        was_open: Whether the link has ever been open.
        reported: Counters of the samples at the last report.
    """

    def __init__(self, name: str, log: Log) -> None:
        self.track = LinkTrack()
        self.account = SampleAccount(self.track)
        self.clock = HubClock(self.track)
        self.logger = LinkLogger(name, log)
        self.problems: list[str] = []
        self.events: deque[tuple[LinkState, str]] = deque(maxlen=MAX_EVENTS)
        self.logged_version: int | None = None
        self.hub_changes = 0
        self.was_open = False
        self.reported: dict[str, int] = {}


class LiveLinks:
    """Reads the links of a skin and calls back with rows of frequencies (samples of cubes).

    Args:
        links: Port of each link, and the unique number of the hub that must answer there.
        cubes: For each cube of the skin, the unique number or the link and index to find it by.
        on_rows: Called in the reader's thread with the rows of complete scans (one sample of every
            cube). If `make_rows` returns the same memory again, the rows are valid only until the
            call returns.
        rate: Sample rate to request from the hubs, in Hz; with None the hubs keep their own rate.
        scans_per_call: Number of complete scans that one call of `on_rows` waits for.
        make_rows: Function that makes the arrays into which rows are written.
        clock_ns: Clock of the time stamps, in ns since the Unix epoch.
        is_host_clock: Function that returns whether `clock_ns` is now the host's clock and not a
            simulated time.
        log: Logger for events of the links; None stands for Python's logging.
        on_end: Called in the reader's thread when it ends, after `close` or because of an error.

    Raises:
        LinkError: With the kind `bad_port`: a port is neither a device path nor a TCP address.
    """

    def __init__(
        self,
        links: Sequence[LinkConfig],
        cubes: Sequence[CubeAddress],
        on_rows: Callable[[FrequencyRows], None],
        *,
        rate: float | None = None,
        scans_per_call: int = 1,
        make_rows: MakeRows = make_empty_rows,
        clock_ns: Callable[[], int] = time.time_ns,
        is_host_clock: Callable[[], bool] = lambda: True,
        log: Log | None = None,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._configs = tuple(links)
        self._scans = ScanBuilder(len(links), cubes, make_rows)
        self._rows = self._scans.counts
        self._on_rows = on_rows
        self._on_end = on_end
        self._rate = rate
        self._scans_per_call = scans_per_call
        self._max_scans = max(MAX_SCANS, scans_per_call + 1)
        self._clock_ns = clock_ns
        self._is_host_clock = is_host_clock
        self._clock_watch = HostClockWatch(clock_ns)
        self._log: Log = log or logging.getLogger(__name__)
        if wire is None:
            self._log.warning(NOT_COMPILED)
        self._records = [_LinkRecord(config.name, self._log) for config in self._configs]
        # This lock protects the sample counters and clocks, which the reader's thread changes and
        # `report` reads from another thread.
        self._lock = threading.RLock()
        self._was_clock_set = False  # whether the host's clock was set since the last `receive`
        self._errors = 0
        # Monotonic time, in s, until which scans are dropped because the host is too slow.
        self._overloaded_until = 0.0
        # Number of lost samples at the last call of `_is_overloaded`. If it grows while this
        # process reads late, the host is too slow. None if the process read in time at that call.
        self._missing_before: int | None = None
        self._reader = self._make_reader()

    def start(self) -> None:
        """Start the thread that opens the links and starts the hubs.

        It may be called again after `close`.
        """
        # A port that hangs in the kernel may keep the thread of the previous reader from ending, so
        # each start makes a new reader.
        self._reader = self._make_reader()
        self._reader.start()

    def _make_reader(self) -> Reader:
        return Reader(
            self._configs,
            on_frames=self.receive,
            on_state=self._on_state,
            clock_ns=self._read_clock,
            period_us=_compute_period_us(self._rate),
            on_end=self._on_end,
            tracks=[record.track for record in self._records],
        )

    def close(self) -> None:
        """Send STOP to the hubs, close the links and end the reader's thread.

        A second call does nothing.
        """
        self._reader.close()

    def set_rate(self, rate: float | None) -> None:
        """Request another sample rate, in Hz, from all hubs.

        With None nothing is sent, and after the next `start` the hubs keep their own rate.
        """
        self._rate = rate
        period_us = _compute_period_us(rate)
        if period_us is not None:
            for link in range(len(self._configs)):
                self._reader.set_period(link, period_us)

    @property
    def failure(self) -> Exception | None:
        """Error that ended the reader's thread; None while it runs or if it ended by `close`."""
        return self._reader.failure

    @property
    def callback_errors(self) -> int:
        """Number of exceptions raised in the reader's thread while frames were handled or rows
        delivered."""
        return self._errors + self._reader.callback_errors

    @property
    def cube_uids(self) -> dict[int, int]:
        """Unique number of each cube, as its hub reports it, by the index of the cube in the skin.

        A cube is missing until its hub has sent HELLO.
        """
        return self._scans.cubes.uids

    def count_rows(self) -> RowCounts:
        """Return how many rows have been delivered, left out for each reason, or lost so far.

        A row is one sample of one cube.
        """
        return replace(self._rows)

    def report(self) -> list[LinkReport]:
        """Return the state of each link, and its problems since the last call of this method."""
        links = zip(self._reader.links, self._records, strict=True)
        lag_s = self._reader.take_lag_s()
        with self._lock:
            return [_report(link, record, lag_s) for link, record in links]

    def receive(
        self,
        received: Sequence[LinkFrames],
        native: NativeSamples = NO_SAMPLES,
    ) -> None:
        """Handle what the links have sent, and call `on_rows` with the rows of complete scans.

        A row is one sample of one cube, a scan one sample of every cube.

        The reader's thread calls this method once each time it has read data.

        Args:
            received: Frames of the links.
            native: Samples that came before these frames and that the module in C has counted and
                stamped already.
        """
        samples = unpack_all(native.raws)
        for link, sample, stamp_ns in zip(native.links, samples, native.stamps_ns, strict=True):
            if isinstance(sample, Sample):
                self._rows.received += sample.n_cubes
                self._scans.add(link, sample, stamp_ns)
        if received:
            self._handle_received(received)
        self._was_clock_set = False
        self._deliver()
        self._rows.check(self._scans.count_rows_waiting())

    def _is_overloaded(self) -> bool:
        """Return whether scans (one sample of every cube) must be dropped, as the host is too slow.

        Scans must be dropped if this process reads received bytes too late by `OVERLOAD_S` and
        samples are lost. If it reads late but nothing is lost, everything is delivered. The oldest
        scans are dropped as a whole, so that the others are complete and late by a few sample
        periods at most. Otherwise the kernel and the hubs would drop samples at random, and scans
        with gaps cost more time than complete ones.
        """
        now = time.monotonic()
        if self._reader.behind_s > OVERLOAD_S:
            n_missing = sum(record.account.missing for record in self._records)
            if self._missing_before is not None and n_missing > self._missing_before:
                self._overloaded_until = now + OVERLOAD_S
            self._missing_before = n_missing
        else:
            self._missing_before = None
        return now < self._overloaded_until

    def _handle_received(self, received: Sequence[LinkFrames]) -> None:
        """Handle frames that the module in C does not handle itself, for example HELLO.

        Args:
            received: Frames of each read of a link.
        """
        with self._lock:
            now_ns = self._read_clock()
            for read in received:
                if self._was_clock_set:
                    # The arrival time may be from before the host's clock was set, so it is
                    # replaced. An answer to TIME is not used, because it would compare host times
                    # before and after the step.
                    read = read._replace(arrival_ns=now_ns, asked_ns=0)
                # All rows are counted before any frame is handled, because an error in one frame
                # loses the rows of all later ones.
                for frame in read.frames:
                    if isinstance(frame, Sample):
                        self._rows.received += frame.n_cubes
                try:
                    self._handle_frames(read)
                except Exception as error:  # noqa: BLE001  (other links must still be handled)
                    self._count_error(error)

    def _read_clock(self) -> int:
        """Return the time of the host's clock, in ns.

        If the clock was set since the last call, all stored host times are moved by the step.
        """
        now_ns, step_ns = self._clock_watch.look()
        if not step_ns or not self._is_host_clock():
            return now_ns
        self._was_clock_set = True
        text = f"the host's clock was set by {1e-9 * step_ns:+.6g} s: stamps follow it at once"
        self._log.warning(text)
        with self._lock:
            for record in self._records:
                record.clock.shift(step_ns)
                record.clock.problems.add(text)
        self._reader.forget_questions()
        return now_ns

    def _handle_frames(self, read: LinkFrames) -> None:
        """Count the frames of one read of a link and add their samples to the scans.

        Args:
            read: The frames, with their link and arrival time.
        """
        record = self._records[read.link]
        samples: list[Sample] = []
        for frame in read.frames:
            if isinstance(frame, Sample):
                arrival = record.account.classify(frame)
                if arrival is Arrival.RESET:
                    self._add_samples(read, samples)
                    samples = []
                    record.clock.reset()
                if arrival is Arrival.DUPLICATE:
                    self._rows.duplicate += frame.n_cubes
                else:
                    samples.append(frame)
            elif isinstance(frame, Hello):
                record.account.announce(frame.n_cubes, frame.n_pads)
                self._learn_cubes(read.link, frame)
            elif isinstance(frame, Time):
                if read.asked_ns:
                    record.clock.add_answer(
                        read.asked_ns,
                        frame.device_us,
                        read.arrival_ns,
                    )
            elif isinstance(frame, Stats):
                record.account.add_stats(frame)
            elif isinstance(frame, Ack) and frame.request == Command.START:
                record.account.expect_restart()
            elif isinstance(frame, Ack) and frame.request == Command.SET_PERIOD:
                self._add_samples(read, samples)
                samples = []
                record.clock.forget_period()
                record.track.is_native_allowed = False
        self._add_samples(read, samples)

    def _add_samples(self, read: LinkFrames, samples: Sequence[Sample]) -> None:
        """Convert the times of samples from the hub's to the host's clock, and add them to scans.

        A scan is one sample of every cube.

        Args:
            read: The frames that hold the samples, with their link and arrival time.
            samples: The samples, in order.
        """
        if not samples:
            return
        record = self._records[read.link]
        clock = record.clock
        device_us = [sample.device_us for sample in samples]
        numbers = [sample.sequence for sample in samples]
        stamps_ns = clock.update(
            device_us,
            read.arrival_ns,
            numbers,
            read.is_late,
        )
        status = STAMP if clock.in_doubt else 0
        for sample, stamp_ns in zip(samples, stamps_ns, strict=True):
            self._scans.add(read.link, sample, stamp_ns, status)
        record.track.is_native_allowed = record.account.has_whole_samples and clock.is_steady

    def _deliver(self) -> None:
        """Call `on_rows` with the rows (samples of cubes) of all complete scans.

        A scan (one sample of every cube) that holds no cube of the skin has no rows and is
        discarded. If this host is too slow, the oldest scans are dropped and counted instead.
        """
        if self._is_overloaded():
            n_dropped = self._scans.drop_oldest(self._max_scans)
            self._rows.overload += n_dropped
            if n_dropped:
                self._overloaded_until = time.monotonic() + OVERLOAD_S
        while self._scans.is_complete(self._scans_per_call):
            try:
                rows = self._scans.build(self._max_scans)
                if rows is not None:
                    self._on_rows(rows)
                    self._rows.delivered += len(rows)
            except Exception as error:  # noqa: BLE001  (later rows must still be delivered)
                self._count_error(error)

    def _count_error(self, error: Exception) -> None:
        """Count and log an error, and count the rows (samples of cubes) that it has lost."""
        lost = self._rows.count_lost(self._scans.count_rows_waiting(), error)
        self._errors += 1
        if self._errors in LOGGED_ERRORS:
            self._log.error(
                f"{lost} rows lost by an error ({self._errors} errors so far); reading goes on\n"
                f"{traceback.format_exc()}"
            )

    def _learn_cubes(self, link: int, hello: Hello) -> None:
        """Find the cubes of a hub in the skin, and log them if they have changed.

        Args:
            link: Index of the link.
            hello: HELLO frame of the hub, which lists the unique numbers of its cubes.
        """
        problems = self._scans.cubes.learn(link, hello)
        if problems is None:
            return
        record = self._records[link]
        record.problems = problems
        record.hub_changes += 1
        cubes = f"{hello.n_cubes} cubes of {hello.n_pads} pads"
        record.logger.info(f"hub {hello.hub_uid:#x} with {cubes}")
        for problem in problems:
            record.logger.error(problem)

    def _on_state(
        self,
        link: int,
        state: LinkState,
        error: LinkError | None,
    ) -> None:
        """Log a change of the state of a link, and keep it for the next report.

        Args:
            link: Index of the link.
            state: The new state.
            error: Reason of the state; None if there is none.
        """
        record = self._records[link]
        record.was_open |= state is LinkState.OPEN
        if state is not LinkState.OPEN:
            record.track.is_native_allowed = False
            record.account.expect_restart()
            # A link that is WAITING without an error was just started, which is not reported.
            if error is not None or state is LinkState.CLOSED:
                record.events.append((state, str(error or state.value)))
            self._scans.forget(link)
            self._deliver()

        # A missing port of a simulator is not logged before the link was open for the first time,
        # because the simulator may make the port later.
        is_expected = self._configs[link].is_simulated and not record.was_open
        if error is None or error.kind != "no_port" or not is_expected:
            record.logger.change(state, error)


def _report(link: Link, record: _LinkRecord, lag_s: float) -> LinkReport:
    """Return the report of one link, and clear its problems and past states.

    Args:
        link: The link.
        record: Data that is kept for the link.
        lag_s: Longest time since the last report for which received bytes waited to be read, in s.
    """
    counters = record.account.count_samples()
    notes = [] if link.error is None else [str(link.error)]
    notes += _describe_losses(record.reported, counters, lag_s)
    notes += record.problems
    record.reported = counters
    if link.period_problem:
        notes.append(link.period_problem)

    other = link.decoder.other_version
    if other is not None:
        notes.append(
            f"the hub speaks protocol version {other}, this driver version {VERSION}: "
            "update the older one"
        )
        if other != record.logged_version:
            record.logged_version = other
            record.logger.error(notes[-1])

    # The reader's thread may add problems and events meanwhile. Nothing is lost, because replacing
    # the set and removing an event are atomic in Python.
    problems = record.clock.problems
    record.clock.problems = set()
    notes += sorted(problems)
    past_states = []
    while record.events:
        state, text = record.events.popleft()
        past_states.append(state)
        if text not in notes:
            notes.append(text)
    return LinkReport(
        name=link.config.name,
        hub_uid=None if link.hello is None else link.hello.hub_uid,
        state=link.state,
        past_states=tuple(past_states),
        notes=tuple(notes),
        values=_report_values(link, record),
    )


def _compute_period_us(rate: float | None) -> int | None:
    """Return the sample period, in µs, for a sample rate in Hz; None for None."""
    return None if rate is None else round(1e6 / rate)


def _describe_losses(
    before: dict[str, int],
    now: dict[str, int],
    lag_s: float,
) -> list[str]:
    """Return a list with a text about the samples lost since the last report; empty if none were.

    The text states how many were lost and where: in this host, in the hub, or on the line.

    Args:
        before: Counters of the samples at the last report; empty at the first.
        now: The counters now.
        lag_s: Longest time since the last report for which received bytes waited to be read, in s.
    """
    taken = now["taken"] - before.get("taken", 0)
    lost = now["lost_on_the_way"] - before.get("lost_on_the_way", 0)
    dropped = now["dropped_in_hub"] - before.get("dropped_in_hub", 0)
    if lost + dropped <= 0:
        if dropped <= 0:
            return []
        # The hub's counters (STATS) came only now, after these samples were reported as lost.
        return [f"{dropped} of the samples lost before were dropped in the hub"]
    if lag_s > MIN_LAG_S:
        place = f"the host is too slow: it was {lag_s:.1f} s behind: lower the rate"
    elif dropped > 0:
        place = "in the hub, which could not send them: lower the rate or raise baud"
    else:
        place = "on the line: check the cable and baud"
    return [f"{lost + dropped} of {taken} samples lost or dropped since the last report: {place}"]


def _report_values(link: Link, record: _LinkRecord) -> dict[str, object]:
    """Return the counters of one link and its hub, and the values of its clock, by name.

    The names carry the units. Values that are not known yet are "unknown".
    """
    clock = record.clock
    track = record.track
    bound_ns = clock.line.error_bound
    values: dict[str, object] = {
        **link.counters,
        **record.reported,
        "clock offset s": round(1e-9 * clock.offset_ns, 6),
        "clock drift ppm": round(1e6 * track.drift, 2),
        "clock jitter us": round(1e-3 * track.jitter_ns, 1),
        "clock delay us": "unknown",
        "clock error at most us": "unknown",
        "clock resets": clock.resets,
        "hub changes": record.hub_changes,
        "log lines left out": record.logger.left_out,
    }
    if bound_ns is not None:
        values["clock delay us"] = round(1e-3 * (track.offset - track.bounded_offset), 1)
        values["clock error at most us"] = round(1e-3 * bound_ns, 1)
    stats = record.account.stats_frame
    if stats is not None:
        values["hub uptime s"] = stats.uptime_ms / 1000
        values["hub supply mV"] = stats.supply_mv or "unknown"
    return values
