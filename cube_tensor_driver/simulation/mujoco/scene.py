# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A MuJoCo scene as the load of a simulated skin, so that the driver can be run with a robot.

The scene is one XML file, whose motion is given by its keyframes:

- The text `skin` in `<custom>` names its skin file, relative to the scene's folder.
- The scene starts in the first keyframe, if that keyframe is at time 0.
- The controls `ctrl` of the keyframes are reached at their times, and change linearly in between.
- After the last keyframe the scene starts again. Without keyframes it goes on without an end.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...config.skin import Skin
from ...core.errors import ConfigError
from ..load import Resultant, StressField, compute_resultant
from .source import BodyContact, MujocoSkin, load_mujoco

if TYPE_CHECKING:
    from mujoco import MjModel

KEPT_S = 2.0
"""Time, in s, for which the contacts of a scene that does not repeat are kept in memory. The hubs
of a skin need the contacts at slightly different times, and a scene is only computed forwards."""

UNBOUNDED_PERIOD_S = 10.0
"""Length, in s, of the first part of a scene that never repeats. This part stands for the endless
scene where a finite length is needed. For example, the option `--instants` computes the load of
this part in advance and plays it again and again."""


def read_scene(path: Path) -> MjModel:
    """Read the model of an MJCF or URDF file.

    Raises:
        ConfigError: MuJoCo is not installed or cannot read the file.
    """
    mujoco = load_mujoco()
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; name a scene (MJCF, .xml)")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, RuntimeError, MemoryError) as error:
        # MuJoCo's messages have several lines, which become one.
        reason = " ".join(str(error).split())
        raise ConfigError(f"{path}: MuJoCo cannot read it: {reason}") from None


def find_scene_skin(path: Path) -> Path:
    """Return the skin file that a scene names.

    Raises:
        ConfigError: The scene cannot be read or names no skin file.
    """
    mujoco = load_mujoco()
    model = read_scene(path)
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, "skin")
    if number < 0:
        raise ConfigError(
            f'{path}: names no skin; add <custom><text name="skin" data="skin.yaml"/></custom>, '
            "or name the skin file (--config)"
        )
    # MuJoCo keeps all texts in one array, each with a zero at its end.
    start = model.text_adr[number]
    end = start + model.text_size[number]
    text = bytes(model.text_data[start:end])
    return path.parent / text.rstrip(b"\0").decode(errors="replace")


class MujocoLoad:
    """The contacts in a scene with a given motion, as a `load.AnyLoad`.

    The contacts depend on the time only, so that several processes compute the same load.

    Attributes:
        touch: The skin as a sensor; its `data` is the state of the scene that was computed last.
        poses: Poses of the cubes.
        depth: Distance from the centres of the cubes to the surface, in m.
        repeats: Time in s after which the scene repeats; None: never.
        period: Time in s after which the scene repeats; `UNBOUNDED_PERIOD_S` if it never does.
    """

    def __init__(
        self,
        path: Path,
        skin: Skin,
        *,
        thickness: float = np.inf,
        noise: float | None = 0.0,
    ) -> None:
        """Read the scene.

        Args:
            path: File of the scene.
            skin: Skin on its bodies.
            thickness: Thickness of the elastomer on rigid ground, in m; infinite for a half space.
            noise: Standard deviation of a frequency divided by the frequency; None: that of the
                calibration of each cube.

        Raises:
            ConfigError: The scene cannot be read, its keyframes are not sorted by time, or the skin
                does not fit it.
            ElasticError: The thickness is not above 0, or the cubes lie deeper than the layer.
        """
        self._mujoco = load_mujoco()
        model = read_scene(path)
        data = self._mujoco.MjData(model)
        self.touch = MujocoSkin(
            model,
            data,
            skin,
            thickness=thickness,
            noise=noise,
        )
        self.poses = self.touch.poses
        self.depth = self.touch.depth

        if np.any(np.diff(model.key_time) < 0):
            raise ConfigError(f"{path}: keyframes go back in time; sort them by their time")
        # If all keyframes are at time 0, they are only named states and no motion.
        self.repeats = float(max(model.key_time, default=0.0)) or None
        self.period = self.repeats or UNBOUNDED_PERIOD_S
        self._touches: dict[int, list[BodyContact]] = {}
        self._step = 0
        self._restart()

    def compute_stress_field(self, seconds: float) -> StressField:
        """Compute stress and gradient at the cubes under the contacts at a time in s."""
        return self.touch.field(self._find_touches_at(seconds))

    def compute_resultant(self, seconds: float) -> Resultant:
        """Return total force, centre of pressure and mean normal of all contacts at a time in s."""
        return compute_resultant([touch.press for touch in self._find_touches_at(seconds)])

    def _find_touches_at(self, seconds: float) -> list[BodyContact]:
        """Return the contacts at a time in s; the scene is computed up to it if necessary."""
        # A scene can only be computed forwards. Contacts at an earlier time are still in memory, or
        # the scene is computed again from its start.
        number = self._find_step_number(seconds)
        if number not in self._touches:
            if number < self._step:
                self._restart()
            while self._step < number:
                self._advance()
        return self._touches[number]

    def _find_step_number(self, seconds: float) -> int:
        """Return the number of the last step of the scene before a time in s."""
        if self.repeats is not None:
            seconds %= self.repeats
        # Without the small addition, a multiple of the time step could be rounded down by one step.
        steps = seconds / self.touch.model.opt.timestep
        return int(np.floor(steps + 1e-6))

    def _restart(self) -> None:
        """Reset the scene to its start."""
        model = self.touch.model
        data = self.touch.data
        if model.nkey and model.key_time[0] == 0:
            self._mujoco.mj_resetDataKeyframe(model, data, 0)
        else:
            self._mujoco.mj_resetData(model, data)
        self._mujoco.mj_forward(model, data)  # computes the contacts of the start
        self._step = 0
        self._touches[0] = self.touch.touches()

    def _advance(self) -> None:
        """Compute one step of the scene and keep its contacts."""
        model = self.touch.model
        data = self.touch.data
        if self.repeats is not None:
            for actuator, controls in enumerate(model.key_ctrl.T):
                data.ctrl[actuator] = np.interp(
                    data.time,
                    model.key_time,
                    controls,
                )
        self._mujoco.mj_step(model, data)
        self._step += 1
        self._touches[self._step] = self.touch.touches()
        if self.repeats is None:
            kept_steps = round(KEPT_S / model.opt.timestep)
            oldest = self._step - kept_steps
            self._touches.pop(oldest, None)
