# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Bags as files: written, read, cut off and repaired, damaged, made into stress again. Needs no
ROS."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import struct
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import mcap.writer
import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs pyarrow: pip install pyarrow")
pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

import pyarrow.csv
import pyarrow.parquet
from bag_maker import START_NS, WRENCH, frequencies_of, header, info_of, loads, make_bag, message
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from conftest import ROOT
from cube_tensor_driver.bags import summary
from cube_tensor_driver.bags.mcap_file import RECORD_HEAD
from cube_tensor_driver.bags.metadata import make_typestore
from cube_tensor_driver.bags.read import Bag, report_damage
from cube_tensor_driver.bags.repair import repair
from cube_tensor_driver.bags.reprocess import job as job_module
from cube_tensor_driver.bags.reprocess.job import (
    Overrides,
    ReprocessJob,
    choose_settings,
    reconstruct,
    reprocess,
)
from cube_tensor_driver.bags.source import open_bag
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.cli.main import main
from cube_tensor_driver.config.calibration import read_calibration, write_calibration
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import parse_yaml, read_yaml, write_yaml
from cube_tensor_driver.core.errors import BagError
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.core.status import PAD_FAULT, STAMP, STUCK
from cube_tensor_driver.messages.types import FREQUENCIES_TYPE, INFO_TYPE, STRESS_TYPE

SKIN = find_package_data() / "config" / "skin_demo.yaml"
KEPT = ROOT / "test" / "data" / "bag"
"""A recording of hubs on a noisy line, made while their clock was set."""


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return make_bag(tmp_path_factory.mktemp("made") / "bag", SKIN)


@pytest.fixture
def copy(bag, tmp_path):
    return Path(shutil.copytree(bag, tmp_path / "bag"))


def stress(path: Path) -> dict[int, StressRows]:
    """The rows of each message by its stamp."""
    by_stamp = {}
    with Bag(path) as bag:
        for messages, _ in bag.read_stress("/stress"):
            n = len(messages.rows) // len(messages)
            for k, stamp_ns in enumerate(messages.stamp_ns.tolist()):
                by_stamp[stamp_ns] = messages.rows.select(slice(k * n, (k + 1) * n))
    return by_stamp


def differing_bits(one: StressRows, other: StressRows) -> int:
    """Between rows of the same cubes."""
    count = 0
    for field in dataclasses.fields(one):
        a, b = (
            np.ascontiguousarray(getattr(rows, field.name)).view(np.uint8) for rows in (one, other)
        )
        count += int(np.unpackbits(a ^ b).sum())
    return count


def all_differing_bits(one: dict[int, StressRows], other: dict[int, StressRows]) -> int:
    """Between messages by their stamps."""
    assert one.keys() == other.keys()
    return sum(differing_bits(rows, other[stamp]) for stamp, rows in one.items())


@pytest.mark.parametrize(
    "options", [{}, {"storage": "sqlite3"}, {"max_seconds": 1.0}, {"max_bytes": 400_000}]
)
def test_a_written_bag_is_read_by_rosbags(tmp_path, options):
    path = make_bag(tmp_path / "bag", SKIN, **options)
    with AnyReader([path]) as reader:  # with the definitions in the bag alone
        counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        assert counts == {"/frequencies": 300, "/stress": 300, "/force": 300, "/info": 1}
        connection = next(one for one in reader.connections if one.topic == "/frequencies")
        times = []
        for _, time_ns, data in reader.messages([connection]):
            times.append(time_ns)
            assert reader.deserialize(data, connection.msgtype).n_pads == 8
    assert times == [START_NS + 10_000_000 * k + 1000 for k in range(300)]
    if "max_seconds" in options:
        assert len(list(path.glob("*.mcap"))) == 3


@pytest.mark.parametrize("options", [{}, {"storage": "sqlite3"}, {"max_bytes": 400_000}])
def test_a_written_bag_is_read_by_rosbag2(tmp_path, options):
    """Byte for byte, in our order; types, hashes, definitions and latched info too."""
    rosbag2 = pytest.importorskip("rosbag2_py", reason="needs rosbag2, which the wheels lack")
    path = make_bag(tmp_path / "bag", SKIN, **options)
    reader = rosbag2.SequentialReader()
    uri, storage = str(path), options.get("storage", "mcap")
    reader.open(
        rosbag2.StorageOptions(uri=uri, storage_id=storage), rosbag2.ConverterOptions("", "")
    )
    messages = []
    while reader.has_next():
        messages.append(reader.read_next())
    metadata = rosbag2.Info().read_metadata(uri, storage)
    topics = {
        one.name: (one.type, one.type_description_hash) for one in reader.get_all_topics_and_types()
    }
    assert {one.topic_type for one in reader.get_all_message_definitions()} >= {
        FREQUENCIES_TYPE,
        STRESS_TYPE,
        INFO_TYPE,
    }
    with Bag(path) as bag:
        assert messages == [
            (entry.topic, entry.data, entry.time_ns) for entry in bag.read_entries()
        ]
        assert topics == {
            one.topic: (one.msgtype, make_typestore().hash_rihs01(one.msgtype))
            for one in bag.connections
        }
        assert (metadata.starting_time.nanoseconds, metadata.message_count) == (
            bag.start_ns,
            len(messages),
        )


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_threads_take_turns(tmp_path, storage):
    """As in a recording: topics come from one thread, messages from another; with a second storage
    file."""
    written = [(("/a", "/b")[number % 2], 1000 + number) for number in range(6)]
    with (
        BagWriter(tmp_path / "bag", storage, max_bytes=8) as writer,
        ThreadPoolExecutor(1) as thread,
    ):
        writer.add_topic("/a", WRENCH)
        for topic, time_ns in written:
            if time_ns == 1001:
                writer.add_topic("/b", WRENCH)
            thread.submit(writer.write, topic, time_ns, bytes(4)).result()
            thread.submit(writer.flush).result()
    with Reader(tmp_path / "bag") as reader:
        assert [
            (connection.topic, time_ns) for connection, time_ns, _ in reader.messages()
        ] == written


def test_a_job_that_ends_leaves_what_another_one_is_about_to_write(bag, tmp_path, monkeypatch):
    """The first job ends before the second one, in another process, creates its output."""
    write = job_module._reprocess

    def write_after_another(opened, job, output):
        monkeypatch.setattr(job_module, "_reprocess", write)
        reprocess(ReprocessJob(bag, tmp_path / "first.parquet", "parquet"))
        return write(opened, job, output)

    monkeypatch.setattr(job_module, "_reprocess", write_after_another)
    reprocess(ReprocessJob(bag, tmp_path / "second.parquet", "parquet"))
    assert {path.name for path in tmp_path.iterdir()} == {"first.parquet", "second.parquet"}


def test_messages_come_in_the_order_in_which_rosbags_reads_them(tmp_path):
    """Also where chunks overlap in time, times are equal, or only a part is wanted."""
    rng = np.random.default_rng(5)
    with BagWriter(tmp_path / "bag") as writer:
        for topic in ("/a", "/b"):
            writer.add_topic(topic, WRENCH)
        for number in range(40):
            writer.write(("/a", "/b")[number % 2], 1000 + 10 * number, bytes([number]))
            late = rng.integers(0, 9, 20) if number % 8 == 0 else np.arange(3)
            for time_ns in (1000 + 10 * (number - late)).tolist():
                writer.write("/a", time_ns, rng.bytes(5))
            if number % 3 == 0:
                writer.flush()

    def by_rosbags(topics: str, **span: int) -> list[tuple[str, int, bytes]]:
        with Reader(tmp_path / "bag") as reader:
            wanted = [one for one in reader.connections if one.topic[1] in topics]
            return [
                (one.topic, time_ns, bytes(data))
                for one, time_ns, data in reader.messages(wanted, **span)
            ]

    with Bag(tmp_path / "bag") as bag:
        for topics in ("a", "b", "ab"):
            for start, stop in ((None, None), (1105, None), (None, 1290), (1100, 1300)):
                limits = {"start_ns": start, "stop_ns": stop}
                given = {name: limit for name, limit in limits.items() if limit is not None}
                entries = bag.read_entries({f"/{name}" for name in topics}, **given)
                ours = [(entry.topic, entry.time_ns, entry.data) for entry in entries]
                assert ours == by_rosbags(topics, start=start, stop=stop) and len(ours) > 3
                assert [time_ns for _, time_ns, _ in ours] == sorted(one[1] for one in ours)


def test_type_hashes_are_those_of_ros():
    """rosbags' reading of our message files is the one that ROS generated code from."""
    pytest.importorskip("rclpy")
    installed = Path(os.environ["AMENT_PREFIX_PATH"].split(":")[0]) / "share/cube_tensor_driver/msg"
    for kind in (FREQUENCIES_TYPE, STRESS_TYPE, INFO_TYPE):
        text = (installed / f"{kind.split('/')[-1]}.json").read_text()
        assert make_typestore().hash_rihs01(kind) in text


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_reprocessed_is_recorded_to_the_bit(tmp_path, storage):
    path = make_bag(tmp_path / "bag", SKIN, storage=storage)
    done = reprocess(ReprocessJob(path, tmp_path / "out", "bag"))
    assert done.messages == 300 and done.rows == 300 * 16
    assert all_differing_bits(stress(path), stress(tmp_path / "out")) == 0
    with Bag(path) as one, Bag(tmp_path / "out") as other:
        assert other.read_infos("/info")[0].calibrations == one.read_infos("/info")[0].calibrations


def test_reprocess_needs_no_ros(bag, tmp_path):
    script = (
        "import sys\nfrom pathlib import Path\n"
        "from cube_tensor_driver.bags.reprocess.job import *\n"
        "reprocess(ReprocessJob(Path(sys.argv[1]), Path(sys.argv[2]), 'bag'))\n"
        "found = {'rclpy', 'cube_tensor_driver.msg', 'matplotlib'} & set(sys.modules)\n"
        "sys.exit(f'imported {found}' if found else 0)"
    )
    subprocess.run(
        [sys.executable, "-c", script, str(bag), str(tmp_path / "out")], check=True, cwd=ROOT
    )


def test_tare_in_the_middle_counts_from_its_time_on(tmp_path):
    """Two infos of the reconstruction and one, later, of the driver, which knows of no tare."""
    skin = read_skin(SKIN)
    pipeline = Pipeline([cube.calibration for cube in skin.cubes], np.float32)
    tared = Pipeline([cube.calibration for cube in skin.cubes], np.float32)
    tared.rest_frequency = pipeline.rest_frequency * 1.001
    store, middle = make_typestore(), START_NS + 500_000_000
    with BagWriter(tmp_path / "bag") as writer:
        for topic, kind in (("/frequencies", FREQUENCIES_TYPE), ("/info", INFO_TYPE)):
            writer.add_topic(topic, kind)
        for of, stamp, sender in (
            (pipeline, START_NS, "reconstruction"),
            (tared, middle, "reconstruction"),
            (pipeline, middle + 1, "driver"),
        ):
            writer.write(
                "/info",
                stamp,
                bytes(store.serialize_cdr(info_of(skin, of, stamp, sender), INFO_TYPE)),
            )
        for k in range(100):
            raw = frequencies_of(k, START_NS + 10_000_000 * k, loads(pipeline, 0.01 * k))
            writer.write(
                "/frequencies",
                START_NS + 10_000_000 * k,
                bytes(store.serialize_cdr(raw, FREQUENCIES_TYPE)),
            )
    reprocess(ReprocessJob(tmp_path / "bag", tmp_path / "out", "bag"))
    for k, record in enumerate(stress(tmp_path / "out").values()):
        of = pipeline if k < 50 else tared
        expected = of.process(
            FrequencyRows.from_values(record.cube, loads(pipeline, 0.01 * k).astype(np.float32))
        )
        np.testing.assert_array_equal(record.stress, expected.stress, err_msg=str(k))


def test_what_was_found_before_the_recording_began_is_taken_from_it(tmp_path):
    """A pad that got stuck long ago, and moves again by now: nothing in the frequencies says that
    it was left out."""
    path = make_bag(
        tmp_path / "bag",
        SKIN,
        150,
        left_out=lambda k: np.where(np.arange(16) == 3, 1 << 2, 0) * (k < 80),
    )
    reprocess(ReprocessJob(path, tmp_path / "out", "bag"))
    recorded = stress(path)
    assert all_differing_bits(recorded, stress(tmp_path / "out")) == 0
    assert [int(one.left_out[3]) for one in recorded.values()] == [4] * 80 + [0] * 70
    assert recorded[START_NS].status[3] == PAD_FAULT | STUCK
    reprocess(ReprocessJob(path, tmp_path / "bag.parquet", "parquet"))
    table = pyarrow.parquet.read_table(tmp_path / "bag.parquet")
    assert table["left_out"].to_numpy()[:16].tolist() == [0, 0, 0, 4] + [0] * 12
    # another tare begins the assessment anew, and does not find it
    with open_bag(path) as source:
        ((_, rows), *_) = reconstruct(source, choose_settings(source, Overrides(tare=(0.0, 0.1))))
    assert not rows.left_out.any() and (rows.status & STUCK == 0).all()


def test_tables_hold_the_same_numbers_with_units(bag, tmp_path):
    for form in ("parquet", "csv"):
        reprocess(ReprocessJob(bag, tmp_path / f"bag.{form}", form))
    parquet = pyarrow.parquet.read_table(tmp_path / "bag.parquet")
    csv = pyarrow.csv.read_csv(tmp_path / "bag.csv")
    assert parquet.column_names == csv.column_names
    assert {"stamp_ns", "stress_zz_Pa", "gradient_zz_x_Pa_per_m"} <= set(parquet.column_names)
    records = list(stress(bag).values())
    zz = np.concatenate([record.stress[:, 2] for record in records])
    np.testing.assert_array_equal(parquet["stress_zz_Pa"].to_numpy(), zz)
    np.testing.assert_array_equal(csv["stress_zz_Pa"].to_numpy().astype(np.float32), zz)
    for name in ("residual", "status", "observed", "sequence"):
        np.testing.assert_array_equal(
            parquet[name].to_numpy(), np.concatenate([getattr(record, name) for record in records])
        )
    assert parquet["cube"].to_pylist()[:17] == [f"c{k:02}" for k in range(16)] + ["c00"]
    assert parquet["stamp_ns"].to_pylist()[1] == START_NS + 100


def test_another_calibration_and_tare(bag, tmp_path, capsys, one_process):
    """Twice the modulus is twice the stress; after a tare over one instant that instant has
    none."""
    known = read_skin(SKIN).cubes[0].calibration
    write_calibration(
        tmp_path / "stiff.yaml", dataclasses.replace(known, modulus=2 * known.modulus)
    )
    common = ["reprocess", str(bag), "-o", str(tmp_path / "stiff"), "--jobs", "1"]
    assert main([*common, "--calibration", str(tmp_path / "stiff.yaml")]) == 0
    before, after = stress(bag), stress(tmp_path / "stiff" / "bag")
    for stamp, record in after.items():
        np.testing.assert_allclose(record.stress, 2 * before[stamp].stress, rtol=1e-5)  # float32
    assert (
        main(
            ["reprocess", str(bag), "-o", str(tmp_path / "tared"), "--tare-from", "0.999", "1.001"]
        )
        == 0
    )
    with Bag(tmp_path / "tared" / "bag") as made:
        assert len(made.read_infos("/info")) == 1
    record = stress(tmp_path / "tared" / "bag")[START_NS + 1_000_000_000]
    # rest is float64, the frequency float32: 6e-8 of it, as strain, times the modulus of 0.3 MPa
    # and the inversion
    assert np.nanmax(np.abs(record.stress)) < 1
    assert np.nanmax(np.abs(before[START_NS + 1_000_000_000].stress)) > 100
    assert (
        main(["reprocess", str(bag), "-o", str(tmp_path / "late"), "--tare-from", "50", "51"]) == 1
    )
    assert "0 to 2.990 s" in " ".join(capsys.readouterr().err.split())


def test_calibrations_of_another_skin_file_go_by_the_names_of_cubes(
    bag, tmp_path, capsys, one_process
):
    """Twice the modulus for one cube; the cubes stand in another order in the file."""
    known = read_skin(SKIN).cubes[0].calibration
    write_calibration(
        tmp_path / "stiff.yaml", dataclasses.replace(known, modulus=2 * known.modulus)
    )
    data = read_yaml(SKIN)
    data["cubes"][3]["calibration"] = "stiff.yaml"
    data["cubes"].reverse()
    write_yaml(tmp_path / "skin.yaml", data)
    command = ["reprocess", str(bag), "--jobs", "1", "--skin", str(tmp_path / "skin.yaml")]
    assert main([*command, "-o", str(tmp_path / "out")]) == 0
    before, after = stress(bag), stress(tmp_path / "out" / "bag")
    factor = np.where(np.arange(16) == 3, 2, 1)[:, None]
    for stamp, record in after.items():
        expected = factor * before[stamp].stress
        # A component is a sum over pads in float32: it rounds in proportion to the cube's largest
        # stress, and in another order where a skin has two calibrations.
        rounding = 1e-5 * np.nanmax(np.abs(expected), axis=1, keepdims=True)
        unseen = np.isnan(expected)
        assert np.array_equal(np.isnan(record.stress), unseen)
        assert np.all((np.abs(record.stress - expected) <= rounding) | unseen)
    with Bag(tmp_path / "out" / "bag") as made:
        ids = [cube.calibration_id for cube in made.read_infos("/info")[0].cubes]
    assert len(set(ids)) == 2 and ids.count(ids[3]) == 1
    del data["cubes"][5]
    write_yaml(tmp_path / "skin.yaml", data)
    assert main([*command, "-o", str(tmp_path / "less")]) == 1
    assert "has no cubes c10" in " ".join(capsys.readouterr().err.split())


def test_reprocess_goes_on_where_it_ended(bag, tmp_path, capsys):
    other = shutil.copytree(bag, tmp_path / "other")
    out = tmp_path / "out"
    assert main(["reprocess", str(bag), "-o", str(out), "--jobs", "1"]) == 0
    (out / ".partial-other" / "other").mkdir(parents=True)  # as left behind by a killed run
    stamp = (out / "bag" / "metadata.yaml").stat().st_mtime_ns
    assert main(["reprocess", str(bag), str(other), "-o", str(out), "--jobs", "2"]) == 0
    assert (out / "bag" / "metadata.yaml").stat().st_mtime_ns == stamp
    assert all_differing_bits(stress(bag), stress(out / "other")) == 0
    assert not (out / ".partial-other").exists()
    assert main(["reprocess", str(bag), "-o", str(out), "--tare-from", "0", "1"]) == 1
    assert "other options" in capsys.readouterr().err


def test_cut_off_anywhere_is_repaired(bag, tmp_path):
    """What stood in complete chunks is there after the repair, the rest is kept, whatever byte the
    end fell on."""
    rng = np.random.default_rng(7)
    whole = tmp_path / "whole"
    with Bag(bag) as source, BagWriter(whole) as writer:
        for connection in source.connections:
            writer.add_topic(connection.topic, connection.msgtype)
        flushed = []
        for number, entry in enumerate(source.read_entries(), 1):
            writer.write(entry.topic, entry.time_ns, entry.data)
            if number % 60 == 0:
                writer.flush()
                flushed.append((next(whole.glob("*.mcap")).stat().st_size, number))
        data = next(whole.glob("*.mcap")).read_bytes()
    for number, size in enumerate(rng.integers(flushed[0][0], len(data), 20).tolist()):
        path = tmp_path / f"cut{number}"
        path.mkdir()
        (path / f"cut{number}_0.mcap").write_bytes(data[:size])
        with pytest.raises(BagError, match="repair"):
            Bag(path)
        done = repair(path)
        complete = max(count for at, count in flushed if at <= size)
        assert done.messages == complete and done.damaged == 0
        with Bag(path) as read:
            assert sum(1 for _ in read.read_entries()) == complete
            # topic by topic by the index: entries counts them against what the bag says
            assert (
                sum(
                    1
                    for connection in read.connections
                    for _ in read.read_entries({connection.topic})
                )
                == complete
            )
        kept = size - done.cut
        assert kept == max(at for at, _ in flushed if at <= size)
        assert next(path.glob("*.mcap")).read_bytes()[:kept] == data[:kept]
        assert sum(one.stat().st_size for one in path.glob("*.rest")) == done.cut
        assert repair(path).cut == 0
        # rosbag2 reads nothing where one of these is missing
        own, good = (
            said_of_itself(next(path.glob("*.mcap"))),
            said_of_itself(next(bag.glob("*.mcap"))),
        )
        assert own.keys() == good.keys() and own["message_count"] == complete
        assert own["files"][0].keys() == good["files"][0].keys()


def test_a_damaged_summary_is_noticed_and_written_again(bag, copy):
    path = next(copy.glob("*.mcap"))
    data = bytearray(path.read_bytes())
    data[-200] ^= 1
    path.write_bytes(data)
    with pytest.raises(BagError, match="the summary does not have its checksum"):
        Bag(copy)
    assert repair(copy).damaged == 0
    assert all_differing_bits(stress(copy), stress(bag)) == 0


@pytest.mark.parametrize("mistake", [AttributeError, TypeError, AssertionError, MemoryError])
def test_a_mistake_of_the_program_is_not_called_damage(mistake):
    with pytest.raises(mistake), report_damage(Path("bag")):
        raise mistake


def test_a_person_sees_what_a_bag_is(bag):
    with open_bag(bag) as source:
        assert "/stress (300)" in repr(source.bag)
        assert "/frequencies" in repr(source) and "3.0 s" in repr(source)
        assert len(repr(source)) + len(repr(source.recording)) < 500
    assert repr(source.bag) == f"Bag({str(bag)!r}: closed)"


def said_of_itself(path: Path) -> dict:
    """The metadata inside an mcap file."""
    data = path.read_bytes()
    at = data.rindex(b"serialized_metadata") + len(b"serialized_metadata")
    (length,) = struct.unpack_from("<I", data, at)
    return parse_yaml(data[at + 4 : at + 4 + length].decode(), "metadata")


@pytest.mark.campaign
def test_random_damage_is_one_message_or_no_harm(tmp_path, effort):
    """Truncated, flipped, missing, exchanged: either all is read and equal, or one line says what
    is wrong."""
    rng = np.random.default_rng(3)
    sqlite = make_bag(tmp_path / "sqlite", SKIN, 60, storage="sqlite3")
    mcap = make_bag(tmp_path / "mcap", SKIN, 60)
    good = {path: stress(path) for path in (sqlite, mcap)}
    outcomes = {"refused": 0, "harmless": 0}
    for number in range(100 * effort):
        source = (sqlite, mcap)[number % 2]
        path = Path(shutil.copytree(source, tmp_path / f"case{number}"))
        storage = next(one for one in path.iterdir() if one.suffix in (".mcap", ".db3"))
        target = path / "metadata.yaml" if number % 10 == 9 else storage
        data = bytearray(target.read_bytes())
        what = number % 5
        if what == 0:
            data = data[: rng.integers(len(data))]
        elif what in (1, 2, 4):
            for at in rng.integers(0, len(data), 1 + 20 * (what == 2)):
                data[at] ^= 1 << rng.integers(8)
        if what == 3 and number % 20 < 10:
            target.unlink()
        elif what == 3:
            target.write_bytes(data.replace(b"SkinFrequencies", b"SkinFrequencieX"))
        else:
            target.write_bytes(data)
        try:
            reprocess(ReprocessJob(path, tmp_path / f"out{number}", "bag"))
        except BagError as error:
            outcomes["refused"] += 1
            assert str(path.name) in str(error) and "\n" not in str(error), str(error)
            continue
        outcomes["harmless"] += 1
        again = stress(tmp_path / f"out{number}")
        if source == mcap:  # sqlite has no checksums: a flipped bit of a number stays a number
            assert all_differing_bits(again, good[source]) == 0
    assert outcomes["refused"] > 40 * effort


def test_the_command_that_is_advised_for_a_cut_file_works_on_it(bag, tmp_path, capsys):
    whole = next(bag.glob("*.mcap")).read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    assert main(["bag", "info", str(cut)]) == 1
    advice = re.search(r"\./cube (bag repair \S+)", capsys.readouterr().err)
    assert main(advice[1].split()) == 0
    assert "messages can be read" in capsys.readouterr().out
    assert main(["bag", "info", str(cut)]) == 0
    assert main(["bag", "repair", str(tmp_path / "nothing.mcap")]) == 1


def test_what_repair_leaves_out_is_counted_by_its_name(copy, capsys):
    """First one index record of a chunk is damaged, then a second one of another chunk, too."""
    (path,) = copy.glob("*.mcap")
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    for expected, chunk in (("1 damaged record\n", chunks[0]), ("2 damaged records\n", chunks[-1])):
        data = bytearray(path.read_bytes())
        length = min(chunk.message_index_offsets.values()) + RECORD_HEAD.size + 2
        data[length] ^= 1  # the list is longer than its record
        path.write_bytes(data)
        assert main(["bag", "repair", str(copy)]) == 0
        assert f"left out {expected}" in capsys.readouterr().out


def test_a_reprocess_that_failed_does_not_refuse_the_corrected_command(
    bag, tmp_path, capsys, one_process
):
    cut, out = tmp_path / "cut.mcap", tmp_path / "out"
    cut.write_bytes(b"no bag")
    assert main(["reprocess", str(cut), "-o", str(out), "--jobs", "1"]) == 1
    assert not out.exists()
    # as one that was killed leaves it
    out.mkdir()
    (out / "reprocess.yaml").write_text("format: bag\n")
    command = ["reprocess", str(bag), "-o", str(out), "--jobs", "1", "--format", "csv"]
    assert main(command) == 0, capsys.readouterr().err


def test_fit_of_a_bag_names_the_option_that_is_missing(bag, tmp_path, capsys):
    assert main(["fit", str(bag), "--layout", "planar", "-o", str(tmp_path / "x.yaml")]) == 1
    assert f"{bag} is a bag: name the topic to fit to with --reference" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere", "name a bag"),
        ("empty", "repair"),
        ("text.mcap", "damaged, or no bag"),
        ("text.txt", "no bag; name the folder of a bag"),
    ],
)
def test_what_is_no_bag_is_refused(tmp_path, name, words, capsys):
    (tmp_path / "empty").mkdir()
    for file in ("text.mcap", "text.txt"):
        (tmp_path / file).write_text("no bag at all")
    assert main(["bag", "info", str(tmp_path / name)]) == 1
    error = capsys.readouterr().err
    assert words in error and str(tmp_path / name) in error and "Traceback" not in error


def test_another_version_is_refused(tmp_path):
    """By the number that info has, or by what the bag says about a type."""
    skin = read_skin(SKIN)
    pipeline = Pipeline([cube.calibration for cube in skin.cubes], np.float32)
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic("/info", INFO_TYPE)
        writer.write(
            "/info",
            1,
            bytes(make_typestore().serialize_cdr(info_of(skin, pipeline, 1, version=7), INFO_TYPE)),
        )
    with Bag(tmp_path / "bag") as bag, pytest.raises(BagError, match="/info has version 7; this"):
        bag.read_infos("/info")

    old = tmp_path / "old.mcap"
    with old.open("wb") as file:
        library = mcap.writer.Writer(file)
        library.start("ros2")
        schema = library.register_schema(
            FREQUENCIES_TYPE, "ros2msg", b"uint16[] cube\nuint8 n_pads\n"
        )
        library.add_message(library.register_channel("/frequencies", "cdr", schema), 1, b"", 1)
        library.finish()
    with pytest.raises(BagError, match=f"another definition of {FREQUENCIES_TYPE}; this") as caught:
        Bag(old)
    assert "\n" not in str(caught.value)


def test_a_recorded_bag_can_be_read(tmp_path):
    reprocess(ReprocessJob(KEPT, tmp_path / "out", "bag"))
    recorded, again = stress(KEPT), stress(tmp_path / "out")
    common = recorded.keys() & again.keys()
    assert len(common) > 90
    assert sum(np.count_nonzero(one.status & STAMP) for one in recorded.values()) == 20
    for stamp in common:
        # not to the bit: another processor may round otherwise
        np.testing.assert_allclose(again[stamp].stress, recorded[stamp].stress, rtol=1e-4, atol=0.1)
        np.testing.assert_array_equal(again[stamp].status, recorded[stamp].status)
        assert not again[stamp].left_out.any()


def test_fit_from_a_bag(tmp_path, capsys):
    """A cube under known loads recovers its coefficients; by forces alone, what they do not tell is
    named."""
    skin = read_skin(find_package_data() / "config" / "cube.yaml")
    calibration, area = skin.cubes[0].calibration, 1e-4
    modes, kind = calibration.modes, "cube_tensor_driver/msg/StressTensorStamped"
    pipeline = Pipeline([calibration], np.float32)
    zero = message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)

    def put(topic: str, stamp: int, one: object) -> None:
        writer.write(topic, stamp, bytes(make_typestore().serialize_cdr(one, one.__msgtype__)))

    with BagWriter(tmp_path / "bag") as writer:
        for topic, of in (
            ("/frequencies", FREQUENCIES_TYPE),
            ("/info", INFO_TYPE),
            ("/force", WRENCH),
            ("/known", kind),
        ):
            writer.add_topic(topic, of)
        put("/info", START_NS, info_of(skin, pipeline, START_NS))
        for k in range(80):
            state = 3000 * np.sin(0.1 * k * (1 + np.arange(modes.n_modes)))
            v = calibration.response @ state
            f = compute_pad_frequency(
                v, calibration.rest_frequency, calibration.beta, calibration.modulus
            )
            stamp = START_NS + 10_000_000 * k
            put("/frequencies", stamp, frequencies_of(k, stamp, f[None]))
            values = modes.components @ state
            values[6:] /= calibration.half_side
            xx, yy, zz, yz, zx, xy = values[:6]
            force = message("geometry_msgs/msg/Vector3", x=zx * area, y=yz * area, z=zz * area)
            wrench = message("geometry_msgs/msg/Wrench", force=force, torque=zero)
            put("/force", stamp, message(WRENCH, header=header(stamp, "sensor"), wrench=wrench))
            tensor = message(
                "cube_tensor_driver/msg/StressTensor",
                normal=message("geometry_msgs/msg/Vector3", x=xx, y=yy, z=zz),
                shear=message("geometry_msgs/msg/Vector3", x=yz, y=zx, z=xy),
                normal_gradient=values[6:],
                covariance=np.zeros(225),
                residual=0.0,
                status=0,
                observed=0,
            )
            put("/known", stamp, message(kind, header=header(stamp, "cube"), tensor=tensor))
    common = [
        "fit",
        str(tmp_path / "bag"),
        "--layout",
        "planar",
        "-o",
        str(tmp_path / "f.yaml"),
        "--reference",
    ]
    assert main([*common, "/known"]) == 0
    fitted = read_calibration(tmp_path / "f.yaml")
    for name, value in calibration.coefficients.items():
        # float32 carries 6e-8 of f, which is 2e-5 of a strain of 0.3 %
        assert fitted.coefficients[name] == pytest.approx(value, abs=2e-4), name
    capsys.readouterr()
    assert main([*common, "/force", "--area", str(area)]) == 1
    assert "do not determine e, f" in capsys.readouterr().err


def test_fit_says_what_a_bag_lacks(bag, tmp_path, capsys):
    common = ["fit", str(bag), "--layout", "planar", "-o", str(tmp_path / "f.yaml")]
    for more, words in (
        (["--reference", "/force"], "--cube"),
        (["--reference", "/force", "--cube", "c99"], "no cube 'c99'"),
        (["--reference", "/nothing", "--cube", "c00"], "not there"),
        (["--reference", "/force", "--cube", "c00"], "--area"),
    ):
        assert main([*common, *more]) == 1
        assert words in capsys.readouterr().err


def test_a_bag_that_cannot_be_reprocessed_leaves_no_full_bar(tmp_path, capsys):
    assert main(["reprocess", str(tmp_path / "nope"), "-o", str(tmp_path / "out")]) == 1
    error = " ".join(capsys.readouterr().err.split())
    assert "nope: no such file or folder" in error and "100%" not in error


def test_info_shows_the_diagnostics_in_the_bag(bag, capsys, monkeypatch):
    values = [SimpleNamespace(key="crc", value="3"), SimpleNamespace(key="framing", value="0")]
    statuses = [
        SimpleNamespace(name="/left/driver: link hub0", message="", values=values),
        SimpleNamespace(name="/left/driver: rows", message="too slow", values=[]),
    ]
    monkeypatch.setattr(summary, "find_last_diagnostics", lambda _: statuses)
    assert main(["bag", "info", str(bag)]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "/left/driver: link hub0: nothing wrong; crc 3",
        "/left/driver: rows: too slow; ",
    ]


def test_plot_and_info(bag, tmp_path, capsys):
    figure = tmp_path / "c03.png"
    assert (
        main(["plot", str(bag), "--cube", "c03", "--from", "0.5", "--to", "1.5", "-o", str(figure)])
        == 0
    )
    # 300 ns after each scan: the one at 1.5 s is behind the end
    assert "100 samples" in capsys.readouterr().out and figure.stat().st_size > 20_000
    assert main(["plot", str(bag), "--cube", "c99", "-o", str(figure)]) == 1
    assert "no cube 'c99'" in capsys.readouterr().err
    assert main(["bag", "info", str(bag)]) == 0
    text = capsys.readouterr().out
    assert "skin 'skin': 16 cubes" in text and read_skin(SKIN).cubes[0].calibration.id in text
    row = next(
        line for line in text.splitlines() if line.startswith(" c07 ") or line.startswith("c07 ")
    )
    assert row.split()[2:5] == ["300", "100.0", "0"]
    with BagWriter(tmp_path / "empty"):
        pass
    assert main(["bag", "info", str(tmp_path / "empty")]) == 0
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'empty'}: no messages\n")


FILL_THE_DISK = """
import resource, signal, sys
from pathlib import Path
from types import SimpleNamespace

from cube_tensor_driver.bags.read import Bag
from cube_tensor_driver.bags.repair import repair
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.core.errors import BagError

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
try:
    with Bag(Path(sys.argv[1])) as source, BagWriter(Path(sys.argv[2])) as writer:
        for one in source.connections:
            writer.add_topic(one.topic, one.msgtype)
        for entry in source.read_entries():
            writer.write(entry.topic, entry.time_ns, entry.data)
            writer.flush()
except BagError as error:
    print(error)
    print(repair(Path(sys.argv[2]), keep_rest=False).messages)
    sys.exit(3)
"""


KILL_THE_WRITER = """
import os, signal, sys
from pathlib import Path
from types import SimpleNamespace

from cube_tensor_driver.bags.write import BagWriter

writer = BagWriter(Path(sys.argv[1]), sys.argv[2])
writer.add_topic("/text", "std_msgs/msg/String")
for number in range(400):
    writer.write("/text", 1000 + number, bytes(5000))
    if number == 299:
        writer.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_killed_writer_leaves_what_was_flushed(tmp_path, storage):
    path = tmp_path / "killed"
    subprocess.run(
        [sys.executable, "-c", KILL_THE_WRITER, str(path), storage], cwd=ROOT, check=False
    )
    with pytest.raises(BagError, match="repair"):
        Bag(path)
    done = repair(path)
    assert done.messages >= 300 and done.damaged == 0
    with Bag(path) as bag:
        times = [entry.time_ns for entry in bag.read_entries()]
    assert times == list(range(1000, 1000 + done.messages))


def test_disk_full_leaves_what_was_written(bag, tmp_path):
    """The file system takes 300 kB, then no more: the last messages make room for the summary."""
    command = [sys.executable, "-c", FILL_THE_DISK, str(bag), str(tmp_path / "full")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (
        done.returncode == 3 and "File too large" in done.stdout and "with room" in done.stdout
    ), done.stderr
    kept = int(done.stdout.split()[-1])
    assert kept > 80
    with Bag(tmp_path / "full") as read, Bag(bag) as source:
        whole = [entry.data for entry in source.read_entries()]
        assert [entry.data for entry in read.read_entries()] == whole[:kept]


@pytest.mark.parametrize(
    "name",
    ["rosbag2_2026_05_01-10_30_00_{}", "{}_run_2026_05_01-10_30_00", "{}__2026_05_01-10_30_00"],
)
@pytest.mark.parametrize("listed", [(), (7, 3)])
def test_files_are_read_in_the_order_of_recording(tmp_path, name, listed):
    """After a repair too: as metadata.yaml says, then by the numbers in both forms of names."""
    bag = tmp_path / "bag"
    bag.mkdir()
    for number in range(12):
        with BagWriter(tmp_path / "one") as writer:
            writer.add_topic("/number", "std_msgs/msg/String")
            writer.write("/number", 100 + number, b"%d" % number)
        next((tmp_path / "one").glob("*.mcap")).rename(bag / f"{name.format(number)}.mcap")
        shutil.rmtree(tmp_path / "one")
    if listed:
        paths = [f"{name.format(number)}.mcap" for number in listed]
        about = {"version": 9, "relative_file_paths": paths, "compression_mode": ""}
        write_yaml(bag / "metadata.yaml", {"rosbag2_bagfile_information": about})
    repair(bag)
    with Bag(bag) as read:
        order = [int(entry.data) for entry in read.read_entries()]
    assert order == [*listed, *(number for number in range(12) if number not in listed)]


def test_bags_and_simulation_need_nothing_posix(tmp_path):
    """In a child process that takes away what Windows lacks; reprocessing gives the same bits, and
    what cannot run says so in one line."""
    script = ROOT / "test" / "without_posix.py"
    done = subprocess.run(
        [sys.executable, script, KEPT, tmp_path / "out"],
        env={**os.environ, "PYTHONPATH": f"{ROOT}:{os.environ.get('PYTHONPATH', '')}"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "need Linux or macOS" in done.stdout and "pseudo-terminals" in done.stdout
    reprocess(ReprocessJob(KEPT, tmp_path / "here", "bag"))
    assert all_differing_bits(stress(tmp_path / "out" / "bag"), stress(tmp_path / "here")) == 0


def test_a_newer_metadata_version_is_one_line(copy, caplog):
    path = copy / "metadata.yaml"
    said = read_yaml(path)
    about = said["rosbag2_bagfile_information"]
    about["version"] = 10
    write_yaml(path, said)
    Bag(copy).close()
    assert [record.getMessage() for record in caplog.records] == [
        f"{path}: its version 10 is newer than 9, the newest known one"
    ]
    about["files_by_name"] = about.pop("relative_file_paths")
    write_yaml(path, said)
    with pytest.raises(BagError, match=r"version 10 is newer than 9.*bag repair") as caught:
        Bag(copy)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_running_recording_is_not_repaired(tmp_path, storage):
    with BagWriter(tmp_path / "bag", storage) as writer:
        writer.add_topic("/text", "std_msgs/msg/String")
        for time in range(10):
            writer.write("/text", time, b"")
            writer.flush()
            with pytest.raises(BagError, match="is being recorded by another process"):
                repair(tmp_path / "bag")
    assert repair(tmp_path / "bag").messages == 10


def test_unwritable_and_existing_folders_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    for folder, words in (
        (tmp_path, "is there already"),
        (tmp_path / "file" / "bag", "Not a directory"),
    ):
        with pytest.raises(BagError, match=words):
            BagWriter(folder)
