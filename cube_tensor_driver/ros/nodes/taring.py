"""Tare as services: ~/tare and ~/clear_tare.

Tares are kept on disk by uid, and restored when the driver reports the uids of the cubes.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from std_srvs.srv import Trigger

from ...config.skin import Skin
from ...config.tare import read_tare, remove_tare, write_tare
from ...core.arrays import Array
from ...core.errors import ConfigError, CubeError, TareError
from ...core.reconstructor import Reconstructor
from ...msg import SkinInfo
from ...srv import Tare
from ..node import CubeNode

MAX_DATA_AGE_S = 1.0
"""Maximum age, in seconds, of data that show the present load."""


def tare_folder(parameter: str) -> Path:
    """Return the folder of parameter tare_folder; without it, one below ROS_HOME or ~/.ros."""
    if parameter:
        return Path(parameter).expanduser()
    return Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "cube_tensor_driver" / "tare"


class Taring:
    """The services of one reconstruction, and the files behind them.

    Attributes:
        uids: Index of a cube in the skin -> its uid, for cubes whose uid is known.
        created: Index of a cube in the skin -> when its tare was taken, for cubes that have one.
    """

    def __init__(
        self,
        node: CubeNode,
        skin: Skin,
        reconstructor: Reconstructor,
        folder: Path | None,
        lock: AbstractContextManager[Any],
        on_change: Callable[[], None],
    ) -> None:
        """Offer the services, and restore the tares of cubes whose uid is in the skin file.

        Args:
            node: The node, which is being configured.
            skin: The skin.
            reconstructor: Uses the rest frequencies.
            folder: Where tares are kept; None: nowhere.
            lock: Held while the reconstructor is used.
            on_change: Called, with the lock, when rest frequencies or uids have changed.
        """
        self._node, self._reconstructor = node, reconstructor
        self._skin, self._folder = skin, folder
        self._lock, self._on_change = lock, on_change
        self.uids: dict[int, int] = {}
        self.created: dict[int, datetime] = {}
        # Cube whose uid is unknown -> when it was tared, or None if its tare was cleared.
        self._pending: dict[int, datetime | None] = {}

        # No lock and no call of on_change: nobody uses the rest frequencies yet.
        restored = self._learn_uids({n: cube.uid for n, cube in enumerate(skin.cubes) if cube.uid})
        if restored is not None:
            reconstructor.rest_frequency = restored
        node.own(node.create_service(Tare, "~/tare", self._on_tare))
        node.own(node.create_service(Trigger, "~/clear_tare", self._on_clear))

    def on_info(self, message: SkinInfo) -> None:
        """Take over from the driver's info the uids that the skin file does not name."""
        # The driver of another skin may be in the same namespace by mistake.
        if message.name != self._skin.name or len(message.cubes) != len(self._skin.cubes):
            return
        # Reading files takes time, so the lock is taken only afterwards.
        uids_before = dict(self.uids)
        reported = {n: cube.uid for n, cube in enumerate(message.cubes) if cube.uid}
        restored = self._learn_uids(reported)
        with self._lock:
            if restored is not None:
                self._reconstructor.rest_frequency = restored
            if self.uids != uids_before:
                self._on_change()

    def age(self) -> dict[str, str]:
        """Return how many cubes are tared and since when, for diagnostics."""
        if not self.created:
            return {"cubes tared": "0"}
        oldest = datetime.now(timezone.utc) - min(self.created.values())
        return {
            "cubes tared": str(len(self.created)),
            "oldest tare s": f"{oldest.total_seconds():.0f}",
        }

    def _learn_uids(self, uids: Mapping[int, int]) -> Array | None:
        """Take over uids, and return the rest frequencies if that changes them.

        A cube whose tare is kept gets that tare. A cube that was exchanged gets the rest
        frequencies of its calibration.
        """
        rest = self._reconstructor.rest_frequency
        before = rest.copy()
        for number, uid in uids.items():
            if self.uids.get(number) == uid:
                continue
            # Another uid than before means that somebody has exchanged the cube.
            if number in self.uids:
                self._forget_tare(number, rest)
            self.uids[number] = uid
            # What was asked for in this run is newer than the file of an earlier one.
            if number in self._pending:
                self._keep_pending(number, rest)
            else:
                self._restore_tare(number, uid, rest)
        return None if np.array_equal(before, rest, equal_nan=True) else rest

    def _restore_tare(self, number: int, uid: int, rest: Array) -> None:
        """Read the tare of one cube into its row of the rest frequencies."""
        if self._folder is None:
            return
        cube = self._skin.cubes[number]
        log = self._node.get_logger()
        try:
            stored = read_tare(self._folder, uid, cube.calibration)
        except ConfigError as error:
            log.warning(f"cube {cube.name}: tare not restored: {error}")
            return
        if stored is not None:
            n_pads = cube.calibration.layout.n_pads
            rest[number, :n_pads] = stored.rest_frequency
            self.created[number] = stored.created
            log.info(f"cube {cube.name}: tare of {stored.created} restored")

    def _forget_tare(self, number: int, rest: Array) -> None:
        """Give a cube that was exchanged the rest frequencies of its calibration."""
        calibration = self._skin.cubes[number].calibration
        rest[number, : calibration.layout.n_pads] = calibration.rest_frequency
        self.created.pop(number, None)

    def _keep_pending(self, number: int, rest: Array) -> None:
        """Keep what was decided about a cube before its uid was known."""
        created = self._pending.pop(number)
        try:
            self._update_file(number, rest, created)
        except ConfigError as error:
            name = self._skin.names[number]
            self._node.get_logger().warning(f"cube {name}: tare not kept: {error}")

    def _update_file(
        self,
        number: int,
        rest: Array,
        created: datetime | None,
    ) -> None:
        """Write the tare of a cube whose uid is known, or remove it if `created` is None.

        Raises:
            ConfigError: The file cannot be written or removed.
        """
        if self._folder is None:
            return
        uid = self.uids[number]
        if created is None:
            remove_tare(self._folder, uid)
            return
        calibration = self._skin.cubes[number].calibration
        rest_of_cube = rest[number, : calibration.layout.n_pads]
        write_tare(
            self._folder,
            uid,
            calibration,
            rest_of_cube,
            created,
        )

    def _on_tare(self, request: Tare.Request, response: Tare.Response) -> Tare.Response:
        try:
            response.message = self._tare(request.cubes, request.duration)
            response.success = True
        except CubeError as error:
            response.success, response.message = False, str(error)
        self._node.get_logger().info(f"tare: {response.message}")
        return response

    def _tare(self, names: list[str], duration_s: float) -> str:
        """Tare cubes and keep their tares, and return what the answer says.

        Args:
            names: Names of the cubes; none: all cubes.
            duration_s: Time to average, in seconds; 0: as the parameter says.
        """
        cubes = self._find_cubes(names)
        now_ns = self._node.get_clock().now().nanoseconds
        duration_s = duration_s or float(self._node.value("tare_duration"))
        with self._lock:
            # Data of before the links were lost would be tared without a complaint.
            age_ns = now_ns - self._reconstructor.health.newest_ns
            if age_ns > 1e9 * MAX_DATA_AGE_S:
                raise TareError("no data now: see the diagnostics of the links")
            before = self._reconstructor.rest_frequency
            rest = self._reconstructor.tare(cubes, duration_s)
            self._on_change()
        moved = np.abs(rest / before - 1)[cubes]
        moved_ppm = 1e6 * np.nanmax(moved)  # NaN stands for pads that a cube does not have
        kept = self._keep_tares(cubes, rest)
        return f"{len(cubes)} cubes, rest frequencies moved by up to {moved_ppm:.0f} ppm{kept}"

    def _on_clear(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, "rest frequencies are the calibrations' again"
        with self._lock:
            self._reconstructor.clear_tare()
            self._on_change()
            rest = self._reconstructor.rest_frequency
        self.created.clear()
        self._pending.clear()
        try:
            for number in range(len(self._skin.cubes)):
                self._decide(number, rest, None)
        except ConfigError as error:
            response.success, response.message = False, str(error)
        self._node.get_logger().info(f"clear_tare: {response.message}")
        return response

    def _decide(
        self,
        number: int,
        rest: Array,
        created: datetime | None,
    ) -> None:
        """Keep the tare of a cube, or remove it, now or once its uid is known.

        Raises:
            ConfigError: The file cannot be written or removed.
        """
        if number in self.uids:
            self._update_file(number, rest, created)
        else:
            self._pending[number] = created

    def _find_cubes(self, names: list[str]) -> list[int]:
        """Return the indices of cubes by name, or of all cubes if none is named."""
        index = {name: number for number, name in enumerate(self._skin.names)}
        unknown = [name for name in names if name not in index]
        if unknown:
            raise TareError(
                f"no cube {', '.join(map(repr, unknown))} in the skin; "
                f"its cubes: {', '.join(self._skin.names)}"
            )
        return [index[name] for name in names] if names else list(index.values())

    def _keep_tares(self, cubes: list[int], rest: Array) -> str:
        """Keep the tares of cubes, and return what the answer should say about it."""
        created = datetime.now(timezone.utc)
        self.created.update(dict.fromkeys(cubes, created))
        if self._folder is None:
            return "; not kept"
        # Cubes without a uid come first: an error of the disk does not concern them.
        for number in sorted(cubes, key=lambda number: number in self.uids):
            try:
                self._decide(number, rest, created)
            except ConfigError as error:
                return f"; in force, but not kept: {error}"
        without_uid = [self._skin.names[number] for number in cubes if number not in self.uids]
        if without_uid:
            return f"; kept when their uid is known: {', '.join(without_uid)}"
        return "; kept on disk"
