"""The driver node: live links with a publisher at their end."""

from __future__ import annotations

from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticStatus

from ...config.parameters import DRIVER
from ...config.skin import read_skin
from ...core.pipeline import Pipeline
from ...core.rows import FrequencyRows
from ...device.chain import LiveLinks
from ...device.live import cube_addresses, link_configs
from ...msg import SkinInfo
from ..diagnostics.links import LinkStatuses
from ..diagnostics.updater import Diagnostics
from ..messages import info_message
from ..node import LATCHED, CubeNode, NodeClock, batch_queue, run, scans_per_message
from .frequencies_publisher import FrequenciesPublisher


class Driver(CubeNode):
    """Publishes `frequencies`, `driver/info` and diagnostics. The reader's thread publishes the
    frequencies, the main thread spins."""

    def __init__(self, on_rows: Callable[[FrequencyRows], None] | None = None) -> None:
        """on_rows: called in the reader's thread with the rows of each message, which are valid
        until it returns. Messages are then sent only while somebody subscribes to them."""
        super().__init__("driver", DRIVER)
        self._on_rows = on_rows
        self._node_clock = NodeClock(self)
        self._links: LiveLinks | None = None
        self._is_active = False
        self._diagnostics = Diagnostics(self, self._statuses, self._count_errors)

    @property
    def failure(self) -> Exception | None:
        return None if self._links is None else self._links.failure

    def configure(self) -> None:
        skin = self._skin = read_skin(self.config())
        self._pipeline = Pipeline([cube.calibration for cube in skin.cubes])
        rate = self._rate()
        scans = scans_per_message(self.value("publish_period"), rate)
        links = link_configs(skin, self.value("port"), self.value("port_directory"))
        quality = batch_queue(self, rate, len(skin.cubes))
        self._frequencies = FrequenciesPublisher(
            self, skin.parent_frame, quality, always=self._on_rows is None
        )
        self._info = self.create_publisher(SkinInfo, "driver/info", LATCHED)
        self._links = LiveLinks(
            links,
            cube_addresses(skin),
            self._publish,
            rate=rate,
            scans_per_call=scans,
            make_rows=self._frequencies.make_rows,
            clock_ns=self._node_clock.now_ns,
            is_host_clock=lambda: not self._node_clock.is_simulated,
            log=self.get_logger(),
        )
        self._link_statuses = LinkStatuses(skin.name)
        self._published_uids: dict[int, int] = {}
        self._publish_info()

    def activate(self) -> None:
        if self._links is not None:
            self._node_clock.update()
            self._links.start()
            self._is_active = True

    def changed(self, name: str) -> None:
        """rate: asked of the hubs at once; queues keep the depth they were made with."""
        if self._links is not None:
            self._links.set_rate(self._rate())

    def deactivate(self) -> None:
        self._is_active = False
        if self._links is not None:
            self._links.close()

    def cleanup(self) -> None:
        if self._links is not None:
            self._links = None
            self._frequencies.destroy()
            self.destroy_publisher(self._info)

    def _rate(self) -> float | None:
        """Samples per second to ask of the hubs; None leaves it to them."""
        return float(self.value("rate")) or self._skin.rate

    def _publish(self, rows: FrequencyRows) -> None:
        self._frequencies.publish()
        if self._on_rows is not None:
            self._on_rows(rows)

    def _count_errors(self) -> int:
        """Of callbacks in the main thread and in the reader's."""
        return self.guard.errors + (0 if self._links is None else self._links.callback_errors)

    def _publish_info(self) -> None:
        now_ns = self.get_clock().now().nanoseconds
        uids = self._published_uids
        self._info.publish(info_message(self._skin, self._pipeline, now_ns, uids, "driver"))

    def _statuses(self) -> list[DiagnosticStatus]:
        """For diagnostics, once a second: of all rows, and of each link."""
        if self._links is None:
            return []
        self._node_clock.update()
        if self._links.cube_uids != self._published_uids:
            self._published_uids = self._links.cube_uids
            self._publish_info()
        return self._link_statuses(self._links, with_links=self._is_active)


def main() -> None:
    run(lambda: [Driver()])


if __name__ == "__main__":
    main()
