"""The driver node: all links of a skin in, batches of raw frequencies out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from cube_tensor_driver.msg import SkinFrequencies, SkinInfo

from ..core.errors import ConfigError, LinkError
from ..core.pipeline import Pipeline
from ..device.clock import ClockMap
from ..device.link import LinkConfig, LinkState
from ..device.protocol import VERSION, Frame, Hello, Sample, Stats
from ..device.reader import Reader
from ..device.scan import Place, Scan
from ..device.sequence import SequenceCounters, SequenceTracker, Verdict
from ..files.skin import Skin, read_skin
from .messages import frequencies_message, info_message, to_time
from .node import LATCHED, CubeNode, queue, run

LEVELS = {
    LinkState.OPEN: DiagnosticStatus.OK,
    LinkState.WAITING: DiagnosticStatus.ERROR,
    LinkState.SILENT: DiagnosticStatus.STALE,
    LinkState.CLOSED: DiagnosticStatus.WARN,
}


class Driver(CubeNode):
    """Publishes `frequencies`, `info` and diagnostics. The reader's thread publishes; the main thread spins."""

    def __init__(self) -> None:
        super().__init__("driver")
        self.declare("autostart", True, "Configure and activate at once; false waits for lifecycle transitions.")
        self.declare("config", "", "Skin file (YAML).")
        self.declare("port", "", "Port instead of the one in the skin file, for a skin with one link.")
        self.declare("port_directory", "", "Folder with the links' ports under the links' names: simulated hubs.")
        self.declare("rate", 0.0, "Samples per second to ask of the hubs; 0: as the skin file says.", (0.0, 10_000.0))
        self.declare("qos_reliability", "reliable", "Reliability of the batch topics.", choices="reliable, best_effort")
        self._reader: Reader | None = None

    def configure(self) -> None:
        skin = read_skin(self.config())
        self._skin = skin
        self._rate = float(self.value("rate")) or skin.rate
        self._links = self._link_configs(skin)
        names = [link.name for link in skin.links]
        places = [
            Place(cube.name, None if cube.link is None else names.index(cube.link), cube.index, cube.uid,
                  cube.calibration.layout.n_pads)
            for cube in skin.cubes
        ]  # fmt: skip
        self._scan = Scan(len(names), places)
        self._sequences: dict[tuple[int, int], SequenceTracker] = {}
        self._clocks = [ClockMap() for _ in names]
        self._stats: list[Stats | None] = [None] * len(names)
        self._other_versions: list[int | None] = [None] * len(names)
        self._problems: list[list[str]] = [[] for _ in names]
        self._published = self._published_before = 0
        quality = queue(self._rate, self.value("qos_reliability"))
        self._frequencies = self.create_lifecycle_publisher(SkinFrequencies, "frequencies", quality)
        self._info = self.create_publisher(SkinInfo, "info", LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        pipeline = Pipeline([cube.calibration for cube in skin.cubes])
        self._info.publish(info_message(skin, pipeline, self.get_clock().now().nanoseconds))
        self._timer = self.create_timer(1.0, self._publish_diagnostics)

    def activate(self) -> None:
        period_us = None if self._rate is None else round(1e6 / self._rate)
        clock = self.get_clock()
        self._reader = Reader(
            self._links, self._on_frames, self._on_state, lambda: int(clock.now().nanoseconds), period_us
        )
        self._reader.start()

    def deactivate(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def cleanup(self) -> None:
        if hasattr(self, "_timer"):
            self.destroy_timer(self._timer)
            for publisher in (self._frequencies, self._info, self._diagnostics):
                self.destroy_publisher(publisher)
            del self._timer

    def _link_configs(self, skin: Skin) -> list[LinkConfig]:
        port, folder = self.value("port"), self.value("port_directory")
        if port and len(skin.links) > 1:
            raise ConfigError(
                f"parameter port is {port!r}, but the skin {skin.name} has {len(skin.links)} links; "
                "write the ports into the skin file"
            )
        return [
            LinkConfig(
                link.name, port or (str(Path(folder) / link.name) if folder else link.port), link.baud, link.hub_uid
            )
            for link in skin.links
        ]

    def _on_frames(self, frames: list[tuple[int, int, Frame]]) -> None:
        """Reader's thread, once per wake-up."""
        samples: dict[int, tuple[int, list[Sample]]] = {}
        for link, arrival_ns, frame in frames:
            if isinstance(frame, Sample):
                # A hub with many cubes spreads a sample over frames of the same number: each part has its own count.
                key = link, frame.first_cube
                if key not in self._sequences:
                    self._sequences[key] = SequenceTracker()
                verdict = self._sequences[key].update(frame.sequence, frame.device_us)
                if verdict is Verdict.RESET:
                    self._clocks[link].reset()
                if verdict is not Verdict.DUPLICATE:
                    samples.setdefault(link, (arrival_ns, []))[1].append(frame)
            elif isinstance(frame, Hello):
                self._learn(link, frame)
            elif isinstance(frame, Stats):
                self._stats[link] = frame
        for link, (arrival_ns, several) in samples.items():
            stamps = self._clocks[link].update(np.array([sample.device_us for sample in several]), arrival_ns)
            for sample, stamp_ns in zip(several, stamps.tolist(), strict=True):
                self._scan.add(link, sample, stamp_ns)
        if samples and self._scan.complete():
            self._publish()

    def _publish(self) -> None:
        rows = self._scan.take()
        if rows is not None:
            self._frequencies.publish(frequencies_message(rows, self._skin.parent_frame))
            self._published += len(rows.cube)

    def _learn(self, link: int, frame: Hello) -> None:
        problems = self._scan.hello(link, frame)
        if problems is None:
            return
        self._problems[link] = problems
        name = self._links[link].name
        self.get_logger().info(f"link {name}: hub {frame.hub_uid:#x} with {frame.n_cubes} cubes of {frame.n_pads} pads")
        for problem in problems:
            self.get_logger().error(f"link {name}: {problem}")

    def _on_state(self, link: int, state: LinkState, error: LinkError | None) -> None:
        """Reader's thread, when a link's state changes."""
        if state is not LinkState.OPEN:
            self._scan.live(link, False)
            self._publish()
        name = self._links[link].name
        if error is not None:
            self.get_logger().warning(f"link {name}: {state.value}: {error}")
        else:
            self.get_logger().info(f"link {name}: {state.value}")

    def _publish_diagnostics(self) -> None:
        message = DiagnosticArray()
        message.header.stamp = to_time(self.get_clock().now().nanoseconds)
        rate, self._published_before = self._published - self._published_before, self._published
        totals: dict[str, object] = {
            "rows published": self._published,
            "rows per second": rate,
            "rows of unknown cubes": self._scan.unknown_cube,
            "rows with another number of pads": self._scan.wrong_pads,
        }
        message.status.append(
            _status(self.get_fully_qualified_name(), self._skin.name, DiagnosticStatus.OK, "", totals)
        )
        reader = self._reader
        for number, link in enumerate(reader.links if reader else ()):
            other = link.decoder.other_version
            notes = [*self._problems[number]]
            if other is not None:
                notes.append(
                    f"the hub speaks protocol version {other}, this driver version {VERSION}: update the older one"
                )
                if other != self._other_versions[number]:
                    self._other_versions[number] = other
                    self.get_logger().error(f"link {link.config.name}: {notes[-1]}")
            if link.error is not None:
                notes.insert(0, str(link.error))
            level = max(LEVELS[link.state], DiagnosticStatus.WARN if notes else DiagnosticStatus.OK)
            values: dict[str, object] = {**link.counters, **self._sequence_counters(number)}
            clock = self._clocks[number]
            values |= {"clock drift ppm": f"{clock.drift_ppm:.2f}", "clock jitter us": f"{clock.jitter_ns / 1e3:.1f}"}
            stats = self._stats[number]
            if stats is not None:
                values |= {"samples taken": stats.taken, "samples dropped in the hub": stats.dropped}
            uid = "" if link.hello is None else f"{link.hello.hub_uid:#x}"
            name = f"{self.get_fully_qualified_name()}: link {link.config.name}"
            message.status.append(_status(name, uid, level, "; ".join(notes) or link.state.value, values))
        self._diagnostics.publish(message)

    def _sequence_counters(self, link: int) -> dict[str, int]:
        """Of all parts of the link's samples together."""
        parts = [tracker.counters.as_dict() for (of, _), tracker in list(self._sequences.items()) if of == link]
        return {name: sum(part[name] for part in parts) for name in SequenceCounters().as_dict()}


def _status(name: str, hardware_id: str, level: bytes, text: str, values: dict[str, object]) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(name=name, hardware_id=hardware_id, level=level, message=text, values=pairs)


def main() -> None:
    run(Driver)


if __name__ == "__main__":
    main()
