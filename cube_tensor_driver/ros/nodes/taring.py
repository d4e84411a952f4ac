# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The services ~/tare and ~/clear_tare of the reconstruction node.

A tare measures the rest frequencies (frequencies without load) of a cube anew. It is stored in a
file named by the uid of the cube, and restored when the driver reports that uid.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from std_srvs.srv import Trigger

from ...config.skin import Skin
from ...config.tare import read_tare, remove_tare, write_tare
from ...core.arrays import Array
from ...core.errors import ConfigError, TareError
from ...core.reconstructor import Reconstructor
from ...msg import SkinInfo
from ...srv import Tare
from ..node import CubeNode

MAX_DATA_AGE_S = 1.0
"""Maximum age, in seconds, of the newest data when a tare (zeroing of the cubes) is requested. With
older data the request is refused, because the load on the skin may have changed since then."""


def find_tare_folder(parameter: str) -> Path:
    """Return the folder of the tare files.

    Args:
        parameter: Value of the parameter tare_folder. If it is empty, the folder is
            cube_tensor_driver/tare in the folder of the variable ROS_HOME, or in ~/.ros.
    """
    if parameter:
        return Path(parameter).expanduser()
    ros_home = os.environ.get("ROS_HOME") or Path.home() / ".ros"
    return Path(ros_home) / "cube_tensor_driver" / "tare"


class Taring:
    """Offers the services for tares in a reconstruction node, and stores tares in files.

    A tare is a new measurement of the rest frequencies (frequencies without load) of a cube.

    Attributes:
        uids: Index of a cube in the skin -> its uid (unique number), for cubes whose uid is known
            from the skin file or from the hub.
        created: Index of a cube in the skin -> time at which its tare was measured; None: it was
            cleared. A tare that was measured or cleared before the uid was known is stored as soon
            as the uid is known.
    """

    def __init__(
        self,
        node: CubeNode,
        skin: Skin,
        reconstructor: Reconstructor,
        folder: Path | None,
        lock: AbstractContextManager[object],
        on_change: Callable[[], None],
    ) -> None:
        """Offer the services, and restore the tares of cubes whose uid is in the skin file.

        Args:
            node: The node, which is being configured.
            skin: The skin.
            reconstructor: Measures the rest frequencies and computes the stress from them.
            folder: Folder of the tare files; None: tares are neither stored nor restored.
            lock: Held by this class while it uses the reconstructor.
            on_change: Called, while the lock is held, when rest frequencies or uids have changed.
        """
        self._node = node
        self._reconstructor = reconstructor
        self._skin = skin
        self._folder = folder
        self._lock = lock
        self._on_change = on_change
        self.uids: dict[int, int] = {}
        self.created: dict[int, datetime | None] = {}

        # The lock need not be held and on_change not be called here, because nothing else uses the
        # reconstructor before the node is configured.
        configured = {number: cube.uid for number, cube in enumerate(skin.cubes) if cube.uid}
        restored = self._learn_uids(configured)
        if restored is not None:
            reconstructor.rest_frequency = restored
        node.own(node.create_service(Tare, "~/tare", self._on_tare))
        node.own(node.create_service(Trigger, "~/clear_tare", self._on_clear))

    def on_info(self, message: SkinInfo) -> None:
        """Store the unique numbers (uids) of the cubes that hubs have reported, and restore tares.

        Args:
            message: Message of `driver/info`, which contains the uids.
        """
        # If the driver of another skin publishes in the same namespace by mistake, its uids must
        # not be used.
        has_same_name = message.name == self._skin.name
        has_same_size = len(message.cubes) == len(self._skin.cubes)
        if not (has_same_name and has_same_size):
            return
        # The tare files are read before the lock is acquired. Reading them takes time, in which the
        # lock would keep the node from processing data.
        uids_before = dict(self.uids)
        reported = {number: cube.uid for number, cube in enumerate(message.cubes) if cube.uid}
        restored = self._learn_uids(reported)
        with self._lock:
            if restored is not None:
                self._reconstructor.rest_frequency = restored
            if self.uids != uids_before:
                self._on_change()

    def describe_age(self) -> dict[str, str]:
        """Return the number of tared cubes, and the age in seconds of the oldest tare, as texts.

        The keys of the dict are the keys of the diagnostic status, such as "cubes tared".
        """
        times = [created for created in self.created.values() if created]
        if not times:
            return {"cubes tared": "0"}
        oldest = datetime.now(timezone.utc) - min(times)
        return {
            "cubes tared": str(len(times)),
            "oldest tare s": f"{oldest.total_seconds():.0f}",
        }

    def _learn_uids(self, uids: Mapping[int, int]) -> Array | None:
        """Store the uids of cubes, and restore the tares of cubes whose uid is new or has changed.

        A cube gets the tare that is stored for its uid. If the cube was exchanged and no tare is
        stored for the new cube, it gets the rest frequencies of its calibration.

        Args:
            uids: Index of a cube in the skin -> its uid.

        Returns:
            The rest frequencies of all cubes, (cubes, pads), in Hz; None if none has changed.
        """
        rest = self._reconstructor.rest_frequency
        before = rest.copy()
        for number, uid in uids.items():
            known = self.uids.get(number)
            if known == uid:
                continue
            self.uids[number] = uid
            cube = self._skin.cubes[number]
            if known is not None:
                # The cube was exchanged, so that its tare is not valid.
                n_pads = cube.calibration.layout.n_pads
                rest[number, :n_pads] = cube.calibration.rest_frequency
                self.created.pop(number, None)
            try:
                if number in self.created:
                    # The cube was tared, or its tare cleared, since the node was started. That is
                    # newer than the tare file, which an earlier run of the node wrote.
                    self._store(number, rest)
                else:
                    self._restore_tare(number, uid, rest)
            except ConfigError as error:
                log = self._node.get_logger()
                log.warning(f"cube {cube.name}: tare not restored or kept: {error}")
        return None if np.array_equal(before, rest, equal_nan=True) else rest

    def _restore_tare(self, number: int, uid: int, rest: Array) -> None:
        """Read the tare file of a cube, if it exists, and write its content into `rest`.

        Args:
            number: Index of the cube in the skin.
            uid: Unique number of the cube, which is part of the name of the file.
            rest: Rest frequencies (without load) of all cubes, (cubes, pads), in Hz, which are
                changed.

        Raises:
            ConfigError: The file cannot be used.
        """
        if self._folder is None:
            return
        cube = self._skin.cubes[number]
        stored = read_tare(self._folder, uid, cube.calibration)
        if stored is not None:
            n_pads = cube.calibration.layout.n_pads
            rest[number, :n_pads] = stored.rest_frequency
            self.created[number] = stored.created
            log = self._node.get_logger()
            log.info(f"cube {cube.name}: tare of {stored.created} restored")

    def _store(self, number: int, rest: Array) -> None:
        """Write the tare file of a cube, or remove it if the tare was cleared.

        Nothing is done while the uid (unique number) of the cube is unknown, because the file is
        named by it.

        Args:
            number: Index of the cube in the skin.
            rest: Rest frequencies (without load) of all cubes, (cubes, pads), in Hz.

        Raises:
            ConfigError: The file cannot be written or removed.
        """
        if self._folder is None or number not in self.uids:
            return
        uid = self.uids[number]
        created = self.created[number]
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

    def _on_tare(
        self,
        request: Tare.Request,
        response: Tare.Response,
    ) -> Tare.Response:
        response.message = self._tare(request.cubes, request.duration)
        response.success = True
        self._node.get_logger().info(f"tare: {response.message}")
        return response

    def _tare(self, names: list[str], duration_s: float) -> str:
        """Measure and store the rest frequencies (without load) of cubes, and return a text for the
        response of the service.

        Args:
            names: Names of the cubes; an empty list: all cubes.
            duration_s: Time, in seconds, over which frequencies are averaged; 0: the value of the
                parameter tare_duration.

        Raises:
            TareError: No data arrive, a name is unknown, or the reconstructor refuses the tare.
        """
        cubes = self._find_cubes(names)
        now_ns = self._node.get_clock().now().nanoseconds
        duration_s = duration_s or float(self._node.read_value("tare_duration"))
        with self._lock:
            # The reconstructor keeps its newest data after the connections to the hubs were lost. A
            # tare from such old data would succeed, but with wrong values.
            age_ns = now_ns - self._reconstructor.health.newest_ns
            if age_ns > 1e9 * MAX_DATA_AGE_S:
                raise TareError("no data now: see the diagnostics of the links")
            before = self._reconstructor.rest_frequency
            rest = self._reconstructor.tare(cubes, duration_s)
            self._on_change()
        relative_change = np.abs(rest / before - 1)[cubes]
        # Cubes with fewer pads than others have NaN in the columns of the pads that they lack.
        moved_ppm = 1e6 * np.nanmax(relative_change)
        kept = self._keep_tares(cubes, rest)
        return f"{len(cubes)} cubes, rest frequencies moved by up to {moved_ppm:.0f} ppm{kept}"

    def _on_clear(
        self,
        request: Trigger.Request,
        response: Trigger.Response,
    ) -> Trigger.Response:
        with self._lock:
            self._reconstructor.clear_tare()
            self._on_change()
            rest = self._reconstructor.rest_frequency
        self.created = dict.fromkeys(range(len(self._skin.cubes)))
        for number in self.created:
            self._store(number, rest)
        response.success = True
        response.message = "rest frequencies are the calibrations' again"
        self._node.get_logger().info(f"clear_tare: {response.message}")
        return response

    def _find_cubes(self, names: list[str]) -> list[int]:
        """Return the indices of the cubes with these names; an empty list stands for all cubes.

        Raises:
            TareError: The skin has no cube of one of the names.
        """
        index = {name: number for number, name in enumerate(self._skin.names)}
        unknown = [name for name in names if name not in index]
        if unknown:
            raise TareError(
                f"no cube {', '.join(map(repr, unknown))} in the skin; "
                f"its cubes: {', '.join(self._skin.names)}"
            )
        # Names may be repeated in the request. Each cube is tared only once, because each tare
        # writes a file. The keys of a dict are unique and keep their order.
        return list({index[name]: None for name in names or index})

    def _keep_tares(self, cubes: list[int], rest: Array) -> str:
        """Store the tares of cubes, and return a text for the response that states the result.

        Args:
            cubes: Indices of the cubes in the skin.
            rest: Rest frequencies (without load) of all cubes, (cubes, pads), in Hz.
        """
        created = datetime.now(timezone.utc)
        self.created.update(dict.fromkeys(cubes, created))
        if self._folder is None:
            return "; not kept"
        try:
            for number in cubes:
                self._store(number, rest)
        except ConfigError as error:
            return f"; in force, but not kept: {error}"
        without_uid = [number for number in cubes if number not in self.uids]
        if without_uid:
            names = [self._skin.names[number] for number in without_uid]
            return f"; kept when their uid is known: {', '.join(names)}"
        return "; kept on disk"
