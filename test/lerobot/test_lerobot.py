# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A LeRobot data set of bags: every field against what was put in, without lerobot; and with it,
where a Python that has it is named."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from bag_maker import START_NS, frequencies_of, header, make_bag, message
from PIL import Image

from cube_tensor_driver.bags.metadata import make_typestore
from cube_tensor_driver.bags.read import Bag, Entry
from cube_tensor_driver.bags.reprocess.job import ReprocessJob, make_table, reprocess
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.cli.main import main
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.core.modes import COMPONENTS
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.lerobot.statistics import describe, summarise
from cube_tensor_driver.lerobot.windows import TACTILE, stream_windows
from cube_tensor_driver.messages.types import INFO_TYPE

SKIN = find_package_data() / "config" / "skin_demo.yaml"
FPS = 30
JOINTS, RAW, JPEG, MARKS = "/joint_states", "/camera/image_raw", "/camera/image/compressed", "/mark"
SIZE = (6, 8)


def pixels(k: int) -> np.ndarray:
    return (np.arange(6 * 8 * 3).reshape(6, 8, 3) + 7 * k).astype(np.uint8)


def jpeg(k: int) -> np.ndarray:
    file = io.BytesIO()
    Image.fromarray(pixels(k)).save(file, "JPEG")
    return np.frombuffer(file.getvalue(), np.uint8)


def joints(names: list[str], position: list[float], stamp_ns: int) -> object:
    return message(
        "sensor_msgs/msg/JointState",
        header=header(stamp_ns),
        name=names,
        position=np.array(position, float),
        velocity=np.array([]),
        effort=np.array([]),
    )


def image(k: int, stamp_ns: int) -> object:
    return message(
        "sensor_msgs/msg/Image",
        header=header(stamp_ns),
        height=SIZE[0],
        width=SIZE[1],
        encoding="bgr8",
        is_bigendian=0,
        step=3 * SIZE[1],
        data=pixels(k)[..., ::-1].ravel(),
    )


def compressed(k: int, stamp_ns: int) -> object:
    kind = "sensor_msgs/msg/CompressedImage"
    return message(kind, header=header(stamp_ns), format="jpeg", data=jpeg(k))


def polygon(stamp_ns: int) -> object:
    points = [message("geometry_msgs/msg/Point32", x=1.0, y=2.0, z=3.0)]
    shape = message("geometry_msgs/msg/Polygon", points=points)
    return message("geometry_msgs/msg/PolygonStamped", header=header(stamp_ns), polygon=shape)


def others() -> list[tuple[str, int, object]]:
    """Topic, when it was recorded, message: an arm at 50 Hz with a gripper on the same topic, a
    camera at 20 Hz from 0.2 s on, three marks, and a list of variable length."""
    found = [("/outline", START_NS, polygon(START_NS))]
    for k in range(150):
        at_ns = START_NS + 20_000_000 * k
        found.append((JOINTS, at_ns + 5000, joints(["a", "b"], [k, -k], at_ns)))
        if k % 5 == 1:
            found.append((JOINTS, at_ns + 6000, joints(["grip"], [0.5 * k], at_ns + 1)))
    for k in range(56):
        at_ns = START_NS + 200_000_000 + 50_000_000 * k
        found.append((RAW, at_ns + 7000, image(k, at_ns)))
        found.append((JPEG, at_ns + 8000, compressed(k, at_ns)))
    for seconds, task in ((0.5, "press"), (1.2, ""), (1.5, "slide")):
        at_ns = START_NS + round(seconds * 1e9)
        found.append((MARKS, at_ns, message("std_msgs/msg/String", data=task)))
    return found


def with_others(
    plain: Path,
    folder: Path,
    added: list[tuple[str, int, object]],
    change: Callable[[int, Entry], bytes] = lambda number, entry: entry.data,
) -> Path:
    """A copy of a bag with changed messages, and with more: topic, time of recording, message."""
    store = make_typestore()
    with Bag(plain) as bag:
        entries = list(bag.read_entries())
    entries = [(*one[:3], change(number, one)) for number, one in enumerate(entries)]
    for topic, time_ns, one in added:
        data = bytes(store.serialize_cdr(one, one.__msgtype__))
        entries.append((topic, one.__msgtype__, time_ns, data))
    with BagWriter(folder) as writer:
        for topic, kind in sorted({one[:2] for one in entries}):
            writer.add_topic(topic, kind)
        for topic, _, time_ns, data in sorted(entries, key=lambda one: one[2]):
            writer.write(topic, time_ns, data)
    return folder


def export(folder: Path, bags: list[Path], *options: str, fps: int = FPS) -> dict[str, np.ndarray]:
    """Every column of the data set of some bags, which is written to a folder."""
    command = ["export", "lerobot", *map(str, bags), "-o", str(folder), "--fps", str(fps)]
    assert main([*command, *options]) == 0
    assert not list(folder.parent.glob(".partial*"))
    return read_frames(folder)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A bag, the table of its stress by `reprocess`, and the folder of the data set made of it."""
    folder = tmp_path_factory.mktemp("lerobot")
    stuck = lambda k: np.where(np.arange(16) == 3, (1 << 2) * (k >= 80), 0)  # noqa: E731
    plain = make_bag(folder / "plain", SKIN, left_out=stuck)
    bag = with_others(plain, folder / "bag", others())
    reprocess(ReprocessJob(bag, folder / "bag.parquet", "parquet"))
    table = pyarrow.parquet.read_table(folder / "bag.parquet")
    export(folder / "set", [bag], "--task", "stroke the cat")
    return bag, table, folder / "set"


@pytest.fixture(scope="module")
def frames(made):
    return read_frames(made[2])


def read_frames(folder: Path) -> dict[str, np.ndarray]:
    """Every column of the data, as arrays of the shapes that info.json promises."""
    paths = sorted((folder / "data").rglob("*.parquet"))
    table = pyarrow.concat_tables(map(pyarrow.parquet.read_table, paths))
    features = json.loads((folder / "meta" / "info.json").read_text())["features"]
    assert table.column_names == list(features)
    found = {}
    for name, feature in features.items():
        values = table[name].combine_chunks()
        if feature["dtype"] == "image":
            found[name] = [one["bytes"] for one in values.to_pylist()]
            continue
        while hasattr(values, "flatten"):
            values = values.flatten()
        assert str(values.type) == {"float32": "float"}.get(feature["dtype"], feature["dtype"])
        found[name] = values.to_numpy().reshape(len(table), *feature["shape"])
    return found


def test_windows_hold_every_sample_once_with_the_bits_of_reprocess(made, frames):
    """100 samples per second in 30 frames: 3 or 4 in a window."""
    _, table, _ = made
    count = frames[f"{TACTILE}.count"]
    depth = frames[TACTILE].shape[1]
    assert frames[TACTILE].shape == (90, 4, 16, 15) and set(count.ravel()) == {3, 4}
    filled = np.arange(depth)[:, None] >= depth - count[:, None, :]  # (frames, depth, cubes)
    columns = table.column_names
    values = np.stack([table[name].to_numpy() for name in columns[3:18]], axis=1)
    for k in range(16):
        mine = table["cube"].to_numpy(zero_copy_only=False) == f"c{k:02}"
        inside = filled[:, :, k]
        np.testing.assert_array_equal(
            frames[TACTILE][:, :, k][inside].view(np.uint32), values[mine].view(np.uint32)
        )
        for name in ("stamp_ns", "sequence", "residual", "status", "observed", "left_out"):
            ours = frames[f"{TACTILE}.{name}"][:, :, k]
            np.testing.assert_array_equal(ours[inside], table[name].to_numpy()[mine], name)
            padding = ours[~inside]
            assert (np.isnan(padding) if name == "residual" else padding == 0).all()
        assert np.isnan(frames[TACTILE][:, :, k][~inside]).all()
    left_out = frames[f"{TACTILE}.left_out"]
    assert set(left_out[:, :, 3].ravel()) == {0, 4} and not left_out[:, :, 4].any()
    stamp_ns = frames[f"{TACTILE}.stamp_ns"] - START_NS
    frame = np.broadcast_to(frames["frame_index"][:, :, None], stamp_ns.shape)[filled]
    assert (stamp_ns[filled] * FPS // 10**9 == frame).all()


def test_other_topics_have_the_newest_before_the_end_of_each_frame(made, frames):
    state = frames["observation.state"]
    end = (np.arange(90) + 1) / FPS
    newest = np.ceil(end / 0.02 - 1e-9) - 1  # the arm moves every 20 ms
    np.testing.assert_array_equal(state[:, 0], newest)
    np.testing.assert_array_equal(state[:, 1], -newest)
    grip = 0.5 * (np.floor((newest - 1) / 5) * 5 + 1)
    np.testing.assert_array_equal(state[:, 2], np.where(newest >= 1, grip, np.nan))
    camera = np.ceil((end - 0.2) / 0.05 - 1e-9).astype(int) - 1
    for raw, packed, k in zip(
        frames["observation.images.camera.image_raw"],
        frames["observation.images.camera.image.compressed"],
        camera.tolist(),
        strict=True,
    ):
        shown = np.asarray(Image.open(io.BytesIO(raw)))
        np.testing.assert_array_equal(shown, pixels(k) if k >= 0 else 0 * pixels(0))
        assert (
            packed == jpeg(k).tobytes() if k >= 0 else not Image.open(io.BytesIO(packed)).getbbox()
        )
    np.testing.assert_array_equal(
        frames["observation.topics.force"][:, 2],
        (0.1 * np.sin(0.03 * (np.ceil(end / 0.01 - 1e-9) - 1))).astype(np.float32),
    )


def test_metadata_says_what_the_numbers_mean(made):
    folder = made[2]
    skin = read_skin(SKIN)
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == FPS
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (1, 90, 1)
    features = info["features"]
    assert features["observation.state"]["names"] == ["a.position", "b.position", "grip.position"]
    assert features["observation.images.camera.image_raw"]["shape"] == [6, 8, 3]
    assert not any("outline" in name for name in features)
    assert features["observation.topics.force"]["names"] == [
        f"wrench.{quantity}.{axis}" for quantity in ("force", "torque") for axis in "xyz"
    ]
    said = features[TACTILE]["info"]
    assert said["components"] == list(COMPONENTS) and said["units"] == ["Pa"] * 6 + ["Pa/m"] * 9
    assert [cube["name"] for cube in said["cubes"]] == list(skin.names)
    assert {"xyz", "rpy", "half_side"} <= set(said["cubes"][0])
    (calibrations,) = said["calibrations"]
    assert calibrations["ids"] == [one.id for one in skin.calibrations]
    tasks = pyarrow.parquet.read_table(folder / "meta" / "tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "stroke the cat"}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    (path,) = (folder / "meta" / "episodes").rglob("*.parquet")
    (episode,) = pyarrow.parquet.read_table(path).to_pylist()
    assert (episode["length"], episode["dataset_from_index"], episode["dataset_to_index"]) == (
        90,
        0,
        90,
    )
    assert episode["tasks"] == ["stroke the cat"] and episode["begin_ns"] == START_NS


def test_statistics_are_those_of_all_samples(made):
    _, table, folder = made
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    zz = table["stress_zz_Pa"].to_numpy().astype(float)
    at = COMPONENTS.index("zz")
    ours = {name: values[at] for name, values in stats[TACTILE].items() if name != "count"}
    assert ours["min"] == zz.min() and ours["max"] == zz.max()
    np.testing.assert_allclose([ours["mean"], ours["std"]], [zz.mean(), zz.std()], rtol=1e-9)
    assert ours["q50"] == np.median(zz)
    at = COMPONENTS.index("yz")  # planar cubes never observe it
    assert (stats[TACTILE]["mean"][at], stats[TACTILE]["std"][at]) == (0, 1)
    assert np.shape(stats["observation.images.camera.image_raw"]["mean"]) == (3, 1, 1)


def test_marks_divide_a_bag_into_episodes(made, tmp_path, capsys):
    bag, table, _ = made
    frames = export(tmp_path / "set", [bag, bag], "--marks", MARKS, "--topics", JOINTS)
    (path,) = (tmp_path / "set" / "meta" / "episodes").rglob("*.parquet")
    episodes = pyarrow.parquet.read_table(path).to_pylist()
    assert [one["tasks"] for one in episodes] == [["press"], ["slide"]] * 2
    assert [one["length"] for one in episodes] == [21, 45] * 2  # 0.7 s and 1.5 s
    assert [one["dataset_to_index"] for one in episodes] == [21, 66, 87, 132]
    assert [one["stats/index/min"] for one in episodes] == [[0], [21], [66], [87]]
    info = json.loads((tmp_path / "set" / "meta" / "info.json").read_text())
    assert len(info["features"][TACTILE]["info"]["calibrations"]) == 1
    assert [one["data/file_index"] for one in episodes] == [0, 0, 1, 1]  # a file for each bag
    np.testing.assert_array_equal(frames["index"][:, 0], np.arange(132))
    lengths = [21, 45, 21, 45]
    for name, numbers in (("task_index", [0, 1, 0, 1]), ("episode_index", range(4))):
        np.testing.assert_array_equal(frames[name][:, 0], np.repeat(numbers, lengths))
    stamp_ns = table["stamp_ns"].to_numpy() - START_NS
    pressed = (stamp_ns >= 500_000_000) & (stamp_ns < 1_200_000_000)
    assert frames[f"{TACTILE}.count"][:21].sum() == pressed.sum()
    assert list(frames)[8:-5] == ["observation.state"]
    number = np.concatenate([np.arange(length) for length in lengths])
    np.testing.assert_array_equal(frames["frame_index"][:, 0], number)
    seconds = (number / FPS).astype(np.float32)
    np.testing.assert_array_equal(frames["timestamp"][:, 0], seconds)
    written = int(frames[f"{TACTILE}.count"].sum())
    text = capsys.readouterr().out
    assert f"132 frames, {written} samples" in text
    assert f"left out: {2 * len(table) - written} samples outside of the marks" in text


def test_a_mark_ends_the_last_frame_of_its_episode(made, tmp_path):
    """0.7 s are 7.7 frames at 11 frames per second; the eighth has no sample after the mark."""
    bag, table, _ = made
    frames = export(tmp_path / "set", [bag], "--marks", MARKS, "--topics", fps=11)
    count = frames[f"{TACTILE}.count"]
    stamp_ns = table["stamp_ns"].to_numpy() - START_NS
    pressed = (stamp_ns >= 500_000_000) & (stamp_ns < 1_200_000_000)
    assert count[7].any() and count[:8].sum() == pressed.sum()


def test_a_topic_that_one_of_two_bags_lacks_is_unknown_there(made, tmp_path):
    bag, plain = made[0], made[0].with_name("plain")
    frames = export(tmp_path / "set", [plain, bag], "--topics", JOINTS, RAW)
    state = frames["observation.state"]
    assert state.shape == (180, 3)
    assert np.isnan(state[:90]).all() and np.isfinite(state[100:]).all()
    first, *_, last = frames["observation.images.camera.image_raw"]
    assert not Image.open(io.BytesIO(first)).getbbox() and Image.open(io.BytesIO(last)).getbbox()


def test_a_topic_of_two_types_is_refused_unless_it_is_left_out(made, tmp_path, capsys):
    bag, plain = made[0], made[0].with_name("plain")
    state = joints(["a"], [0.0], START_NS)
    other = with_others(plain, tmp_path / "other", [(RAW, START_NS, state)])
    command = ["export", "lerobot", str(bag), str(other), "-o", str(tmp_path / "out")]
    assert main([*command, "--fps", "30"]) == 1
    assert f"{RAW} is sensor_msgs/msg/JointState" in capsys.readouterr().err
    assert "observation.state" in export(tmp_path / "set", [bag, other], "--topics", JOINTS)


def test_windows_take_samples_in_any_order():
    """Late links, frames without samples, frames far ahead: as a loop would place them."""
    random = np.random.default_rng(5)
    cube = random.integers(0, 3, 4000).astype(np.uint16)
    frame = np.sort(random.integers(0, 400, 4000)) + random.integers(0, 40, 4000)
    frame -= frame.min()
    counts = np.zeros((frame.max() + 1, 3), np.uint32)
    np.add.at(counts, (frame, cube), 1)
    depth = int(counts.max())
    value = random.normal(size=(4000, 15))
    rows = StressRows.from_values(cube, value[:, :6], value[:, 6:], sequence=np.arange(4000))
    bounds = np.append(np.cumsum(random.integers(1, 60, 200)), 4000).clip(max=4000)
    given = [(frame[i:j], rows.select(slice(i, j))) for i, j in pairwise([0, *bounds])]
    blocks = [range(len(counts))[begin : begin + 7] for begin in range(0, len(counts), 7)]
    parts = list(stream_windows(given, blocks, counts, depth))
    placed = np.concatenate([part[TACTILE] for part in parts])
    expected = np.full((len(counts), depth, 3, 15), np.nan, np.float32)
    for f in range(len(counts)):
        for c in range(3):
            mine = value[(frame == f) & (cube == c)]
            expected[f, depth - len(mine) :, c] = mine
    np.testing.assert_array_equal(placed, expected)


def test_statistics_of_parts_are_those_of_the_whole():
    values = np.random.default_rng(2).normal(1e6, 3, (5000, 2))
    values[::7, 0] = np.nan
    every = np.ones(500, bool)
    result = summarise([describe(part, every) for part in np.split(values, 10)], 5000)
    np.testing.assert_allclose(result["mean"], np.nanmean(values, axis=0), rtol=1e-12)
    np.testing.assert_allclose(result["std"], np.nanstd(values, axis=0), rtol=1e-6)
    np.testing.assert_array_equal(result["q90"], np.nanquantile(values, 0.9, axis=0))


def test_an_image_of_grey_and_opacity_is_exported(made, tmp_path):
    """A frame before the first image is black in the same mode (pixel format)."""
    file = io.BytesIO()
    Image.new("LA", (4, 2), (200, 100)).save(file, "PNG")
    data = np.frombuffer(file.getvalue(), np.uint8)
    kind = "sensor_msgs/msg/CompressedImage"
    at_ns = START_NS + 10**9
    shown = message(kind, header=header(at_ns), format="png", data=data)
    bag = with_others(made[0].with_name("plain"), tmp_path / "bag", [(JPEG, at_ns, shown)])
    images = export(tmp_path / "set", [bag])["observation.images.camera.image.compressed"]
    first, last = (Image.open(io.BytesIO(images[k])) for k in (0, -1))
    assert first.mode == "LA" and not first.getbbox() and last.getpixel((0, 0)) == (200, 100)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--fps", "200"], ["--fps 200", "100 times per second", "at most 100"]),
        (["--fps", "30", "--marks", "/none"], ["no marks", "/none", MARKS]),
        (["--fps", "30", "--topics", "/nope"], ["/nope", JOINTS]),
        (["--fps", "30", "-o", "full"], ["full", "not empty", "another folder"]),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    made, tmp_path, monkeypatch, capsys, options, words
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    assert main(["export", "lerobot", str(made[0]), "-o", "out", *options]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and all(word in error for word in words), error
    assert {path.name for path in tmp_path.iterdir()} == {"full"}


def test_a_bag_without_frequencies_is_refused_in_one_line(tmp_path, capsys):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/info", INFO_TYPE)
    command = ["export", "lerobot", str(tmp_path / "bag"), "-o", str(tmp_path / "out")]
    assert main([*command, "--fps", "30"]) == 1
    assert "record frequencies and info" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_message_that_does_not_fit_the_skin_is_left_out(tmp_path):
    """The samples that were counted in it do not arrive; all others are written."""
    plain = make_bag(tmp_path / "plain", SKIN, 60)
    at_ns = START_NS + 200_000_001
    less = frequencies_of(99, at_ns, np.full((16, 7), 1e5))
    bag = with_others(plain, tmp_path / "bag", [("/frequencies", at_ns, less)])
    expected, found = (export(tmp_path / f"{path.name}_set", [path]) for path in (plain, bag))
    for name, values in expected.items():
        # The windows of the bag have room for what was counted. Each has at least 3 samples.
        newest = slice(-3, None) if values.ndim > 2 else slice(None)
        np.testing.assert_array_equal(found[name][:, newest], values[:, newest], name)


def test_a_clock_that_was_set_is_refused(tmp_path, capsys):

    def jump(number: int, entry: Entry) -> bytes:
        data = bytearray(entry.data)
        if entry.topic == "/frequencies" and number > 40:
            data[4:8] = (2_000_000_000).to_bytes(4, "little")
        return bytes(data)

    plain = make_bag(tmp_path / "bag", SKIN, 20)
    with_others(plain, tmp_path / "jumps", [], jump)
    command = ["export", "lerobot", str(tmp_path / "jumps"), "-o", str(tmp_path / "out")]
    assert main([*command, "--fps", "30"]) == 1
    assert "a clock was set" in capsys.readouterr().err


def test_without_zarr_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "zarr", None)
    with pytest.raises(ModuleNotFoundError) as missing:
        make_table(tmp_path / "x.zarr", ["c00"])
    assert missing.value.name == "zarr"  # which ./cube makes "pip install zarr" of


def test_a_zarr_group_holds_the_numbers_of_the_table(made, tmp_path):
    zarr = pytest.importorskip("zarr", reason="needs zarr: pip install zarr")
    bag, table, _ = made
    reprocess(ReprocessJob(bag, tmp_path / "bag.zarr", "zarr"))
    group = zarr.open_group(str(tmp_path / "bag.zarr"), mode="r")
    np.testing.assert_array_equal(group["stress"][:, 2], table["stress_zz_Pa"].to_numpy())
    np.testing.assert_array_equal(group["stamp_ns"][:], table["stamp_ns"].to_numpy())
    names = np.array(group["cube"].attrs["names"])[group["cube"][:]]
    np.testing.assert_array_equal(names, table["cube"].to_numpy(zero_copy_only=False))
    assert group["gradient"].attrs["units"] == "Pa/m"


READ = """
import json, sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("local/set", root=sys.argv[1])
near = LeRobotDataset(
    "local/set", root=sys.argv[1], delta_timestamps={"observation.tactile": [-1 / data.fps, 0.0]}
)
frames = [data[k] for k in range(len(data))]
np.savez(
    sys.argv[2],
    near=near[40]["observation.tactile"].numpy(),
    **{key: np.stack([one[key].numpy() for one in frames]) for key in frames[0] if key != "task"},
)
print(json.dumps([len(data), data.num_episodes, frames[0]["task"]]))
"""


@pytest.mark.skipif(
    "LEROBOT_PYTHON" not in os.environ,
    reason="needs LEROBOT_PYTHON, the Python of an environment with lerobot==0.4.4",
)
def test_the_official_reader_gives_the_same_frames(made, frames, tmp_path):
    folder = shutil.copytree(made[2], tmp_path / "set")
    done = subprocess.run(
        [os.environ["LEROBOT_PYTHON"], "-c", READ, folder, tmp_path / "read.npz"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PATH": os.environ["PATH"], "HOME": str(tmp_path), "HF_HUB_OFFLINE": "1"},
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == [90, 1, "stroke the cat"]
    read = np.load(tmp_path / "read.npz")
    for name, values in frames.items():
        if isinstance(values, list):
            shown = np.stack([np.asarray(Image.open(io.BytesIO(one))) for one in values])
            values = shown.transpose(0, 3, 1, 2).astype(np.float32) / np.float32(255)
        np.testing.assert_array_equal(read[name].reshape(values.shape), values, name)
    np.testing.assert_array_equal(read["near"], frames[TACTILE][[39, 40]])
