# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The camera of LeRobot that records a skin and returns pictures of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lerobot.cameras import Camera, CameraConfig
from lerobot.utils.errors import DeviceNotConnectedError

import cube_tensor_driver as ctd
from cube_tensor_driver.core.arrays import AnyArray
from cube_tensor_driver.lerobot.live import LiveWindows

CONNECT_TIMEOUT_S = 10.0
"""Longest time, in s, from opening the links to the first sample. Hubs that restart when their
port is opened need a few seconds."""

TIMEOUT_MS = 200.0
"""Longest time, in ms, to wait for a sample: the default of LeRobot's cameras."""


@CameraConfig.register_subclass("cube")
@dataclass(kw_only=True)
class CubeCameraConfig(CameraConfig):  # type: ignore[misc]
    """Options of the camera.

    Attributes:
        skin: Path of the skin file.
        folder: Folder in which the stress is recorded.
        full_scale: Pressure (compressive stress along z of the cube), in Pa, with the brightest
            colour of the picture.
        fps: Frames per second of the data set. The skin samples at the rate of its skin file.
        width: Width of the picture, in pixels.
        height: Height of the picture, in pixels.
    """

    skin: str
    folder: str
    full_scale: float = 20e3
    fps: int | None = 30
    width: int | None = 320
    height: int | None = 240


class CubeCamera(Camera):  # type: ignore[misc]
    """Records all samples of a skin; a frame has the samples since the last frame was read."""

    def __init__(self, config: CubeCameraConfig) -> None:
        super().__init__(config)
        self._config = config
        self._live: LiveWindows | None = None

    @property
    def is_connected(self) -> bool:
        """Whether the links of the skin are open."""
        return self._live is not None

    @staticmethod
    def find_cameras() -> list[dict[str, object]]:
        """Return an empty list, because a skin is found by its skin file only."""
        return []

    def connect(self, warmup: bool = True) -> None:
        """Open the links of the skin.

        Args:
            warmup: Whether to wait for the first sample, which begins the recording.
        """
        config = self._config
        if self._live is not None:
            raise ctd.CubeError(f"skin {config.skin} is connected already; disconnect it first")
        source = ctd.open_links(config.skin)
        try:
            self._live = LiveWindows(
                source,
                Path(config.folder),
                width=self.width or 0,
                height=self.height or 0,
                full_scale=config.full_scale,
            )
            if warmup:
                self.async_read(1000 * CONNECT_TIMEOUT_S)
        except BaseException:
            self.disconnect()
            source.close()
            raise

    def read(self) -> AnyArray:
        """Return a picture of the skin and record the samples since the last one."""
        return self.async_read()

    def async_read(self, timeout_ms: float = TIMEOUT_MS) -> AnyArray:
        """Return a picture of the skin and record the samples since the last one.

        Args:
            timeout_ms: Longest time, in ms, to wait for a sample if there is none.

        Raises:
            TimeoutError: No sample arrived.
        """
        if self._live is None:
            raise DeviceNotConnectedError(f"skin {self._config.skin} is not connected")
        return self._live.take_next_picture(timeout_ms / 1000)

    def read_latest(self, max_age_ms: int = 500) -> AnyArray:
        """Return a picture of the skin and record the samples since the last one.

        The robots of LeRobot 0.4.4 read cameras with this method, once in each frame.

        Args:
            max_age_ms: Longest time, in ms, to wait for a sample if there is none.

        Raises:
            TimeoutError: No sample arrived.
        """
        return self.async_read(max_age_ms)

    def disconnect(self) -> None:
        """Close the links of the skin and complete the recording."""
        if self._live is not None:
            self._live.close()
            self._live = None
