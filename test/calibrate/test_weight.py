# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The response to weight that `./cube fit --weight` finds, against the one that made the bag."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from bag_maker import START_NS, header, info_of, message

from conftest import encoded
from cube_tensor_driver.bags.metadata import describe_quality, make_typestore
from cube_tensor_driver.bags.reprocess.job import Overrides, choose_settings
from cube_tensor_driver.bags.source import open_bag
from cube_tensor_driver.bags.write import BagWriter
from cube_tensor_driver.calibrate.weight import fit_weight
from cube_tensor_driver.cli import main as cli
from cube_tensor_driver.config.calibration import find_shipped_calibration, read_calibration
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.core.calibration import make_illustrative_calibration
from cube_tensor_driver.core.compensation.models import WeightModel
from cube_tensor_driver.core.errors import BagError
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.core.oscillator import compute_pad_frequency
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.status import COMPENSATION, WEIGHT
from cube_tensor_driver.messages.types import COMPENSATION_TYPE, FREQUENCIES_TYPE, INFO_TYPE
from cube_tensor_driver.simulation.imperfections import Imperfections
from cube_tensor_driver.simulation.motion import read_weight
from cube_tensor_driver.simulation.source import simulate

G = 9.80665
RNG = np.random.default_rng(5)
BASE = replace(make_illustrative_calibration("planar"), gain=1 + 0.05 * RNG.normal(size=8))
RESPONSE = 8 * RNG.normal(size=(8, 3))
POSES = [[0, 0, G], [0, 0, -G], [G, 0, 0], [0, -G, 0], [0, G, 0], [-G, 0, 0]]
SECONDS = 5.0
"""Time in each pose; the arm turns within the last second of it."""


def force_at(t: float, poses) -> np.ndarray:
    k = int(t / SECONDS)
    turned = np.clip(t / SECONDS - k - 0.8, 0, 1) / 0.2
    before, after = np.array(poses[k]), np.array(poses[min(k + 1, len(poses) - 1)])
    return before + turned * (after - before)


def make_bag(folder, poses=POSES, spread=0.0, cubes=3, motion=True, **changes):
    """A bag of unloaded cubes with noise and drift, whose responses differ by a factor."""
    rng, calibration = np.random.default_rng(7), replace(BASE, **changes)
    skin = SimpleNamespace(
        name="skin",
        elastomer=None,
        make_frame_id=lambda cube: cube.name,
        cubes=[
            SimpleNamespace(name=f"c{k}", link="hub0", index=k, uid=0, calibration=calibration)
            for k in range(cubes)
        ],
    )
    responses = RESPONSE * (1 + spread * rng.normal(size=(cubes, 1, 1)))
    offset = 50 * rng.normal(size=(cubes, 8))
    scans = []
    for n in range(round(len(poses) * SECONDS * 25)):
        force = force_at(n / 25, poses)
        pads = (BASE.gain[:, None] * responses) @ force + offset * (1 + n / 2000)
        pads = pads + BASE.noise * rng.normal(size=pads.shape)
        rows = FrequencyRows.from_values(
            np.arange(cubes, dtype=np.uint16),
            compute_pad_frequency(pads, BASE.rest_frequency, BASE.beta, BASE.modulus).astype(
                np.float32
            ),
            stamp_ns=n * 40_000_000,
            sequence=n,
            specific_force=force,
        )
        scans.append(rows)
    return write_bag(folder, skin, scans, motion)


def write_bag(folder, skin, scans, motion=True):
    """A bag of scans from the time 0 on, with the specific force of their first cube."""
    store = make_typestore()
    topics = {"info": INFO_TYPE, "frequencies": FREQUENCIES_TYPE}
    if motion:
        topics["compensation"] = COMPENSATION_TYPE
    with BagWriter(folder) as writer:
        for topic, kind in topics.items():
            writer.add_topic(f"/{topic}", kind, [describe_quality(latched=topic == "info")])
        info = info_of(skin, Pipeline([cube.calibration for cube in skin.cubes]), START_NS)
        writer.write("/info", START_NS, bytes(store.serialize_cdr(info, INFO_TYPE)))
        for rows in scans:
            stamps = rows.stamp_ns + START_NS
            stamp_ns = int(stamps[0])
            data = encoded(replace(rows, stamp_ns=stamps), b"base\0")
            writer.write("/frequencies", stamp_ns, data)
            if motion:
                one = message(
                    COMPENSATION_TYPE,
                    header=header(stamp_ns),
                    weight=True,
                    time_offset=np.zeros(1, np.int64),
                    specific_force=rows.specific_force[0].astype(float),
                    gradient=np.zeros(9),
                    creep=np.zeros(0),
                    thermal=np.zeros(0),
                )
                data = bytes(store.serialize_cdr(one, COMPENSATION_TYPE))
                writer.write("/compensation", stamp_ns + 1, data)
    return folder


def test_the_response_is_found_and_its_deviation_is_stated(tmp_path):
    """24 numbers of white noise: their error over the stated one is 1 within 5 x 1/sqrt(48)."""
    model = fit_weight(make_bag(tmp_path / "bag")).calibration.weight
    ratio = (model.response - RESPONSE) / model.deviation
    assert 0.3 < np.sqrt((ratio**2).mean()) < 1.7
    assert np.abs(model.response - RESPONSE).max() < 0.1  # Pa per m/s², of 8


def test_cubes_that_differ_widen_the_deviation_of_their_mean(tmp_path):
    folder = make_bag(tmp_path / "bag", spread=0.1, cubes=30)
    model = fit_weight(folder).calibration.weight
    large = np.abs(RESPONSE) > 3
    found = (model.deviation / np.abs(RESPONSE))[large]
    np.testing.assert_allclose(found, 0.1, rtol=0.4)  # the spread of 30 draws, to 3 sigma
    alone = fit_weight(folder, "c3").calibration.weight
    assert np.median((alone.deviation / np.abs(RESPONSE))[large]) < 0.02


@pytest.mark.parametrize(
    ("changes", "name", "text"),
    [
        ({"poses": POSES[:2] * 3}, None, "turn the arm until each axis has pointed up and down"),
        ({"poses": POSES[:1]}, None, "10 blocks of 0.5 s"),
        ({"motion": False}, None, "record it while the parameter imu or gravity"),
        ({"poses": POSES[:1]}, "c9", "no cube 'c9'; there are c0, c1, c2"),
    ],
)
def test_what_does_not_determine_it_is_one_line(tmp_path, changes, name, text):
    with pytest.raises(BagError, match=text) as error:
        fit_weight(make_bag(tmp_path / "bag", **changes), name)
    assert "\n" not in str(error.value)


def test_a_tare_from_a_bag_is_that_of_a_cube_without_weight(tmp_path):
    """Two poses give the same rest frequencies, although their weights differ by above 200 ppm.

    The tolerance covers the noise of a mean of 100 rows (8 ppm each) and a drift of 5 Pa (10 ppm).
    """
    heavy = {"weight": WeightModel(RESPONSE)}
    folder = make_bag(tmp_path / "bag", [[0, 0, G], [G, 0, 0]], cubes=1, **heavy)
    with open_bag(folder) as source:
        first, second = (
            choose_settings(source, Overrides(tare=span))[0].rest_frequency
            for span in ((0.0, 4.0), (5.0, 9.0))
        )
    np.testing.assert_allclose(first, second, rtol=4e-5)
    weight = BASE.gain[:, None] * RESPONSE * G / (BASE.modulus * (1 + BASE.beta))[:, None]
    assert np.abs(weight[:, 2] - weight[:, 0]).max() > 2e-4


def test_the_command_writes_the_calibration(tmp_path, capsys):
    bag, saved = make_bag(tmp_path / "bag"), tmp_path / "heavy.yaml"
    assert cli.main(["fit", "--weight", str(bag), "-o", str(saved)]) == 0
    assert saved.with_suffix(".png").stat().st_size > 20_000
    found = read_calibration(saved)
    np.testing.assert_allclose(found.weight.response, RESPONSE, atol=0.1)
    assert f"{found.weight.response[0, 0]:+.3f} ±" in capsys.readouterr().out
    assert replace(found, weight=None, source=BASE.source).id == BASE.id
    assert cli.main(["fit", "-o", str(saved)]) == 1
    assert "needs a table of loads and --layout, or --weight BAG" in capsys.readouterr().err


class Pressed:
    """A load that never changes: uniform zz at all cubes."""

    repeats, period = None, 0.0

    def __init__(self, cubes: int, zz: float = 0.0) -> None:
        self.stress = np.zeros((cubes, 6))
        self.stress[:, 2] = zz

    def compute_stress_field(self, seconds: float):
        return self.stress, np.zeros((len(self.stress), 6, 3))


CORNERS = [(0, 0), (np.pi, 0), (np.pi / 2, 0), (-np.pi / 2, 0), (0, np.pi / 2), (0, -np.pi / 2)]
"""Roll and pitch with which each axis points up and down."""
SHAKE_M = 2 * G / (2 * np.pi * 5) ** 2
"""Amplitude of a motion at 5 Hz with 2 g, in m."""


def test_a_simulated_arm_yields_the_response_by_finite_elements(tmp_path):
    """Through pads, noise and counter: what is fitted to six poses takes the weight off an arm that
    turns and is shaken with 2 g at 5 Hz under a load."""
    shared = {"link": "hub0", "layout": "planar", "calibration": "planar"}
    cubes = []
    for k in range(2):
        pose = {"xyz": [0.0, 0.1 * k, 0.0], "rpy": [0.0, 0.0, 0.0]}
        cubes.append({"name": f"c{k}", "index": k, "pose": pose, **shared})
    data = {"name": "skin", "links": [{"name": "hub0", "port": "/dev/none"}], "cubes": cubes}
    write_yaml(tmp_path / "skin.yaml", data | {"parent_frame": "base"})
    skin, calibration = (
        read_skin(tmp_path / "skin.yaml"),
        find_shipped_calibration(LAYOUTS["planar"]),
    )
    noise = dict(noise=8e-6, rate=25.0)
    still = [(5.0 * k + t, 0, 0, 0, *c, 0) for k, c in enumerate(CORNERS) for t in (0.0, 4.0)]
    arm = Imperfections(poses=tuple(still), weight="planar_slab")
    with simulate(skin, Pressed(2), duration=30.0, imperfections=arm, **noise) as source:
        bag = write_bag(tmp_path / "bag", skin, source)
    model = fit_weight(bag).calibration.weight
    truth = read_weight("planar_slab", 8)
    ratio = (model.response - truth) / model.deviation
    assert 0.3 < np.sqrt((ratio**2).mean()) < 1.7  # 24 numbers

    knots = [(0.1 * k, SHAKE_M * (-1) ** k, 0, 0, 0.3 * k, 0.2 * k, 0) for k in range(101)]
    shaken = Imperfections(poses=tuple(knots), weight="planar_slab")
    heavy, plain = (Reconstructor([replace(calibration, weight=one)] * 2) for one in (model, None))
    errors = []
    pressed = Pressed(2, -5e3)
    with simulate(skin, pressed, duration=10.0, imperfections=shaken, **noise) as source:
        for rows in source:
            found, uncorrected = heavy(rows), plain(rows)
            errors.append([one.stress[:, 2] + 5e3 for one in (found, uncorrected)])
            assert (found.status & (WEIGHT | COMPENSATION) == WEIGHT).all()
    left, weight = np.sqrt((np.array(errors) ** 2).mean(axis=(0, 2)))
    # Measured: 1.4 of 121 Pa.
    assert left < 5 and weight > 80
