# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Live touch beside a LeRobot data set: simulated hubs, read while a recorder takes frames; without
lerobot, and through the official recorder where a Python that has it is named."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from queue import Queue

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
from cube_tensor_driver.core.rows import FrequencyRows, concatenate
from cube_tensor_driver.lerobot import live as live_module
from cube_tensor_driver.lerobot.live import LiveWindows, RecordedWindows, read_frame_number
from cube_tensor_driver.lerobot.windows import TACTILE, WINDOW_COLUMNS
from cube_tensor_driver.simulation.background import BackgroundHubs

RATE = 250
SIZE = {"width": 320, "height": 240, "full_scale": 20e3}
SKIN = find_package_data() / "config" / "skin_demo.yaml"
BEGIN_NS = 1_700_000_000_000_000_000
PERIOD_NS = 4_000_000


class HeldSource:
    """A live source that yields what the test puts in: the rows of each `give` at once."""

    def __init__(self, skin: Skin) -> None:
        self.skin = skin
        self._given: Queue[FrequencyRows | None] = Queue()

    def give(self, rows: FrequencyRows) -> None:
        """Put rows in and wait until the consumer comes back for more."""
        self._given.put(rows)
        self._given.join()

    def close(self) -> None:
        self._given.put(None)

    def __iter__(self):
        while (rows := self._given.get()) is not None:
            yield rows
            self._given.task_done()


def record(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    rows: FrequencyRows,
    last_scans: list[int],
    late: int = 0,
) -> list[np.ndarray]:
    """Return the pictures of frames that are read 1 ms after the last of their scans.

    The last `late` scans of each frame arrive only after the frame has been read.
    """
    source = HeldSource(read_skin(SKIN))
    cubes = len(source.skin.cubes)
    live = LiveWindows(source, folder, **SIZE)
    pictures, given = [], 0
    for last in last_scans:
        clock_ns = int(rows.stamp_ns[last * cubes]) + 1_000_000
        monkeypatch.setattr(live_module.time, "time_ns", lambda now=clock_ns: now)
        arrived = (last + 1 - late) * cubes
        source.give(rows.select(slice(given, arrived)))
        pictures.append(live.take_next_picture(10.0))
        given = arrived
    source.give(rows.select(slice(given, len(rows))))
    live.close()
    return pictures


@pytest.mark.parametrize("late", [0, 1])
def test_windows_hold_the_bits_of_the_stress_and_a_pause_lengthens_one(tmp_path, monkeypatch, late):
    """Frames of 2, 2, 60 (a pause) and 3 scans, against one reconstruction of all rows. Scans that
    arrive after the frame was read are in its window; those after the last frame in none."""
    skin = read_skin(SKIN)
    cubes = len(skin.cubes)
    with ctd.simulate(skin, duration=0.3, rate=RATE) as simulated:
        rows = concatenate(list(simulated)).select(slice(0, 70 * cubes))
    rows = replace(rows, stamp_ns=BEGIN_NS + np.repeat(PERIOD_NS * np.arange(70), cubes))
    pictures = record(tmp_path, monkeypatch, rows, [1, 3, 63, 66], late)

    expected = ctd.Reconstructor(skin)(rows).select(slice(0, 67 * cubes))
    recorded = RecordedWindows(tmp_path)
    windows = [recorded.find(picture) for picture in pictures]
    assert [len(window[TACTILE]) for window in windows] == [2, 2, 60, 3]
    for name in WINDOW_COLUMNS:
        joined = np.concatenate([window[f"{TACTILE}.{name}"] for window in windows])
        assert joined.dtype == WINDOW_COLUMNS[name]
        values = getattr(expected, name).astype(joined.dtype)
        np.testing.assert_array_equal(joined.ravel(), values, name)
    joined = np.concatenate([window[TACTILE] for window in windows])
    np.testing.assert_array_equal(joined.reshape(-1, 15), expected.components.astype(np.float32))
    for window, number in zip(windows, [2, 2, 60, 3], strict=True):
        np.testing.assert_array_equal(window[f"{TACTILE}.count"], [number] * cubes)
    # The same from a picture as LeRobot returns it.
    shown = pictures[2].transpose(2, 0, 1) / np.float32(255)
    assert read_frame_number(shown) == read_frame_number(pictures[2])
    # Below the number, the picture has the colours of the last stress that had arrived.
    pressure = -expected.stress[(66 - late) * cubes : (67 - late) * cubes, 2] / 20e3
    colours = 255 * np.clip(np.outer(pressure, [1, 0, -1]), 0, 1)
    colours = np.unique(colours.astype(np.uint8), axis=0)
    shown = np.unique(pictures[3][16:].reshape(-1, 3), axis=0)
    np.testing.assert_array_equal(shown, colours)


def test_live_windows_have_the_bits_of_the_export_of_the_same_run(tmp_path, monkeypatch):
    """The samples of all frames, one after the other; both divide them into other frames."""
    bag = make_bag(tmp_path / "bag", SKIN, 60)
    with ctd.open_bag(bag) as recorded:
        rows = concatenate(list(recorded))
    pictures = record(tmp_path / "touch", monkeypatch, rows, [4, 29, 59])
    touch = RecordedWindows(tmp_path / "touch")
    windows = [touch.find(picture) for picture in pictures]

    assert main(["export", "lerobot", str(bag), "-o", str(tmp_path / "set"), "--fps", "30"]) == 0
    table = pyarrow.parquet.read_table(tmp_path / "set" / "data" / "chunk-000" / "file-000.parquet")
    count = as_array(table[f"{TACTILE}.count"].combine_chunks())
    depth = as_array(table[TACTILE].combine_chunks()).shape[1]
    # A window has its samples at its end, as many of each cube.
    is_sample = np.arange(depth) >= depth - count[:, :1]
    for name in windows[0].keys() - {f"{TACTILE}.count"}:
        exported = as_array(table[name].combine_chunks())[is_sample]
        joined = np.concatenate([window[name] for window in windows])
        assert joined.dtype == exported.dtype and len(joined) == 60
        np.testing.assert_array_equal(joined, exported, name)


@pytest.mark.parametrize(
    ("clocks", "stamps", "expected"),
    [
        # All samples before the second frame are stamped before the first one.
        ([0, 1], [-1, -1], [[0, 1], []]),
        # After the clock was set back, stamps do not tell the frame: it has what arrived.
        ([0, 1, -1000, -999, -998], [0, 1, -1000, -999, -998], [[0], [1], [2], [3], [4]]),
    ],
)
def test_windows_of_odd_stamps(tmp_path, monkeypatch, clocks, stamps, expected):
    """Clocks at frames and stamps of the scans before them, in periods; numbers of the scans."""
    skin = read_skin(SKIN)
    cubes = range(len(skin.cubes))
    rest = [cube.calibration.rest_frequency for cube in skin.cubes]
    source = HeldSource(skin)
    live = LiveWindows(source, tmp_path, **SIZE)
    pictures = []
    for number, (clock, stamp) in enumerate(zip(clocks, stamps, strict=True)):
        now_ns, stamp_ns = BEGIN_NS + PERIOD_NS * np.array([clock, stamp])
        monkeypatch.setattr(live_module.time, "time_ns", lambda now=int(now_ns): now)
        source.give(FrequencyRows.from_values(cubes, rest, stamp_ns=stamp_ns, sequence=number))
        pictures.append(live.take_next_picture(10.0))
    with pytest.raises(TimeoutError, match="no sample in 0"):
        live.take_next_picture(0.0)
    live.close()
    windows = [RecordedWindows(tmp_path).find(picture) for picture in pictures]
    for window, numbers in zip(windows, expected, strict=True):
        assert set(window[f"{TACTILE}.count"]) == {len(numbers)}
        assert window[f"{TACTILE}.sequence"][:, 0].tolist() == (numbers or [0])
        assert np.isnan(window[TACTILE][:, 0, 0]).all() == (not numbers)


def test_an_error_of_the_links_is_raised(tmp_path):
    class BrokenSource(HeldSource):
        def __iter__(self):
            raise ctd.CubeError("the cable is cut")

    live = LiveWindows(BrokenSource(read_skin(SKIN)), tmp_path, **SIZE)
    with pytest.raises(ctd.CubeError, match="cable"):
        live.take_next_picture(0.1)
    live.close()


@pytest.mark.parametrize(
    "wrong", [{"width": 191}, {"height": 31}, {"full_scale": 0.0}, {"full_scale": float("nan")}]
)
def test_impossible_pictures_are_refused(tmp_path, wrong):
    source = HeldSource(read_skin(SKIN))
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
    windows = [recorded.find_frame(number) for number in numbers]
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
    # A sample is late by the time from its stamp to the reading of a frame that lacks it. Frame
    # numbers are whole ms.
    late = {k: round(1e-6 * delay, 1) for k, delay in late_ns if delay >= 1_000_000}
    assert not late, f"{len(late)} of {len(windows)} frames are late, in ms: {late}"


def install_plugin(python: str, folder: Path) -> None:
    """Install the distribution as pip does, below folder/site."""
    source = shutil.copytree(ROOT / "lerobot_camera_cube", folder / "source")
    command = [python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--disable-pip-version-check", "--target"]
    subprocess.run([*command, folder / "site", source], check=True)
