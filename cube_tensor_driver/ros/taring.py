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
from rclpy.node import Node
from std_srvs.srv import Trigger

from cube_tensor_driver.msg import SkinInfo
from cube_tensor_driver.srv import Tare

from ..config.skin import Skin
from ..config.tare import read_tare, remove_tare, write_tare
from ..core.errors import ConfigError, CubeError, TareError
from ..core.health import Health
from ..core.pipeline import Pipeline
from ..core.tare import measure_rest

STALE_S = 1.0
"""Data older than this is not the present load."""


def tare_folder(parameter: str) -> Path:
    """The folder of parameter tare_folder; without it, below ROS_HOME or ~/.ros."""
    if parameter:
        return Path(parameter).expanduser()
    return Path(os.environ.get("ROS_HOME") or Path.home() / ".ros") / "cube_tensor_driver" / "tare"


class Taring:
    """The services of one reconstruction. changed: called when rest frequencies have changed; lock:
    held meanwhile.

    folder: None keeps and restores nothing."""

    def __init__(
        self,
        node: Node,
        skin: Skin,
        pipeline: Pipeline,
        health: Health,
        folder: Path | None,
        duration: Callable[[], float],
        changed: Callable[[], None],
        lock: AbstractContextManager[Any],
    ) -> None:
        self._node, self._skin, self._pipeline, self._health = node, skin, pipeline, health
        self._folder, self._duration, self._changed, self._lock = folder, duration, changed, lock
        self._names = [cube.name for cube in skin.cubes]
        self._calibrated = Pipeline(pipeline.calibrations).rest_frequency
        self.uids: dict[int, int] = {}
        self.created: dict[int, datetime] = {}
        self._services = [
            node.create_service(Tare, "~/tare", self._on_tare),
            node.create_service(Trigger, "~/clear_tare", self._on_clear),
        ]
        self._learn({number: cube.uid for number, cube in enumerate(skin.cubes) if cube.uid})

    def close(self) -> None:
        for service in self._services:
            self._node.destroy_service(service)

    def on_info(self, message: SkinInfo) -> None:
        """The driver's `info`: uids of cubes that the skin file does not name. Our own says nothing
        new."""
        if message.name == self._skin.name and len(message.cubes) == len(self._names):
            self._learn({number: cube.uid for number, cube in enumerate(message.cubes) if cube.uid})

    def age(self) -> dict[str, str]:
        """For diagnostics: how many cubes are tared, and since when."""
        if not self.created:
            return {"cubes tared": "0"}
        oldest = (datetime.now(timezone.utc) - min(self.created.values())).total_seconds()
        return {"cubes tared": str(len(self.created)), "oldest tare s": f"{oldest:.0f}"}

    def _learn(self, uids: Mapping[int, int]) -> None:
        """Cubes are known now: restore what is kept of them; a cube that was exchanged starts as
        calibrated."""
        fresh = {number: uid for number, uid in uids.items() if self.uids.get(number) != uid}
        rest = self._pipeline.rest_frequency
        before = rest.copy()
        for number, uid in fresh.items():
            if number in self.uids:
                self._forget(number, rest)
            self.uids[number] = uid
            calibration = self._skin.cubes[number].calibration
            try:
                stored = read_tare(self._folder, uid, calibration) if self._folder else None
            except ConfigError as error:
                self._node.get_logger().warning(
                    f"cube {self._names[number]}: tare not restored: {error}"
                )
                continue
            if stored is not None:
                rest[number, : calibration.layout.n_pads] = stored.rest_frequency
                self.created[number] = stored.created
                self._node.get_logger().info(
                    f"cube {self._names[number]}: tare of {stored.created} restored"
                )
        if not np.array_equal(before, rest, equal_nan=True):
            self._set(rest)

    def _on_tare(self, request: Tare.Request, response: Tare.Response) -> Tare.Response:
        try:
            cubes = self._find(request.cubes)
            now_ns = self._node.get_clock().now().nanoseconds
            with self._lock:
                if now_ns - self._health.newest_ns > 1e9 * STALE_S:
                    raise TareError("no data now: see the diagnostics of the links")
                rest = measure_rest(
                    self._pipeline,
                    self._health,
                    cubes,
                    request.duration or self._duration(),
                    self._names,
                )
                moved = np.nanmax(np.abs(rest / self._pipeline.rest_frequency - 1)[cubes])
            self._set(rest)
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
        rest = self._pipeline.rest_frequency
        response.success, response.message = True, "rest frequencies are the calibrations' again"
        try:
            for number in range(len(self._names)):
                self._forget(number, rest)
            if self._folder is not None:
                for uid in self.uids.values():
                    remove_tare(self._folder, uid)
        except ConfigError as error:
            response.success, response.message = False, str(error)
        self._set(rest)
        self._node.get_logger().info(f"clear_tare: {response.message}")
        return response

    def _find(self, names: list[str]) -> list[int]:
        unknown = [name for name in names if name not in self._names]
        if unknown:
            raise TareError(
                f"no cube {', '.join(map(repr, unknown))} in the skin; its cubes: {', '.join(self._names)}"
            )
        return (
            [self._names.index(name) for name in names] if names else list(range(len(self._names)))
        )

    def _keep(self, cubes: list[int], rest: np.ndarray) -> str:
        """Write files; returns what the answer should say about it."""
        created = datetime.now(timezone.utc)
        self.created.update(dict.fromkeys(cubes, created))
        if self._folder is None:
            return "; not kept"
        nameless = []
        for number in cubes:
            if number not in self.uids:
                nameless.append(self._names[number])
                continue
            calibration = self._skin.cubes[number].calibration
            try:
                write_tare(
                    self._folder,
                    self.uids[number],
                    calibration,
                    rest[number, : calibration.layout.n_pads],
                    created,
                )
            except ConfigError as error:
                return f"; in force, but not kept: {error}"
        return (
            f"; not kept, since their uid is not known: {', '.join(nameless)}"
            if nameless
            else "; kept on disk"
        )

    def _forget(self, number: int, rest: np.ndarray) -> None:
        rest[number] = self._calibrated[number]
        self.created.pop(number, None)

    def _set(self, rest: np.ndarray) -> None:
        with self._lock:
            self._pipeline.rest_frequency = rest
            self._health.refresh()
            self._changed()
