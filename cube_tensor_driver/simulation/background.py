# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated hubs in the background of a program that computes the load itself.

An example is a program that simulates a robot with its controller. The driver reads the simulated
hubs in the same way as real ones::

    touch = MujocoSkin(model, data, skin)
    with BackgroundHubs(skin, "ports") as hubs:
        while True:
            mujoco.mj_step(model, data)
            hubs.set_load(*touch.field(touch.touches()))
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..config.skin import Skin
from ..core.errors import ConfigError
from .cubes import PadErrors
from .load import StressField
from .simulator import Simulator, StopRequest


class BackgroundHubs:
    """Simulates all hubs of a skin on pseudo-terminals, in real time in a thread, until `close`.

    The load of each sample is read in advance, just after the previous sample was taken. So a new
    load acts from the second sample after the call of `set_load` on. Before the first call, there
    is no load.
    """

    def __init__(
        self,
        skin: Skin,
        ports: Path | str,
        *,
        noise: float | None = 0.0,
        drift: float = 0.0,
    ) -> None:
        """Start the hubs.

        Args:
            skin: Skin whose hubs are simulated.
            ports: Folder in which the ports appear, each under the name of its link. `open_links`
                and the driver node take it as `port_directory`.
            noise: Standard deviation of a frequency divided by the frequency; None: that of the
                calibration of each cube.
            drift: Relative change of every rest frequency (frequency without load) per second.

        Raises:
            ConfigError: Cubes of one hub have different numbers of pads, or the folder cannot be
                used.
        """
        cubes = len(skin.cubes)
        unloaded = np.zeros((cubes, 6)), np.zeros((cubes, 6, 3))
        self._load = _SetLoad(unloaded)
        self._simulator = Simulator(
            skin,
            self._load,
            Path(ports),
            PadErrors(noise, drift),
        )
        self._stop = StopRequest()
        self._thread = threading.Thread(
            target=self._simulator.run,
            args=(self._stop,),
            daemon=True,
        )
        self._thread.start()

    def set_load(self, stress: ArrayLike, gradient: ArrayLike) -> None:
        """Set the fields that act on the cubes from now on, in the frames of the cubes.

        Args:
            stress: Stress (cubes, 6) in Pa, order xx yy zz yz zx xy.
            gradient: Gradient (cubes, 6, 3) in Pa/m.

        Raises:
            ConfigError: Stress or gradient has another shape.
        """
        new = np.array(stress, float), np.array(gradient, float)
        shapes = [part.shape for part in new]
        needed = [part.shape for part in self._load.field]
        if shapes != needed:
            raise ConfigError(f"stress and gradient have the shapes {shapes}; allowed: {needed}")
        # The thread of the simulator, which reads both arrays, never mixes two loads, because this
        # assignment is atomic in Python.
        self._load.field = new

    def close(self) -> None:
        """Stop the hubs and remove their ports."""
        self._stop.request()
        self._thread.join()
        self._simulator.close()

    def __enter__(self) -> BackgroundHubs:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


@dataclass
class _SetLoad:
    """A load (`load.Fields`) whose stress and gradient at the cubes another thread sets."""

    field: StressField
    repeats: float | None = None
    period: float = 0.0

    def compute_stress_field(self, seconds: float) -> StressField:
        """Return the stress and gradient that were set last."""
        return self.field
