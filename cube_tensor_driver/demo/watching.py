# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The part of the demo that runs beside its processes: live table, and measurement of arrivals."""

from __future__ import annotations

import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from diagnostic_msgs.msg import DiagnosticArray

from ..config.output_files import to_json, write_json
from ..config.skin import Skin, read_skin
from ..core.errors import CubeError, MessageError
from ..messages.codec import frequency_codec, stress_codec
from ..msg import SkinFrequencies, SkinStress
from ..processes.children import Children
from ..ros.commands.services import ANNOUNCE_S
from ..ros.qos import make_batch_profile
from ..ros.session import describe_domain, run_node_session, spin_until
from ..simulation.imperfections import read_imperfections
from ..simulation.load import read_load
from ..views.terminal.live_table import LiveTable
from .running import Interrupted, Observer, end_simulator, observe_skin

if TYPE_CHECKING:
    from .demo import DemoSettings
    from .load_verification import LoadVerification

__all__ = ["DemoResult", "Interrupted", "watch"]

MAX_START_S = 20.0
"""Maximum time, in seconds, from the start of the demo's processes until a stress tensor of every
cube must have arrived."""

CHECK_PERIOD_S = 1.0
"""Period, in seconds, at which a demo without measurement checks that no other skin publishes in
its DDS domain."""

MAX_LATE_S = 2.0
"""Maximum time, in seconds, after the end of a measurement to wait for its last tensors."""

MEASURED_NODES = ("driver", "reconstruction")
"""Names of the processes whose processor time and memory a demo measures."""


@dataclass(frozen=True)
class DemoResult:
    """The result of a demo with a measurement.

    Attributes:
        figures: Counts, latencies, errors and resources: the content of the JSON file.
        verification: The rows that arrived, from which the forces are computed.
    """

    figures: dict[str, object]
    verification: LoadVerification

    def publish(self, settings: DemoSettings) -> None:
        """Draw the picture if the settings name one, and print the results or write them.

        Raises:
            CubeError: No tensor arrived, or a file cannot be written.
        """
        figures = self.figures
        if settings.figure is not None:
            figures = figures | self._draw(settings.figure)
        if settings.json is None:
            print(to_json(figures, indent=2))
        else:
            write_json(settings.json, figures)
            sent, lost = figures["samples_sent"], figures["lost"]
            print(f"wrote {settings.json}: {sent} samples sent, {lost} lost")
        if not figures["tensors_received"]:
            raise CubeError("no tensor arrived in the measured time; is the machine overloaded?")

    def _draw(self, path: Path) -> dict[str, object]:
        """Draw applied and measured force on the whole skin into a file.

        Returns:
            Peaks and errors of the force, for the JSON file.
        """
        from ..views.figures.skin_force import draw_forces
        from ..views.figures.style import save

        forces = self.verification.compute_forces()
        picture = draw_forces(
            seconds=forces.seconds,
            force=forces.force,
            measured_force=forces.measured_force,
            centre=forces.centre,
            measured_centre=forces.measured_centre,
            cubes=self.verification.load.poses.position,
        )
        save(picture, path)
        return forces.compute_errors()


def watch(
    settings: DemoSettings,
    skin_file: Path,
    rate: float,
    children: Children,
    interrupted: threading.Event,
    log: Path,
) -> DemoResult:
    """Show a running skin until Ctrl-C, or measure it for the duration in the settings.

    Args:
        settings: The settings of the demo.
        skin_file: The skin file that the processes were started with.
        rate: Samples per second of each cube.
        children: The processes of the demo.
        interrupted: Event that Ctrl-C sets.
        log: File into which the simulator writes its samples when it ends.

    Returns:
        The result of the measurement. Without a duration the function only ends by an exception.

    Raises:
        Interrupted: The user pressed Ctrl-C.
        CubeError: A file cannot be used, a cube sends no tensor within `MAX_START_S`, or another
            skin publishes in the same DDS domain.
    """
    # If Ctrl-C was pressed during the imports, the demo ends before it draws a table.
    if interrupted.is_set():
        raise Interrupted("interrupted")
    skin = read_skin(skin_file)
    if settings.imperfections is not None:
        # The simulator reads the file, too, but would write an error only into its own log.
        read_imperfections(settings.imperfections)
    load = read_load(skin, settings.load, settings.mujoco)
    verification = None
    if settings.duration is not None:
        from .load_verification import LoadVerification

        verification = LoadVerification(skin, load)

    with ExitStack() as stack:
        table = stack.enter_context(LiveTable(skin, show=not settings.headless))
        observer = stack.enter_context(
            observe_skin(
                "demo",
                children,
                interrupted=interrupted,
                on_step=table.refresh,
            )
        )
        watcher = SkinWatcher(
            skin,
            rate,
            children,
            table,
            observer,
            verification,
        )
        watcher.wait_for_tensors()
        if settings.view:
            watcher.note_address()
        if settings.duration is None or verification is None:
            watcher.run()
        figures = watcher.measure(verification, settings.duration, log)
    head = {
        "cubes": len(skin.cubes),
        "rate_hz": rate,
        "duration_s": settings.duration,
    }
    return DemoResult(head | figures, verification)


def check_no_skin() -> None:
    """Check, before the demo starts its skin, that no other skin publishes in this DDS domain.

    Raises:
        CubeError: A skin publishes.
    """
    with run_node_session("demo") as (node, executor):
        if spin_until(executor, lambda: node.count_publishers("stress"), ANNOUNCE_S):
            raise make_other_skin_error()


def make_other_skin_error() -> CubeError:
    """Return the error that a demo raises because another skin publishes in its DDS domain."""
    return CubeError(
        f"another skin publishes stress in {describe_domain()}: "
        "end it, or set another ROS_DOMAIN_ID for this one"
    )


class SkinWatcher:
    """Receives the messages of the running skin, for the live table and for the measurement."""

    def __init__(
        self,
        skin: Skin,
        rate: float,
        children: Children,
        table: LiveTable,
        observer: Observer,
        verification: LoadVerification | None,
    ) -> None:
        """Subscribe to the topics of the skin.

        Args:
            skin: The skin.
            rate: Samples per second of each cube.
            children: The processes of the demo.
            table: The live table.
            observer: The node that receives the messages.
            verification: Collects the rows of a measurement; None if nothing is measured.
        """
        self._n_cubes = len(skin.cubes)
        self._children = children
        self._table = table
        self._observer = observer
        self._verification = verification
        self._sees_other_skin = False
        self._made_s = time.monotonic()
        self._crc_errors: dict[str, int] = {}
        profile = make_batch_profile(rate)
        observer.listen(
            SkinStress,
            "stress",
            self._on_stress,
            profile,
        )
        if verification is not None:
            observer.listen(
                SkinFrequencies,
                "frequencies",
                self._on_frequencies,
                profile,
            )
            observer.node.create_subscription(
                DiagnosticArray,
                "/diagnostics",
                self._on_diagnostics,
                10,
            )

    def wait_for_tensors(self) -> None:
        """Wait until a tensor of every cube, and a message of every measured topic, has arrived.

        Raises:
            CubeError: No tensor arrived from some cube within `MAX_START_S`, or another skin
                publishes in the same DDS domain.
        """
        self._observer.spin(MAX_START_S, self._is_ready)
        self._check_alone()
        if not self._table.seen_all:
            logs = "\n".join(map(self._children.end_of_log, MEASURED_NODES))
            raise CubeError(
                f"after {MAX_START_S:g} s only {self._table.seen} of {self._n_cubes} cubes have "
                f"a tensor.\n{logs}"
            )

    def _is_ready(self) -> bool:
        if self._sees_other_skin:
            return True
        if self._verification is None:
            return self._table.seen_all
        # DDS connects publishers and subscribers of each topic separately, which takes up to
        # seconds; so tensors may arrive before the first message of another topic.
        has_samples = self._verification.frequencies.rows > 0
        return self._table.seen_all and has_samples and bool(self._crc_errors)

    def run(self) -> NoReturn:
        """Show the skin in the live table until Ctrl-C.

        Raises:
            Interrupted: The user pressed Ctrl-C.
            CubeError: Another skin publishes in the same DDS domain, or a process has ended.
        """
        while True:
            self._observer.spin(CHECK_PERIOD_S)
            self._check_alone()

    def note_address(self) -> None:
        """Write the URL of the browser view into the title of the table, and print it on its own if
        no table is drawn on a terminal.

        Raises:
            ChildError: The view did not print its URL within `MAX_START_S`.
        """
        # `spin` also draws the table while the view starts. `wait_for_line` alone would stop the
        # table for that time.
        children = self._children
        self._observer.spin(MAX_START_S, lambda: "http://" in children.log("view"))
        line = children.wait_for_line("view", "http://", 0.0)
        address = line.split()[0]
        self._table.note = f"\n{address} shows it"
        if not self._table.is_on_terminal:
            print(f"{address} shows the skin", file=sys.stderr, flush=True)

    def measure(
        self,
        verification: LoadVerification,
        duration: float,
        log: Path,
    ) -> dict[str, object]:
        """Measure the running skin, and end the simulator.

        Args:
            verification: Collects the rows that arrive.
            duration: Duration of the measurement, in s.
            log: File into which the simulator writes its samples when it ends.

        Returns:
            Counts, errors, latencies, processor time and memory, as the JSON file has them.
        """
        from .usage import Usage

        spin = self._observer.spin
        # Another skin in the same DDS domain would add its tensors to the counts. DDS (the
        # middleware of ROS 2) finds it within `ANNOUNCE_S`; the measurement begins after this time,
        # so that `_check_alone` finds such a skin.
        spin(self._made_s + ANNOUNCE_S - time.monotonic())
        start_ns = time.time_ns()
        usage = Usage(self._children, MEASURED_NODES)
        spin(duration)
        self._check_alone()
        cpu = usage.measure_cpu_percent()
        memory = usage.measure_memory_mb()
        end_ns = start_ns + round(duration * 1e9)

        # On a busy machine the simulator takes its samples late. It must not end before it has
        # taken all samples of the measured period.
        spin(MAX_LATE_S, lambda: verification.is_beyond(end_ns))
        sent = end_simulator(self._children, log)
        verification.set_sent_samples(sent, start_ns, end_ns)
        # The tensors of the last samples may arrive after the simulator has ended.
        spin(MAX_LATE_S, verification.is_complete)
        self._check_alone()
        return {
            **verification.make_result(),
            "crc_errors": sum(self._crc_errors.values()),
            **{f"cpu_{name}_percent": round(value, 1) for name, value in cpu.items()},
            **{f"rss_{name}_mb": round(value, 1) for name, value in memory.items()},
        }

    def _check_alone(self) -> None:
        """Check that no other skin publishes in this DDS domain; its tensors would be counted.

        Raises:
            CubeError: Another skin publishes.
        """
        # Messages of a smaller skin look like those of this skin, so publishers are counted, too.
        publishers = self._observer.node.count_publishers("stress")
        if self._sees_other_skin or publishers > 1:
            raise make_other_skin_error()

    def _on_stress(self, data: bytes) -> None:
        received_ns = time.time_ns()
        try:
            rows = stress_codec.decode(data).rows
        except MessageError as error:
            self._observer.log_error(str(error))
            return
        # A cube index beyond the cubes of this skin can only come from another, larger skin.
        if rows.cube.max(initial=0) >= self._n_cubes:
            self._sees_other_skin = True
            return
        if self._verification is not None:
            self._verification.add_stress(rows, received_ns)
        self._table.update(rows)

    def _on_frequencies(self, data: bytes) -> None:
        if self._verification is not None:
            self._verification.frequencies.add(frequency_codec.decode(data).rows)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            for pair in status.values:
                if pair.key == "crc":
                    self._crc_errors[status.name] = int(pair.value)
