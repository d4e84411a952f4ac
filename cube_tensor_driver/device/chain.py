"""The chain from bytes to rows: reader, accounts, clocks and scans of all links of a skin.

It calls back in the reader's thread: the driver node publishes from there, and `live.py` puts a
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
from .links.reader import LinkFrames, Reader
from .scans.cube_table import CubeAddress
from .scans.row_account import RowAccount, RowCounts
from .scans.scan import MakeRows, ScanBuilder, empty_rows
from .scans.sequence import Arrival, SampleAccount
from .wire.native import SLOWER, wire
from .wire.protocol import VERSION, Command, Frame, Hello, Request, Sample, Stats, Time

MAX_SCANS = 4
"""Scans in one callback at most, or one more than were asked for. Many scans wait after a pause;
memory that is kept for rows need not hold them all."""
EVENTS_KEPT = 100
"""Of each link, until the next report."""


@dataclass(frozen=True)
class LinkReport:
    """How one link is doing.

    hub_uid: None before the hub has said it
    state: the present one
    past_states: states other than open since the last report
    notes: what is wrong, or was wrong since the last report, with the fix
    values: counters and clock, by name
    """

    name: str
    hub_uid: int | None
    state: LinkState
    past_states: tuple[LinkState, ...]
    notes: tuple[str, ...]
    values: dict[str, object]


@dataclass
class _LinkRecord:
    """What `LiveLinks` keeps of one link.

    problems: cubes that do not fit the skin
    contradictions: of the account
    events: states other than open since the last report, and the reason of each
    logged_version: the last other protocol version that was logged
    hub_changes: how often a hub said that it has other cubes than before, the first time included
    was_open: the link has been open before
    """

    account: SampleAccount = field(default_factory=SampleAccount)
    clock: HubClock = field(default_factory=HubClock)
    problems: list[str] = field(default_factory=list)
    contradictions: list[str] = field(default_factory=list)
    events: deque[tuple[LinkState, str]] = field(default_factory=lambda: deque(maxlen=EVENTS_KEPT))
    logged_version: int | None = None
    hub_changes: int = 0
    was_open: bool = False


class LiveLinks:
    """Reads the links of a skin and calls back with rows of frequencies.

    on_rows: called in the reader's thread with the rows of each complete scan. If make_rows gives
        the same memory again, they are valid only until the call returns
    rate: samples per second to ask of the hubs; None leaves it to them
    scans_per_call: how many scans are gathered for one call
    make_rows: makes the arrays that rows are written into
    clock_ns: the clock of `stamp_ns`
    is_host_clock: whether that is the host's now, and not a simulated time
    log: for what happens to the links; None: Python's logging
    on_end: called in the reader's thread when it ends, after `close` or by an error
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
        self._clock_steps: deque[int] = deque(maxlen=EVENTS_KEPT)
        self._log: Log = log or logging.getLogger(__name__)
        if wire is None:
            self._log.warning(SLOWER)
        self._link_logs = [LinkLogger(config.name, self._log) for config in self._configs]
        self._rows = RowAccount(self._scans)
        # Reports look at accounts and clocks while the reader's thread does not change them.
        self._taking = threading.Lock()
        self._errors = 0
        self._reader: Reader | None = None

    def start(self) -> None:
        """Open the links and start the hubs; again after `close` if need be.

        LinkError `bad_port`: a port that can never be opened.
        """
        self._reader = Reader(
            self._configs,
            self.receive,
            self._on_state,
            self._clock_ns,
            _period_us(self._rate),
            self._on_end,
        )
        self._reader.start()

    def close(self) -> None:
        """Stop the hubs and close the links. Safe to call twice."""
        if self._reader is not None:
            self._reader.close()

    def set_rate(self, rate: float | None) -> None:
        """Ask the hubs for another rate, samples per second; None: leave it as it is."""
        self._rate = rate
        period_us = _period_us(rate)
        if self._reader is not None and period_us is not None:
            for link in range(len(self._configs)):
                self._reader.send(link, Request(Command.SET_PERIOD, period_us))

    @property
    def failure(self) -> Exception | None:
        """The error that ended the reader's thread; None while all is well."""
        return None if self._reader is None else self._reader.failure

    @property
    def callback_errors(self) -> int:
        """How often a callback in the reader's thread has failed."""
        in_reader = 0 if self._reader is None else self._reader.callback_errors
        return self._errors + in_reader

    @property
    def cube_uids(self) -> dict[int, int]:
        """uids of the skin's cubes by index, as the hubs say."""
        return self._scans.cubes.uids

    def row_counts(self) -> RowCounts:
        """What became of all rows until now."""
        return self._rows.counts

    def report(self) -> list[LinkReport]:
        """How each link is doing, and what happened since the last report; empty before `start`."""
        if self._reader is None:
            return []
        with self._taking:
            return [
                self._report(link, record, log)
                for link, record, log in zip(
                    self._reader.links, self._records, self._link_logs, strict=True
                )
            ]

    def receive(self, received: Sequence[LinkFrames]) -> None:
        """Take in frames of the links, and call back with what they complete.

        The reader's thread calls this once per wake-up.
        """
        with self._taking:
            now_ns, step_ns = self._see_clock()
            for link, arrival_ns, frames, asked_ns in received:
                # Bytes that were read just before the clock was set have the old time.
                if step_ns and abs(arrival_ns + step_ns - now_ns) < abs(arrival_ns - now_ns):
                    arrival_ns += step_ns
                for frame in frames:
                    if isinstance(frame, Sample):
                        self._rows.received += frame.n_cubes
                try:
                    # A round trip during which the clock was set says nothing.
                    self._take(link, arrival_ns, frames, 0 if step_ns else asked_ns)
                except Exception as error:  # noqa: BLE001  (the rows of other links go on)
                    self._lose(error)
        self._deliver()
        self._rows.check()

    def _see_clock(self) -> tuple[int, int]:
        """The time, and by how much the host's clock was set since the last call, ns."""
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

    def _take(self, link: int, arrival_ns: int, frames: Sequence[Frame], asked_ns: int) -> None:
        """Count the frames of a link and give their samples to the scans."""
        record = self._records[link]
        samples: list[Sample] = []
        for frame in frames:
            if isinstance(frame, Sample):
                arrival = record.account.sample(frame)
                if arrival is Arrival.RESET:
                    self._give(link, arrival_ns, samples)
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
                record.contradictions = record.account.contradictions()
        self._give(link, arrival_ns, samples)

    def _give(self, link: int, arrival_ns: int, samples: Sequence[Sample]) -> None:
        """Samples of one run of a hub, which arrived together, to the scans."""
        if not samples:
            return
        clock = self._records[link].clock
        device_us = [sample.device_us for sample in samples]
        numbers = [sample.sequence for sample in samples]
        stamps_ns = clock.update(device_us, arrival_ns, numbers)
        self._scans.add(link, samples, stamps_ns, STAMP if clock.in_doubt else 0)

    def _deliver(self) -> None:
        """Call back with all scans that are complete. Scans without a row of the skin end here."""
        while self._scans.is_complete(self._scans_per_call):
            try:
                rows = self._scans.build(self._make_rows, self._max_scans)
                if rows is not None:
                    self._on_rows(rows)
                    self._rows.delivered += len(rows)
            except Exception as error:  # noqa: BLE001  (the next rows go on)
                self._lose(error)

    def _lose(self, error: Exception) -> None:
        """An error has lost rows: they are counted with its reason."""
        lost = self._rows.count_lost(error)
        self._errors += 1
        # Not all of them: at 1 kHz they would fill the log.
        if self._errors in (1, 10, 100, 1000, 10_000):
            self._log.error(
                f"{lost} rows lost by an error ({self._errors} errors so far); reading goes on\n"
                f"{traceback.format_exc()}"
            )

    def _learn_cubes(self, link: int, hello: Hello) -> None:
        problems = self._scans.cubes.learn(link, hello)
        if problems is None:
            return
        record, log = self._records[link], self._link_logs[link]
        record.problems = problems
        record.hub_changes += 1
        log.info(f"hub {hello.hub_uid:#x} with {hello.n_cubes} cubes of {hello.n_pads} pads")
        for problem in problems:
            log.error(problem)

    def _on_state(self, link: int, state: LinkState, error: LinkError | None) -> None:
        """The state of a link, or why it waits, has changed."""
        record = self._records[link]
        record.was_open |= state is LinkState.OPEN
        if state is not LinkState.OPEN:
            # Without an error a link waits because it is about to be opened for the first time.
            if error is not None or state is LinkState.CLOSED:
                record.events.append((state, str(error or state.value)))
            self._scans.set_live(link, False)
            self._deliver()
        log = self._link_logs[link]
        if error is not None and error.kind == "no_port" and self._is_expected(link):
            return
        if error is not None:
            log.warning(f"{state.value}: {error}")
        else:
            log.info(state.value)

    def _is_expected(self, link: int) -> bool:
        """Whether a simulator has yet to make the port of a link."""
        return self._configs[link].is_simulated and not self._records[link].was_open

    def _report(self, link: Link, record: _LinkRecord, log: LinkLogger) -> LinkReport:
        notes = [*record.problems, *record.contradictions]
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
                # Once a report at most, so it needs no other bound.
                self._log.error(f"link {link.config.name}: {notes[-1]}")
        # In one step, because the reader's thread adds to them.
        problems, record.clock.problems = record.clock.problems, set()
        notes += sorted(problems)
        past_states = []
        # Taken out one by one, because the reader's thread may add to them.
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
            values=_values(link, record, log),
        )


def _period_us(rate: float | None) -> int | None:
    return None if rate is None else round(1e6 / rate)


def _values(link: Link, record: _LinkRecord, log: LinkLogger) -> dict[str, object]:
    clock = record.clock
    bound_ns = clock.bound_ns
    values: dict[str, object] = {
        **link.counters,
        **record.account.counters(),
        "clock offset s": round(1e-9 * clock.offset_ns, 6),
        "clock drift ppm": round(clock.drift_ppm, 2),
        "clock jitter us": round(1e-3 * clock.jitter_ns, 1),
        "clock delay us": "unknown" if bound_ns is None else round(1e-3 * clock.delay_ns, 1),
        "clock error at most us": "unknown" if bound_ns is None else round(1e-3 * bound_ns, 1),
        "clock resets": clock.resets,
        "hub changes": record.hub_changes,
        "log lines left out": log.left_out,
    }
    stats = record.account.stats_frame
    if stats is not None:
        values["hub uptime s"] = stats.uptime_ms / 1000
        values["hub supply mV"] = stats.supply_mv or "unknown"
    return values
