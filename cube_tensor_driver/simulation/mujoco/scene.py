"""A MuJoCo scene as the load of a simulated skin, so that the real driver runs against a robot.

The scene is one XML file that plays by itself:

- the text `skin` in `<custom>` names its skin file, relative to the scene's folder;
- it starts in the first keyframe, if that is at time 0;
- the controls `ctrl` of the keyframes are reached at their times, and change linearly in between;
- after the last keyframe it starts again. Without keyframes it goes on without an end.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...config.skin import Skin
from ...core.arrays import Array
from ...core.errors import ConfigError
from ..load import total
from .source import MujocoSkin, Touch, load_mujoco

if TYPE_CHECKING:
    from mujoco import MjModel

KEPT_S = 2.0
"""What is kept of a scene that does not repeat: hubs ask for slightly different times."""
WHOLE_S = 10.0
"""What counts as the whole of a scene that does not repeat."""


def read_scene(path: Path) -> MjModel:
    """The model of an MJCF or URDF file. ConfigError: MuJoCo is missing, or cannot read it."""
    mujoco = load_mujoco()
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; name a scene (MJCF, .xml)")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, RuntimeError, MemoryError) as error:
        said = " ".join(str(error).split())
        raise ConfigError(f"{path}: MuJoCo cannot read it: {said}") from None


def scene_skin(path: Path) -> Path:
    """The skin file that a scene names. ConfigError: it names none."""
    mujoco, model = load_mujoco(), read_scene(path)
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, "skin")
    if number < 0:
        raise ConfigError(
            f'{path}: names no skin; add <custom><text name="skin" data="skin.yaml"/></custom>, '
            "or name the skin file (--config)"
        )
    start, size = model.text_adr[number], model.text_size[number]
    text = bytes(model.text_data[start : start + size])
    return path.parent / text.rstrip(b"\0").decode(errors="replace")


class MujocoLoad:
    """A scene that plays by itself, as a `load.AnyLoad`: the same at the same time.

    touch: the skin as a sensor, of the state that was computed last
    Other parameters and what is raised: as in `MujocoSkin`, and ConfigError for the scene.
    """

    def __init__(
        self,
        path: Path,
        skin: Skin,
        *,
        thickness: float = np.inf,
        noise: float | None = 0.0,
    ) -> None:
        self._mujoco = load_mujoco()
        model = read_scene(path)
        data = self._mujoco.MjData(model)
        self.touch = MujocoSkin(model, data, skin, thickness=thickness, noise=noise)
        self.poses, self.depth = self.touch.poses, self.touch.depth
        self._times, self._controls = _timeline(path, model)
        self.repeats = float(self._times[-1]) if len(self._times) else None
        self.period = self.repeats or WHOLE_S
        self._touches: dict[int, list[Touch]] = {}
        self._step = 0
        self._restart()

    def at(self, seconds: float) -> tuple[Array, Array]:
        """As `AnyLoad.at`: of the last step of the scene that is not later."""
        return self.touch.field(self._at(seconds))

    def total(self, seconds: float) -> tuple[Array, Array, Array]:
        """As `AnyLoad.total`."""
        return total([touch.press for touch in self._at(seconds)])

    def play(self, seconds: float) -> None:
        """Bring `touch.data` to this time."""
        self._restart()
        while self._step < self._number(seconds):
            self._go_on()

    def picture(
        self, width: int, height: int, *, lookat: Array, distance: float, azimuth: float
    ) -> NDArray[np.uint8]:
        """The scene as it is now, pixels (height, width, 3), without a display.

        lookat: (3,) m, in the middle; distance: of the camera, m; azimuth: degrees

        ConfigError: OpenGL cannot draw here.
        """
        mujoco = self._mujoco
        camera = mujoco.MjvCamera()
        camera.lookat[:], camera.distance = lookat, distance
        camera.azimuth, camera.elevation = azimuth, -12.0
        try:
            with mujoco.Renderer(self.touch.model, height, width) as renderer:
                renderer.update_scene(self.touch.data, camera)
                pixels: NDArray[np.uint8] = renderer.render()
        except (ImportError, AttributeError, RuntimeError, OSError, mujoco.FatalError) as error:
            raise ConfigError(
                f"MuJoCo cannot draw without a display ({error}): apt-get install libegl1 "
                "libegl-mesa0, and set MUJOCO_GL=egl"
            ) from None
        return pixels

    def _at(self, seconds: float) -> list[Touch]:
        number = self._number(seconds)
        if number not in self._touches:
            if number < self._step:
                self._restart()
            while self._step < number:
                self._go_on()
        return self._touches[number]

    def _number(self, seconds: float) -> int:
        """Of the step that lasts at this time."""
        if self.repeats is not None:
            seconds %= self.repeats
        return int(np.floor(seconds / self.touch.model.opt.timestep + 1e-6))

    def _restart(self) -> None:
        model, data = self.touch.model, self.touch.data
        if model.nkey and model.key_time[0] == 0:
            self._mujoco.mj_resetDataKeyframe(model, data, 0)
        else:
            self._mujoco.mj_resetData(model, data)
        self._mujoco.mj_forward(model, data)
        self._step = 0
        self._touches[0] = self.touch.touches()

    def _go_on(self) -> None:
        model, data = self.touch.model, self.touch.data
        if len(self._times):
            for actuator in range(model.nu):
                course = self._controls[:, actuator]
                data.ctrl[actuator] = np.interp(data.time, self._times, course)
        self._mujoco.mj_step(model, data)
        self._step += 1
        self._touches[self._step] = self.touch.touches()
        if self.repeats is None:
            self._touches.pop(self._step - round(KEPT_S / model.opt.timestep), None)


def _timeline(path: Path, model: MjModel) -> tuple[Array, Array]:
    """Times (K,) s and controls (K, actuators) of the keyframes; none where all are at time 0.

    ConfigError: they go back in time.
    """
    times = np.array(model.key_time)
    if np.any(np.diff(times) < 0):
        raise ConfigError(f"{path}: keyframes go back in time; sort them by their time")
    if not len(times) or times[-1] <= 0:
        return np.empty(0), np.empty((0, model.nu))
    return times, np.array(model.key_ctrl).reshape(len(times), model.nu)
