"""The driver node: all links of a skin in, batches of raw frequencies out."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import ROSClock
from rclpy.event_handler import PublisherEventCallbacks

from cube_tensor_driver.msg import SkinFrequencies, SkinInfo

from ..bags.message_codec import frequency_codec
from ..config.skin import Skin, read_skin
from ..core.errors import ConfigError, LinkError
from ..core.pipeline import Pipeline
from ..device.clock import ClockMap
from ..device.link import LinkConfig, LinkState
from ..device.protocol import VERSION, Command, Hello, Request, Sample, Stats
from ..device.reader import Arrivals, Reader
from ..device.scan import CubeAddress, Rows, Scan
from ..device.sequence import Account, Verdict
from .diagnostics import Diagnostics, make_status
from .messages import info_message
from .node import BUFFERS_KEPT, LATCHED, CubeNode, queue, run, scans_per_message

LEVELS = {
    LinkState.OPEN: DiagnosticStatus.OK,
    LinkState.WAITING: DiagnosticStatus.ERROR,
    LinkState.SILENT: DiagnosticStatus.STALE,
    LinkState.CLOSED: DiagnosticStatus.WARN,
}


MAX_SCANS = 4
"""Scans in one message at most, or as many as make a batch: DDS keeps the largest one of each place
of a queue."""


class Driver(CubeNode):
    """Publishes `frequencies`, `info` and diagnostics. The reader's thread publishes; the main
    thread spins."""

    def __init__(self, take: Callable[[Rows, int, bytes], None] | None = None) -> None:
        """take: called in the reader's thread with what each message holds: a reconstruction in the
        same process."""
        super().__init__("driver")
        self._take = take
        self.declare(
            "autostart",
            True,
            "Configure and activate at once; false waits for lifecycle transitions.",
        )
        self.declare("config", "", "Skin file (YAML).")
        self.declare(
            "port", "", "Port instead of the one in the skin file, for a skin with one link."
        )
        self.declare(
            "port_directory",
            "",
            "Folder with the links' ports under the links' names: simulated hubs.",
        )
        self.declare(
            "rate",
            0.0,
            "Samples per second to ask of the hubs; 0: as the skin file says.",
            (0.0, 10_000.0),
            live=True,
        )
        self.declare(
            "publish_period",
            0.0,
            "Time that one message covers, s; 0: a message for each scan.",
            (0.0, 1.0),
        )
        self.declare(
            "qos_reliability",
            "reliable",
            "Reliability of the batch topics.",
            choices="reliable, best_effort",
        )
        self._reader: Reader | None = None
        self._diagnostics = Diagnostics(self, self._statuses)

    @property
    def failure(self) -> Exception | None:
        return None if self._reader is None else self._reader.failure

    def configure(self) -> None:
        skin = read_skin(self.config())
        self._skin = skin
        self._rate = float(self.value("rate")) or skin.rate
        self._links = self._link_configs(skin)
        names = [link.name for link in skin.links]
        places = [
            CubeAddress(
                cube.name,
                None if cube.link is None else names.index(cube.link),
                cube.index,
                cube.uid,
                cube.calibration.layout.n_pads,
            )
            for cube in skin.cubes
        ]
        self._scan = Scan(len(names), places)
        self._accounts = [Account() for _ in names]
        self._clocks = [ClockMap() for _ in names]
        # What happened since the last diagnostics, so that nothing between two ticks is missed.
        self._happened: list[list[tuple[bytes, str]]] = [[] for _ in names]
        self._unaccounted_rows = 0
        self._other_versions: list[int | None] = [None] * len(names)
        self._problems: list[list[str]] = [[] for _ in names]
        self._published = self._published_before = 0
        self._turns = scans_per_message(self.value("publish_period"), self._rate)
        self._frame_id = skin.parent_frame.encode() + b"\0"
        self._blank = lru_cache(maxsize=BUFFERS_KEPT)(
            partial(frequency_codec.buffer, self._frame_id)
        )
        rate = None if self._rate is None else self._rate / self._turns
        quality = queue(rate, self.value("qos_reliability"), self._turns * len(skin.cubes))
        self._listened_to = False
        matched = PublisherEventCallbacks(matched=self._on_matched)
        self._frequencies = self.create_lifecycle_publisher(
            SkinFrequencies, "frequencies", quality, event_callbacks=matched
        )
        self._info = self.create_publisher(SkinInfo, "info", LATCHED)
        self._uids: dict[int, int] = {}
        self._pipeline = Pipeline([cube.calibration for cube in skin.cubes])
        self._publish_info()

    def activate(self) -> None:
        period_us = None if self._rate is None else round(1e6 / self._rate)
        self._look_at_clock()
        self._reader = Reader(self._links, self._on_frames, self._on_state, self._now_ns, period_us)
        self._reader.start()

    def changed(self, name: str) -> None:
        """rate: asked of the hubs at once; queues keep the depth they were made with."""
        self._rate = float(self.value("rate")) or self._skin.rate
        if self._reader is not None and self._rate is not None:
            for link in range(len(self._links)):
                self._reader.send(link, Request(Command.SET_PERIOD, round(1e6 / self._rate)))

    def deactivate(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def cleanup(self) -> None:
        if hasattr(self, "_info"):
            for publisher in (self._frequencies, self._info):
                self.destroy_publisher(publisher)
            del self._info

    def _link_configs(self, skin: Skin) -> list[LinkConfig]:
        port, folder = self.value("port"), self.value("port_directory")
        if port and len(skin.links) > 1:
            raise ConfigError(
                f"parameter port is {port!r}, but the skin {skin.name} has {len(skin.links)} links; "
                "write the ports into the skin file"
            )
        return [
            LinkConfig(
                link.name,
                port or (str(Path(folder) / link.name) if folder else link.port),
                link.baud,
                link.hub_uid,
            )
            for link in skin.links
        ]

    def _look_at_clock(self) -> None:
        clock = self.get_clock()
        self._simulated_time = isinstance(clock, ROSClock) and clock.ros_time_is_active

    def _now_ns(self) -> int:
        """The node's clock. Without simulated time that is the system's, asked for itself in a
        tenth of the time."""
        return int(self.get_clock().now().nanoseconds) if self._simulated_time else time.time_ns()

    def _on_frames(self, batch: Arrivals) -> None:
        """Reader's thread, once per wake-up."""
        for link, arrival_ns, frames in batch:
            account, clock = self._accounts[link], self._clocks[link]
            samples: list[Sample] = []
            for frame in frames:
                if isinstance(frame, Sample):
                    verdict = account.sample(frame)
                    if verdict is Verdict.RESET:
                        clock.reset()
                    if verdict is not Verdict.DUPLICATE:
                        samples.append(frame)
                elif isinstance(frame, Hello):
                    self._learn(link, frame)
                elif isinstance(frame, Stats):
                    account.stats(frame)
            if samples:
                self._scan.add(
                    link,
                    samples,
                    clock.update([sample.device_us for sample in samples], arrival_ns),
                )
        self._publish()
        self._unaccounted_rows = self._scan.unaccounted()

    def _publish(self) -> None:
        """What is complete."""
        most = max(MAX_SCANS, self._turns + 1)
        while (
            self._scan.complete(self._turns)
            and (rows := self._scan.take(self._room, most)) is not None
        ):
            first_ns = int(rows.stamp_ns.min())
            if self._take is None or self._listened_to:
                self._frequencies.publish(self._message.data(first_ns))
            if self._take is not None:
                self._take(rows, first_ns, self._frame_id)
            self._published += len(rows.cube)

    def _on_matched(self, event: Any) -> None:
        """DDS says how many subscribe to `frequencies`: to ask at each message costs more."""
        self._listened_to = event.current_count > 0

    def _room(self, rows: int, n_pads: int) -> Rows:
        """The fields of a message: what the scan writes there is not copied any more."""
        self._message = self._blank(rows, n_pads)
        room = self._message.rows
        return Rows(
            room.cube,
            room.sequence,
            room.stamp_ns,
            room.frequency,
            room.temperature,
            room.pad_fault,
        )

    def _learn(self, link: int, frame: Hello) -> None:
        problems = self._scan.hello(link, frame)
        if problems is None:
            return
        self._problems[link] = problems
        name = self._links[link].name
        self.get_logger().info(
            f"link {name}: hub {frame.hub_uid:#x} with {frame.n_cubes} cubes of {frame.n_pads} pads"
        )
        for problem in problems:
            self.get_logger().error(f"link {name}: {problem}")

    def _on_state(self, link: int, state: LinkState, error: LinkError | None) -> None:
        """Reader's thread, when a link's state changes."""
        if state is not LinkState.OPEN:
            self._scan.live(link, False)
            self._publish()
        name = self._links[link].name
        if LEVELS[state] > DiagnosticStatus.OK:
            self._happened[link].append((LEVELS[state], str(error or state.value)))
        if error is not None:
            self.get_logger().warning(f"link {name}: {state.value}: {error}")
        else:
            self.get_logger().info(f"link {name}: {state.value}")

    def _publish_info(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        self._info.publish(info_message(self._skin, self._pipeline, now_ns, self._uids, "driver"))

    def _statuses(self) -> list[DiagnosticStatus]:
        """For diagnostics, of the whole and of each link; what happened since the last time is in
        them."""
        if not self.configured:
            return []
        self._look_at_clock()
        if self._scan.uids != self._uids:
            self._uids = dict(self._scan.uids)
            self._publish_info()
        rate, self._published_before = self._published - self._published_before, self._published
        totals: dict[str, object] = {
            "rows published": self._published,
            "rows per second": rate,
            "rows of unknown cubes": self._scan.unknown_cube,
            "rows with another number of pads": self._scan.wrong_pads,
            "rows unaccounted": self._unaccounted_rows,
        }
        wrong = f"{self._unaccounted_rows} rows are lost in the driver: please report it" * bool(
            self._unaccounted_rows
        )
        level = DiagnosticStatus.ERROR if wrong else DiagnosticStatus.OK
        statuses = [make_status("rows", self._skin.name, level, wrong, totals)]
        reader = self._reader
        for number, link in enumerate(reader.links if reader else ()):
            other = link.decoder.other_version
            account = self._accounts[number]
            notes = [*self._problems[number], *account.contradictions()]
            if other is not None:
                notes.append(
                    f"the hub speaks protocol version {other}, this driver version {VERSION}: update the older one"
                )
                if other != self._other_versions[number]:
                    self._other_versions[number] = other
                    self.get_logger().error(f"link {link.config.name}: {notes[-1]}")
            if link.error is not None:
                notes.insert(0, str(link.error))
            happened, self._happened[number] = self._happened[number], []
            notes += dict.fromkeys(text for _, text in happened if text not in notes)
            level = max(
                LEVELS[link.state],
                DiagnosticStatus.WARN if notes else DiagnosticStatus.OK,
                *(one for one, _ in happened),
            )
            values: dict[str, object] = {**link.counters, **account.counters()}
            clock = self._clocks[number]
            values |= {
                "clock offset s": f"{clock.offset_ns * 1e-9:.6f}",
                "clock drift ppm": f"{clock.drift_ppm:.2f}",
                "clock jitter us": f"{clock.jitter_ns / 1e3:.1f}",
                "clock resets": clock.resets,
            }
            stats = account.stats_frame
            if stats is not None:
                values |= {
                    "hub uptime s": stats.uptime_ms / 1000,
                    "hub supply mV": stats.supply_mv or "unknown",
                }
            uid = "" if link.hello is None else f"{link.hello.hub_uid:#x}"
            text = "; ".join(notes) or link.state.value
            statuses.append(make_status(f"link {link.config.name}", uid, level, text, values))
        return statuses


def main() -> None:
    run(lambda: [Driver()])


if __name__ == "__main__":
    main()
