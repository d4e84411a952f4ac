# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Record a simulated skin with the official `record_loop` of lerobot; argument: a folder with
skin.yaml. Prints the times at which frames were read, and the numbers read and found again."""

import json
import sys
import time
from pathlib import Path

import draccus
import numpy as np
from lerobot.cameras import Camera, CameraConfig
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import hw_to_dataset_features
from lerobot.processor import make_default_processors
from lerobot.scripts.lerobot_record import record_loop
from lerobot.teleoperators import Teleoperator
from lerobot.utils.import_utils import register_third_party_plugins

from cube_tensor_driver.lerobot.live import read_frame_number

FPS = 30
folder = Path(sys.argv[1])


class Teleop(Teleoperator):
    name, config_class = "still", None
    action_features = feedback_features = property(lambda self: {"a.pos": float})
    is_connected = is_calibrated = True

    def __init__(self):
        pass

    def connect(self, calibrate=True): ...
    def calibrate(self): ...
    def configure(self): ...
    def disconnect(self): ...
    def send_feedback(self, feedback): ...
    def get_action(self):
        return {"a.pos": 0.0}


class Robot:
    """Reads its cameras as the robots of lerobot do."""

    name = "still"
    robot_type = "still"

    def __init__(self, cameras):
        self.cameras = cameras
        self.read_ns, self.numbers = [], []

    def get_observation(self):
        if len(self.numbers) == 20:
            # A recorder that pauses for 200 ms, once, is what this program tests.
            time.sleep(0.2)
        self.read_ns.append(time.time_ns())
        picture = self.cameras["skin"].read_latest()
        self.numbers.append(read_frame_number(picture))
        return {"a.pos": 0.0, "skin": picture, "front": np.zeros((240, 320, 3), np.uint8)}

    def send_action(self, action):
        return action


register_third_party_plugins()
options = {"type": "cube", "skin": str(folder / "skin.yaml"), "folder": str(folder / "touch")}
config = draccus.decode(CameraConfig, options)
cameras = make_cameras_from_configs({"skin": config})
robot = Robot(cameras)
camera = cameras["skin"]
assert isinstance(camera, Camera) and not camera.is_connected
shape = (camera.height, camera.width, 3)
observed = {"a.pos": float, "skin": shape, "front": shape}
features = hw_to_dataset_features(observed, "observation", False) | hw_to_dataset_features(
    {"a.pos": float}, "action"
)
data = LeRobotDataset.create(
    "local/live", FPS, features, root=folder / "set", use_videos=False, image_writer_threads=2
)
teleop_processor, action_processor, observation_processor = make_default_processors()
with camera:
    assert camera.is_connected
    record_loop(
        robot=robot,
        events={"exit_early": False},
        fps=FPS,
        teleop_action_processor=teleop_processor,
        robot_action_processor=action_processor,
        robot_observation_processor=observation_processor,
        dataset=data,
        teleop=Teleop(),
        control_time_s=3,
        single_task="touch",
    )
data.save_episode()
data.finalize()
read = LeRobotDataset("local/live", root=folder / "set")
found = [read_frame_number(read[k]["observation.images.skin"]) for k in range(len(read))]
print(json.dumps({"read_ns": robot.read_ns, "numbers given": robot.numbers, "numbers": found}))
