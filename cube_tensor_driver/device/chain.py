"""The chain from bytes to rows: reader, accounts, clocks and scans of all links of a skin.

It calls back in the reader's thread. The driver node publishes from there, and `live.py` puts a
queue behind it.
"""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from ..core.errors import LinkError
from ..core.rows import FrequencyRows
from ..core.status import STAMP
from .clock.hub_clock import HubClock
from .clock.steps import HostClockWatch
from .links.link import Link, LinkConfig, LinkState
from .links.link_log import LinkLogger, Log
from .links.reader import LOGGED_ERRORS, LinkFrames, Reader
from .scans.cube_table import CubeAddress
from .scans.row_account import RowAccount, RowCounts
from .scans.scan import MakeRows, ScanBuilder, empty_rows
from .scans.sequence import Arrival, SampleAccount
from .wire.native import NOT_COMPILED, wire
from .wire.protocol import VERSION, Command, Frame, Hello, Request, Sample, Stats, Time

MAX_SCANS = 4
"""Largest number of scans in one callback, unless the caller gathers more. Many scans wait after a
pause, and the memory that is kept for rows need not hold all of them."""
MAX_EVENTS = 100
"""Number of changes of state of one link that are kept until the next report."""


@dataclass(frozen=True)
class LinkReport:
    """State of one link.

    Attributes:
        name: Name of the link.
        hub_uid: Unique number of the hub; None before its first HELLO.
        state: State now.
        past_states: States other than open since the last report.
        notes: What is wrong now, or was wrong since the last report, with the fix.
        values: Counters and clock values by name.
    """

    name: str
    hub_uid: int | None
    state: LinkState
    past_states: tuple[LinkState, ...]
    notes: tuple[str, ...]
    values: dict[str, object]


@dataclass
class _LinkRecord:
    """What `LiveLinks` knows of one link.

    Attributes:
        account: Account of its samples.
        clock: Clock of its hub.
        problems: Cubes that do not fit the skin, in words.
        account_errors: Errors of the account, in words.
        events: States other than open since the last report, and the reason of each.
        logged_version: Last other protocol version that was logged.
        hub_changes: Number of times the hub reported other cubes than before, including the first.
        was_open: Whether the link has ever been open.
    """

    account: SampleAccount = field(default_factory=SampleAccount)
    clock: HubClock = field(default_factory=HubClock)
    problems: list[str] = field(default_factory=list)
    account_errors: list[str] = field(default_factory=list)
    events: deque[tuple[LinkState, str]] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    logged_version: int | None = None
    hub_changes: int = 0
    was_open: bool = False


class LiveLinks:
    """Reads the links of a skin and calls back with rows of frequencies.

    Args:
        links: Place and identity of the hub of each link.
        cubes: Place of each cube of the skin.
        on_rows: Called in the reader's thread with the rows of complete scans. If `make_rows`
            returns the same memory again, they are valid only until the call returns.
        rate: Sample rate to request of the hubs, in Hz; None leaves it to them.
        scans_per_call: Number of scans that are gathered for one call.
        make_rows: Makes the arrays that rows are written into.
        clock_ns: Clock of the stamps.
        is_host_clock: Returns whether `clock_ns` is now the host's clock, not a simulated time.
        log: Logger for events of the links; None for Python's logging.
        on_end: Called in the reader's thread when it ends, after `close` or because of an error.
    """

    def __init__(
        self,
        links: Sequence[LinkConfig],
        cubes: Sequence[CubeAddress],
        on_rows: Callable[[FrequencyRows], None],
        *,
        rate: float | None = None,
        scans_per_call: int = 1,
        make_rows: MakeRows = empty_rows,
        clock_ns: Callable[[], int] = time.time_ns,
        is_host_clock: Callable[[], bool] = lambda: True,
        log: Log | None = None,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._configs = tuple(links)
        self._scans = ScanBuilder(len(links), cubes)
        self._records = [_LinkRecord() for _ in links]
        self._on_rows = on_rows
        self._on_end = on_end
        self._rate = rate
        self._scans_per_call = scans_per_call
        self._max_scans = max(MAX_SCANS, scans_per_call + 1)
        self._make_rows = make_rows
        self._clock_ns = clock_ns
        self._is_host_clock = is_host_clock
        self._clock_watch = HostClockWatch(clock_ns)
        self._log: Log = log or logging.getLogger(__name__)
        if wire is None:
            self._log.warning(NOT_COMPILED)
        self._loggers = [LinkLogger(config.name, self._log) for config in self._configs]
        self._rows = RowAccount(self._scans)
        # Reports read accounts and clocks only while the reader's thread does not change them.
        self._lock = threading.Lock()
        self._errors = 0
        self._reader: Reader | None = None

    def start(self) -> None:
        """Open the links and start the hubs; also again after `close`.

        Raises:
            LinkError: `bad_port`: a port can never be opened.
        """
        self._reader = Reader(
            self._configs,
            on_frames=self.receive,
            on_state=self._on_state,
            clock_ns=self._clock_ns,
            period_us=_period_us(self._rate),
            on_end=self._on_end,
        )
        self._reader.start()

    def close(self) -> None:
        """Stop the hubs and close the links; a second call does nothing."""
        if self._reader is not None:
            self._reader.close()

    def set_rate(self, rate: float | None) -> None:
        """Request another sample rate of the hubs, in Hz; None leaves it as it is."""
        self._rate = rate
        period_us = _period_us(rate)
        if self._reader is None or period_us is None:
            return
        request = Request(Command.SET_PERIOD, period_us)
        for link in range(len(self._configs)):
            self._reader.send(link, request)

    @property
    def failure(self) -> Exception | None:
        """Error that ended the reader's thread; None if there was none."""
        return None if self._reader is None else self._reader.failure

    @property
    def callback_errors(self) -> int:
        """Number of times a callback in the reader's thread has failed."""
        in_reader = 0 if self._reader is None else self._reader.callback_errors
        return self._errors + in_reader

    @property
    def cube_uids(self) -> dict[int, int]:
        """Unique number of each cube by its index in the skin, as the hubs report it."""
        return self._scans.cubes.uids

    def row_counts(self) -> RowCounts:
        """Return the numbers of rows until now, by what happened to them."""
        return self._rows.counts

    def report(self) -> list[LinkReport]:
        """Return the state of each link, and what happened since the last report.

        Before `start` it is empty.
        """
        if self._reader is None:
            return []
        links = zip(self._reader.links, self._records, self._loggers, strict=True)
        with self._lock:
            return [self._report(link, record, logger) for link, record, logger in links]

    def receive(self, received: Sequence[LinkFrames]) -> None:
        """Handle frames of the links, and call back with the rows that they complete.

        The reader's thread calls this once per wake-up.
        """
        with self._lock:
            now_ns, step_ns = self._check_host_clock()
            for link, arrival_ns, frames, asked_ns in received:
                if step_ns:
                    # Bytes that were read just before the clock was set arrived in its old time.
                    shifted_ns = arrival_ns + step_ns
                    is_old = abs(shifted_ns - now_ns) < abs(arrival_ns - now_ns)
                    arrival_ns = shifted_ns if is_old else arrival_ns
                # All rows are counted first, so that an error in one frame hides no other.
                for frame in frames:
                    if isinstance(frame, Sample):
                        self._rows.received += frame.shape[0]
                try:
                    # A round trip during which the clock was set gives no bound.
                    self._handle_frames(link, arrival_ns, frames, 0 if step_ns else asked_ns)
                except Exception as error:  # noqa: BLE001  (the rows of other links go on)
                    self._count_error(error)
        self._deliver()
        self._rows.check()

    def _check_host_clock(self) -> tuple[int, int]:
        """Return the time and the step of the host's clock since the last call, both in ns."""
        now_ns, step_ns = self._clock_watch.look()
        if not step_ns or not self._is_host_clock():
            return now_ns, 0
        text = f"the host's clock was set by {1e-9 * step_ns:+.6g} s: stamps follow it at once"
        self._log.warning(text)
        for record in self._records:
            record.clock.shift(step_ns)
            record.clock.problems.add(text)
        if self._reader is not None:
            self._reader.forget_questions()
        return now_ns, step_ns

    def _handle_frames(
        self,
        link: int,
        arrival_ns: int,
        frames: Sequence[Frame],
        asked_ns: int,
    ) -> None:
        """Count the frames of a link and add their samples to the scans."""
        record = self._records[link]
        samples: list[Sample] = []
        for frame in frames:
            if isinstance(frame, Sample):
                arrival = record.account.sample(frame)
                if arrival is Arrival.RESET:
                    self._add_samples(link, arrival_ns, samples)
                    samples = []
                    record.clock.reset()
                if arrival is Arrival.DUPLICATE:
                    self._rows.duplicate += frame.n_cubes
                else:
                    samples.append(frame)
            elif isinstance(frame, Hello):
                self._learn_cubes(link, frame)
            elif isinstance(frame, Time):
                if asked_ns:
                    record.clock.add_answer(asked_ns, frame.device_us, arrival_ns)
            elif isinstance(frame, Stats):
                record.account.stats(frame)
                record.account_errors = record.account.contradictions()
        self._add_samples(link, arrival_ns, samples)

    def _add_samples(self, link: int, arrival_ns: int, samples: Sequence[Sample]) -> None:
        """Stamp samples that arrived together, and add them to the scans."""
        if not samples:
            return
        clock = self._records[link].clock
        device_us = [sample.device_us for sample in samples]
        numbers = [sample.sequence for sample in samples]
        stamps_ns = clock.update(device_us, arrival_ns, numbers)
        status = STAMP if clock.in_doubt else 0
        self._scans.add(link, samples, stamps_ns, status)

    def _deliver(self) -> None:
        """Call back with the rows of all complete scans; a scan without rows is discarded."""
        while self._scans.is_complete(self._scans_per_call):
            try:
                rows = self._scans.build(self._make_rows, self._max_scans)
                if rows is not None:
                    self._on_rows(rows)
                    self._rows.delivered += len(rows)
            except Exception as error:  # noqa: BLE001  (the next rows go on)
                self._count_error(error)

    def _count_error(self, error: Exception) -> None:
        """Count and log an error, and count the rows that it has lost."""
        lost = self._rows.count_lost(error)
        self._errors += 1
        if self._errors in LOGGED_ERRORS:
            self._log.error(
                f"{lost} rows lost by an error ({self._errors} errors so far); reading goes on\n"
                f"{traceback.format_exc()}"
            )

    def _learn_cubes(self, link: int, hello: Hello) -> None:
        """Learn the cubes of a hub, and log them if they are other than before."""
        problems = self._scans.cubes.learn(link, hello)
        if problems is None:
            return
        record, logger = self._records[link], self._loggers[link]
        record.problems = problems
        record.hub_changes += 1
        logger.info(f"hub {hello.hub_uid:#x} with {hello.n_cubes} cubes of {hello.n_pads} pads")
        for problem in problems:
            logger.error(problem)

    def _on_state(self, link: int, state: LinkState, error: LinkError | None) -> None:
        """Handle a change of the state of a link or of its reason, and log it."""
        record = self._records[link]
        record.was_open |= state is LinkState.OPEN
        if state is not LinkState.OPEN:
            # Without an error, a waiting link is about to be opened for the first time.
            if error is not None or state is LinkState.CLOSED:
                record.events.append((state, str(error or state.value)))
            self._scans.set_live(link, False)
            self._deliver()

        logger = self._loggers[link]
        if error is None:
            logger.info(state.value)
        elif error.kind != "no_port" or not self._is_port_expected(link):
            logger.warning(f"{state.value}: {error}")

    def _is_port_expected(self, link: int) -> bool:
        """Return whether a simulator has yet to make the port of a link."""
        return self._configs[link].is_simulated and not self._records[link].was_open

    def _report(self, link: Link, record: _LinkRecord, logger: LinkLogger) -> LinkReport:
        """Return the report of one link, and forget what happened since the last one."""
        notes = [*record.problems, *record.account_errors]
        if link.error is not None:
            notes.insert(0, str(link.error))
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
                # It is logged once per report at most, so the rate needs no other limit.
                self._log.error(f"link {link.config.name}: {notes[-1]}")

        # The set is replaced and the events are removed one by one, because the reader's thread may
        # add to both.
        problems, record.clock.problems = record.clock.problems, set()
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
            values=_report_values(link, record, logger),
        )


def _period_us(rate: float | None) -> int | None:
    """Return the sample period of a rate in Hz, in µs."""
    return None if rate is None else round(1e6 / rate)


def _report_values(
    link: Link,
    record: _LinkRecord,
    logger: LinkLogger,
) -> dict[str, object]:
    """Return the counters and clock values of one link by name."""
    clock = record.clock
    bound_ns = clock.bound_ns
    delay_us: object = "unknown"
    error_us: object = "unknown"
    if bound_ns is not None:
        delay_us = round(1e-3 * clock.delay_ns, 1)
        error_us = round(1e-3 * bound_ns, 1)
    values: dict[str, object] = {
        **link.counters,
        **record.account.counters(),
        "clock offset s": round(1e-9 * clock.offset_ns, 6),
        "clock drift ppm": round(clock.drift_ppm, 2),
        "clock jitter us": round(1e-3 * clock.jitter_ns, 1),
        "clock delay us": delay_us,
        "clock error at most us": error_us,
        "clock resets": clock.resets,
        "hub changes": record.hub_changes,
        "log lines left out": logger.left_out,
    }
    stats = record.account.stats_frame
    if stats is not None:
        values["hub uptime s"] = stats.uptime_ms / 1000
        values["hub supply mV"] = stats.supply_mv or "unknown"
    return values
