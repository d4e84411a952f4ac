"""Tare as services: ~/tare and ~/clear_tare, kept on disk by uid, restored when the driver says who
the cubes are."""

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
from ...core.errors import ConfigError, CubeError, TareError
from ...core.reconstructor import Reconstructor
from ...msg import SkinInfo
from ...srv import Tare
from ..node import CubeNode

STALE_S = 1.0
"""Data older than this is not the present load."""


def tare_folder(parameter: str) -> Path:
    """The folder of parameter tare_folder; without it, below ROS_HOME or ~/.ros."""
    if parameter:
        return Path(parameter).expanduser()
    return Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "cube_tensor_driver" / "tare"


class Taring:
    """The services of one reconstruction, and the files behind them.

    uids: of the cubes, by their index in the skin, as far as they are known
    created: when the tare of a cube was taken
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
        """folder: where tares are kept, None: nowhere; lock: held while the reconstructor is used;
        on_change: called, with the lock, when rest frequencies or uids have changed."""
        self._node, self._reconstructor = node, reconstructor
        self._skin, self._folder = skin, folder
        self._lock, self._on_change = lock, on_change
        self.uids: dict[int, int] = {}
        self.created: dict[int, datetime] = {}
        # Cubes that were tared, and when, or cleared (None), before their uid was known.
        self._decided: dict[int, datetime | None] = {}
        # Uids of the skin file are known at once; nobody has seen the rest frequencies yet.
        restored = self._restore({n: cube.uid for n, cube in enumerate(skin.cubes) if cube.uid})
        if restored is not None:
            reconstructor.rest_frequency = restored
        self._services = [
            node.create_service(Tare, "~/tare", self._on_tare),
            node.create_service(Trigger, "~/clear_tare", self._on_clear),
        ]

    def close(self) -> None:
        for service in self._services:
            self._node.destroy_service(service)

    def on_info(self, message: SkinInfo) -> None:
        """The driver's info: uids of cubes that the skin file does not name, which our own info
        says from then on."""
        if message.name != self._skin.name or len(message.cubes) != len(self._skin.cubes):
            return
        before = dict(self.uids)
        restored = self._restore({n: cube.uid for n, cube in enumerate(message.cubes) if cube.uid})
        with self._lock:
            if restored is not None:
                self._reconstructor.rest_frequency = restored
            if self.uids != before:
                self._on_change()

    def age(self) -> dict[str, str]:
        """For diagnostics: how many cubes are tared, and since when."""
        if not self.created:
            return {"cubes tared": "0"}
        oldest = (datetime.now(timezone.utc) - min(self.created.values())).total_seconds()
        return {"cubes tared": str(len(self.created)), "oldest tare s": f"{oldest:.0f}"}

    def _restore(self, uids: Mapping[int, int]) -> np.ndarray | None:
        """Learn who the cubes are; returns the rest frequencies if that changes them: the tare that
        is kept of a cube; the calibration's of a cube that was exchanged."""
        rest = self._reconstructor.rest_frequency
        before = rest.copy()
        for number, uid in uids.items():
            if self.uids.get(number) == uid:
                continue
            if number in self.uids:
                self._forget(number, rest)
            self.uids[number] = uid
            if number in self._decided:
                self._keep_decision(number, uid, rest)
            else:
                self._restore_cube(number, uid, rest)
        return None if np.array_equal(before, rest, equal_nan=True) else rest

    def _restore_cube(self, number: int, uid: int, rest: np.ndarray) -> None:
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

    def _keep_decision(self, number: int, uid: int, rest: np.ndarray) -> None:
        """The uid of a cube has become known: what was decided of it before goes to disk."""
        created, cube = self._decided.pop(number), self._skin.cubes[number]
        if self._folder is None:
            return
        try:
            if created is None:
                remove_tare(self._folder, uid)
            else:
                of_cube = rest[number, : cube.calibration.layout.n_pads]
                write_tare(self._folder, uid, cube.calibration, of_cube, created)
        except ConfigError as error:
            self._node.get_logger().warning(f"cube {cube.name}: tare not kept: {error}")

    def _on_tare(self, request: Tare.Request, response: Tare.Response) -> Tare.Response:
        try:
            cubes = self._find(request.cubes)
            now_ns = self._node.get_clock().now().nanoseconds
            duration = request.duration or float(self._node.value("tare_duration"))
            with self._lock:
                if now_ns - self._reconstructor.health.newest_ns > 1e9 * STALE_S:
                    raise TareError("no data now: see the diagnostics of the links")
                before = self._reconstructor.rest_frequency
                rest = self._reconstructor.tare(cubes, duration)
                self._on_change()
            moved = np.nanmax(np.abs(rest / before - 1)[cubes])
            response.message = (
                f"{len(cubes)} cubes, rest frequencies moved by up to {1e6 * moved:.0f} ppm"
            )
            response.message += self._keep(cubes, rest)
            response.success = True
        except CubeError as error:
            response.success, response.message = False, str(error)
        self._node.get_logger().info(f"tare: {response.message}")
        return response

    def _on_clear(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, "rest frequencies are the calibrations' again"
        with self._lock:
            self._reconstructor.clear_tare()
            self._on_change()
        self.created.clear()
        self._decided = {n: None for n in range(len(self._skin.cubes)) if n not in self.uids}
        try:
            if self._folder is not None:
                for uid in self.uids.values():
                    remove_tare(self._folder, uid)
        except ConfigError as error:
            response.success, response.message = False, str(error)
        self._node.get_logger().info(f"clear_tare: {response.message}")
        return response

    def _find(self, names: list[str]) -> list[int]:
        """Indices of cubes by name; of all cubes if none is named."""
        index = {name: number for number, name in enumerate(self._skin.names)}
        unknown = [name for name in names if name not in index]
        if unknown:
            raise TareError(
                f"no cube {', '.join(map(repr, unknown))} in the skin; "
                f"its cubes: {', '.join(self._skin.names)}"
            )
        return [index[name] for name in names] if names else list(index.values())

    def _keep(self, cubes: list[int], rest: np.ndarray) -> str:
        """Write files; returns what the answer should say about it."""
        created = datetime.now(timezone.utc)
        self.created.update(dict.fromkeys(cubes, created))
        if self._folder is None:
            return "; not kept"
        without_uid = [self._skin.names[number] for number in cubes if number not in self.uids]
        self._decided.update({number: created for number in cubes if number not in self.uids})
        for number in cubes:
            if number not in self.uids:
                continue
            calibration = self._skin.cubes[number].calibration
            of_cube = rest[number, : calibration.layout.n_pads]
            try:
                write_tare(self._folder, self.uids[number], calibration, of_cube, created)
            except ConfigError as error:
                return f"; in force, but not kept: {error}"
        if without_uid:
            return f"; kept when their uid is known: {', '.join(without_uid)}"
        return "; kept on disk"

    def _forget(self, number: int, rest: np.ndarray) -> None:
        calibration = self._skin.cubes[number].calibration
        rest[number, : calibration.layout.n_pads] = calibration.rest_frequency
        self.created.pop(number, None)
