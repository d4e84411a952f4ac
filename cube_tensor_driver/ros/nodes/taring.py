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
        if message.name != self._skin.name or len(message.cubes) != len(self._skin.cubes):
            return
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
        oldest = (datetime.now(timezone.utc) - min(self.created.values())).total_seconds()
        return {"cubes tared": str(len(self.created)), "oldest tare s": f"{oldest:.0f}"}

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
            if number in self.uids:
                self._forget_tare(number, rest)
            self.uids[number] = uid
            if number in self._pending:
                self._keep_pending(number, uid, rest)
            else:
                self._restore_tare(number, uid, rest)
        return None if np.array_equal(before, rest, equal_nan=True) else rest

    def _restore_tare(self, number: int, uid: int, rest: Array) -> None:
        """Read the tare of one cube into its row of the rest frequencies."""
        cube, log = self._skin.cubes[number], self._node.get_logger()
        try:
            stored = read_tare(self._folder, uid, cube.calibration) if self._folder else None
        except ConfigError as error:
            log.warning(f"cube {cube.name}: tare not restored: {error}")
            return
        if stored is not None:
            rest[number, : cube.calibration.layout.n_pads] = stored.rest_frequency
            self.created[number] = stored.created
            log.info(f"cube {cube.name}: tare of {stored.created} restored")

    def _keep_pending(self, number: int, uid: int, rest: Array) -> None:
        """Write or remove the file of a cube that was tared or cleared before its uid was known."""
        created, cube = self._pending.pop(number), self._skin.cubes[number]
        if self._folder is None:
            return
        try:
            if created is None:
                remove_tare(self._folder, uid)
            else:
                rest_of_cube = rest[number, : cube.calibration.layout.n_pads]
                write_tare(self._folder, uid, cube.calibration, rest_of_cube, created)
        except ConfigError as error:
            self._node.get_logger().warning(f"cube {cube.name}: tare not kept: {error}")

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
            if now_ns - self._reconstructor.health.newest_ns > 1e9 * MAX_DATA_AGE_S:
                raise TareError("no data now: see the diagnostics of the links")
            before = self._reconstructor.rest_frequency
            rest = self._reconstructor.tare(cubes, duration_s)
            self._on_change()
        moved_ppm = 1e6 * np.nanmax(np.abs(rest / before - 1)[cubes])
        kept = self._keep_tares(cubes, rest)
        return f"{len(cubes)} cubes, rest frequencies moved by up to {moved_ppm:.0f} ppm{kept}"

    def _on_clear(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, "rest frequencies are the calibrations' again"
        with self._lock:
            self._reconstructor.clear_tare()
            self._on_change()
        self.created.clear()
        self._pending = {n: None for n in range(len(self._skin.cubes)) if n not in self.uids}
        try:
            if self._folder is not None:
                for uid in self.uids.values():
                    remove_tare(self._folder, uid)
        except ConfigError as error:
            response.success, response.message = False, str(error)
        self._node.get_logger().info(f"clear_tare: {response.message}")
        return response

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
        """Write files, and return what the answer should say about it."""
        created = datetime.now(timezone.utc)
        self.created.update(dict.fromkeys(cubes, created))
        if self._folder is None:
            return "; not kept"
        without_uid = [number for number in cubes if number not in self.uids]
        self._pending.update(dict.fromkeys(without_uid, created))
        for number in cubes:
            if number in without_uid:
                continue
            calibration = self._skin.cubes[number].calibration
            rest_of_cube = rest[number, : calibration.layout.n_pads]
            try:
                write_tare(self._folder, self.uids[number], calibration, rest_of_cube, created)
            except ConfigError as error:
                return f"; in force, but not kept: {error}"
        if without_uid:
            names = ", ".join(self._skin.names[number] for number in without_uid)
            return f"; kept when their uid is known: {names}"
        return "; kept on disk"

    def _forget_tare(self, number: int, rest: Array) -> None:
        calibration = self._skin.cubes[number].calibration
        rest[number, : calibration.layout.n_pads] = calibration.rest_frequency
        self.created.pop(number, None)
