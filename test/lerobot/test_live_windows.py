# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Live touch beside a LeRobot data set: simulated hubs, read while a recorder takes frames; without
lerobot, and through the official recorder where a Python that has it is named."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from bag_maker import make_bag

import cube_tensor_driver as ctd
from conftest import ROOT
from cube_tensor_driver.bags.tables import as_array
from cube_tensor_driver.cli.main import main
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Skin, read_skin
from cube_tensor_driver.core.rows import FrequencyRows, StressRows, concatenate
from cube_tensor_driver.lerobot import live as live_module
from cube_tensor_driver.lerobot.live import LiveWindows, RecordedWindows, read_frame_number
from cube_tensor_driver.lerobot.windows import TACTILE, WINDOW_COLUMNS
from cube_tensor_driver.simulation.background import BackgroundHubs

RATE = 250
SIZE = {"width": 320, "height": 240, "full_scale": 20e3}
MAX_DELAY_NS = 5_000_000


class HeldSource:
    """A live source that yields what the test puts in: the rows of each `give` at once."""

    is_live = True

    def __init__(self, skin: Skin) -> None:
        self.skin = skin
        self._given: list[FrequencyRows] = []
        self._changed = threading.Condition()
        self._closed = False

    def give(self, rows: FrequencyRows) -> None:
        """Put rows in and wait until the consumer comes back for more."""
        with self._changed:
            self._given.append(rows)
            self._changed.notify_all()
            assert self._changed.wait_for(lambda: not self._given, 10)

    def statistics(self) -> dict[str, object]:
        return {}

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __iter__(self):
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._given or self._closed)
                if not self._given:
                    return
                rows = self._given[0]
            yield rows
            with self._changed:
                self._given.pop(0)
                self._changed.notify_all()

    def __enter__(self):
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def test_windows_hold_the_bits_of_the_stress_and_a_pause_lengthens_one(tmp_path):
    """Frames of 1, 2, 60 (a pause) and 3 scans, against one reconstruction of all rows."""
    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    cubes = len(skin.cubes)
    with ctd.simulate(skin, duration=0.3, rate=RATE) as simulated:
        rows = concatenate(list(simulated))
    source = HeldSource(skin)
    live = LiveWindows(source, tmp_path / "touch", **SIZE)
    scans, pictures, first = [1, 2, 60, 3], [], 0
    for number in scans:
        source.give(rows.select(slice(first * cubes, (first + number) * cubes)))
        pictures.append(live.take_next_picture(10.0))
        first += number
    with pytest.raises(TimeoutError, match="no sample in 0"):
        live.take_next_picture(0.0)
    live.close()

    expected = ctd.Reconstructor(skin)(rows.select(slice(0, first * cubes)))
    recorded = RecordedWindows(tmp_path / "touch")
    windows = [recorded.of(picture) for picture in pictures]
    assert [len(window[TACTILE]) for window in windows] == scans
    assert len(recorded) == len(scans)
    for name in ("stamp_ns", "sequence", "residual", "status", "observed", "left_out"):
        joined = np.concatenate([window[f"{TACTILE}.{name}"] for window in windows])
        assert joined.dtype == WINDOW_COLUMNS[name]
        values = getattr(expected, name).astype(joined.dtype)
        np.testing.assert_array_equal(joined.ravel(), values, name)
    joined = np.concatenate([window[TACTILE] for window in windows])
    both = np.hstack([expected.stress, expected.gradient]).astype(np.float32)
    np.testing.assert_array_equal(joined.reshape(-1, 15), both)
    for window, number in zip(windows, scans, strict=True):
        np.testing.assert_array_equal(window[f"{TACTILE}.count"], [number] * cubes)
    # The same from a picture as LeRobot returns it.
    shown = pictures[2].transpose(2, 0, 1) / np.float32(255)
    assert read_frame_number(shown) == read_frame_number(pictures[2])
    assert_picture_shows(pictures[-1], expected.select(slice(-cubes, None)))


def test_live_windows_have_the_bits_of_the_export_of_the_same_run(tmp_path):
    """The samples of all frames, one after the other; both divide them into other frames."""
    path = find_package_data() / "config" / "skin_demo.yaml"
    bag = make_bag(tmp_path / "bag", path, 60)
    with ctd.open_bag(bag) as recorded:
        rows = concatenate(list(recorded))
    source = HeldSource(read_skin(path))
    live = LiveWindows(source, tmp_path / "touch", **SIZE)
    cubes = len(source.skin.cubes)
    windows = []
    for begin, end in pairwise((0, 5, 30, 60)):
        source.give(rows.select(slice(begin * cubes, end * cubes)))
        picture = live.take_next_picture(10.0)
        windows.append(read_frame_number(picture))
    live.close()
    touch = RecordedWindows(tmp_path / "touch")

    assert main(["export", "lerobot", str(bag), "-o", str(tmp_path / "set"), "--fps", "30"]) == 0
    table = pyarrow.parquet.read_table(tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet")
    count = as_array(table[f"{TACTILE}.count"].combine_chunks())
    depth = as_array(table[TACTILE].combine_chunks()).shape[1]
    # A window has its samples at its end, as many of each cube.
    is_sample = np.arange(depth) >= depth - count[:, :1]
    for name in touch.at(windows[0]).keys() - {f"{TACTILE}.count"}:
        exported = as_array(table[name].combine_chunks())[is_sample]
        joined = np.concatenate([touch.at(number)[name] for number in windows])
        assert joined.dtype == exported.dtype and len(joined) == 60
        np.testing.assert_array_equal(joined, exported, name)


def test_a_frame_has_what_arrived_while_the_recorder_computed(tmp_path, monkeypatch):
    """No other thread runs between the arrival of a scan and the reading of the frame."""
    monkeypatch.setattr(live_module, "CATCH_UP_S", 0.3)
    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    cubes = len(skin.cubes)
    with ctd.simulate(skin, duration=0.02, rate=RATE) as simulated:
        rows = concatenate(list(simulated))
    source = HeldSource(skin)
    live = LiveWindows(source, tmp_path / "touch", **SIZE)
    source.give(rows.select(slice(0, cubes)))
    arrival = threading.Lock()
    arrival.acquire()

    def receive() -> None:
        arrival.acquire()
        source.give(rows.select(slice(cubes, 2 * cubes)))

    thread = threading.Thread(target=receive)
    thread.start()
    interval = sys.getswitchinterval()
    sys.setswitchinterval(100)
    try:
        arrival.release()
        picture = live.take_next_picture(10.0)
    finally:
        sys.setswitchinterval(interval)
    thread.join(10)
    live.close()
    window = RecordedWindows(tmp_path / "touch").of(picture)
    np.testing.assert_array_equal(window[f"{TACTILE}.count"], [2] * cubes)


def test_a_frame_waits_for_samples_that_are_older_than_5_ms_only(tmp_path, monkeypatch):
    """The newest sample is 50 ms old, so the one that arrives 0.1 s later is waited for; a sample
    of now is not waited for."""
    monkeypatch.setattr(live_module, "CATCH_UP_S", 10.0)
    skin = read_skin(find_package_data() / "config" / "skin_demo.yaml")
    cubes = len(skin.cubes)
    source = HeldSource(skin)
    live = LiveWindows(source, tmp_path / "touch", **SIZE)

    def give(age_ns: int) -> None:
        rest = [cube.calibration.rest_frequency for cube in skin.cubes]
        rows = FrequencyRows.of(range(cubes), rest, stamp_ns=time.time_ns() - age_ns)
        source.give(rows)

    give(50_000_000)
    thread = threading.Timer(0.1, give, [-10_000_000_000])
    thread.start()
    pictures = [live.take_next_picture(20.0)]
    thread.join()
    give(-10_000_000_000)
    begin = time.monotonic()
    pictures.append(live.take_next_picture(20.0))
    assert time.monotonic() - begin < 9
    live.close()
    recorded = RecordedWindows(tmp_path / "touch")
    assert [len(recorded.of(picture)[TACTILE]) for picture in pictures] == [2, 1]


def assert_picture_shows(picture: np.ndarray, last: StressRows) -> None:
    """The set of colours below the number is that of the last stress, at 20 kPa full scale."""
    pressure = -last.stress[:, 2]
    red = (255 * np.clip(pressure / 20e3, 0, 1)).astype(np.uint8)
    blue = (255 * np.clip(-pressure / 20e3, 0, 1)).astype(np.uint8)
    colours = {(int(r), 0, int(b)) for r, b in zip(red, blue, strict=True)}
    shown = picture[16:].reshape(-1, 3)
    assert {tuple(map(int, colour)) for colour in np.unique(shown, axis=0)} == colours


@pytest.mark.parametrize(
    "wrong", [{"width": 191}, {"height": 31}, {"full_scale": 0.0}, {"full_scale": float("nan")}]
)
def test_impossible_pictures_are_refused(tmp_path, wrong):
    source = HeldSource(read_skin(find_package_data() / "config" / "skin_demo.yaml"))
    with pytest.raises(ctd.CubeError, match=str(next(iter(wrong.values())))):
        LiveWindows(source, tmp_path, **(SIZE | wrong))
    with pytest.raises(ctd.CubeError, match="no recordings"):
        RecordedWindows(tmp_path)


@pytest.mark.skipif(
    "LEROBOT_PYTHON" not in os.environ,
    reason="needs LEROBOT_PYTHON, the Python of an environment with lerobot==0.4.4",
)
def test_the_official_recorder_finds_the_camera_and_loses_no_sample(tmp_path):
    """3 s at 30 frames per second as PNG, beside a second camera; it stalls once."""
    python = os.environ["LEROBOT_PYTHON"]
    needed = "import cube_tensor_driver.device.live, cube_tensor_driver.config.skin, pyarrow"
    environment = {"PATH": os.environ["PATH"], "HOME": str(tmp_path), "HF_HUB_OFFLINE": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path / "site"), str(ROOT)])
    found = subprocess.run([python, "-c", needed], env=environment, cwd=tmp_path, check=False)
    if found.returncode:
        pytest.skip("needs jsonschema and transforms3d beside lerobot in LEROBOT_PYTHON")
    install_plugin(python, tmp_path)
    # The recorder imports the viewer rerun, which is large and not used here.
    (tmp_path / "site" / "rerun.py").touch()
    skin_file = tmp_path / "skin.yaml"
    port = str(tmp_path / "ports" / "hub{}")
    grid = ["config", "grid", "--nx", "4", "--ny", "2", "--links", "2", "--rate", str(RATE)]
    assert main([*grid, "--port", port, "-o", str(skin_file)]) == 0
    with BackgroundHubs(read_skin(skin_file), tmp_path / "ports"):
        done = subprocess.run(
            [python, Path(__file__).with_name("record_with_lerobot.py"), tmp_path],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
            timeout=200,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout.splitlines()[-1])
    read_ns, numbers = np.array(said["read_ns"]), said["numbers"]
    # The recorder's own frames, in their order, each with its number legible in the data set.
    assert numbers == said["numbers given"] and len(numbers) > 30

    recorded = RecordedWindows(tmp_path / "touch")
    windows = [recorded.at(number) for number in numbers]
    sequence = [[] for _ in range(8)]
    late_ns = []
    for k, window in enumerate(windows):
        stamps = window[f"{TACTILE}.stamp_ns"]
        for cube, count in enumerate(window[f"{TACTILE}.count"]):
            sequence[cube] += list(window[f"{TACTILE}.sequence"][-count:, cube]) if count else []
            if k and count:
                late_ns.append((k, read_ns[k - 1] - stamps[-count, cube]))
    for numbers_of_cube in sequence:
        np.testing.assert_array_equal(np.diff(numbers_of_cube), 1)
    depth = np.array([len(window[TACTILE]) for window in windows])
    # 200 ms are 50 samples, which only the frame after the stall must have, and 1/30 s 8 or 9.
    assert depth[20] >= 50 and np.median(depth) < 20
    # A sample is late by the time from its stamp to the reading of a frame that lacks it.
    # The recorder, its writers of images and the hubs share the processors of the test, so a few
    # frames may be late; no sample is lost by that.
    late = {k: round(1e-6 * delay, 1) for k, delay in late_ns if delay > MAX_DELAY_NS}
    print(f"{len(late)} of {len(windows)} frames are late, in ms: {late}")
    assert len(late) <= 0.1 * len(windows)


def install_plugin(python: str, folder: Path) -> None:
    """Install the distribution as pip does, below folder/site."""
    source = shutil.copytree(ROOT / "lerobot_camera_cube", folder / "source")
    command = [python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--disable-pip-version-check", "--target"]
    subprocess.run([*command, folder / "site", source], check=True)
