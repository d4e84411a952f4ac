# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The hub in C: as a process of this machine, and on an emulated microcontroller."""

from __future__ import annotations

import contextlib
import ctypes
import json
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import ROOT, decoded, end
from cube_tensor_driver.cli.main import main
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.config.skin import Skin, read_skin
from cube_tensor_driver.core.estimator import make_estimator
from cube_tensor_driver.core.rows import concatenate
from cube_tensor_driver.core.status import STAMP
from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import Command, Request, Sample, Stats, Time, encode
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import list_skin_processes
from cube_tensor_driver.simulation.cubes import compute_skin_components, make_hub_cubes
from cube_tensor_driver.simulation.load import Load, read_default_script
from cube_tensor_hub.captures import COUNTER_HZ, WINDOW_US, Oscillators, find_edges
from cube_tensor_hub.check import Checked, check
from cube_tensor_hub.firmware import Emulator, FirmwareError, build, find_missing, need
from cube_tensor_hub.port_wire import PortWire
from cube_tensor_hub.rule import Outcome
from cube_tensor_hub.transcript import FrameListener

SOURCE = ROOT / "firmware"
SKIN = find_package_data() / "config" / "skin_firmware.yaml"
OF_PERIODS = {"H1", "R3", "R6", "R7"}
NO_CC, NO_ARM = (
    find_missing("make", "cc"),
    find_missing("make", "arm-none-eabi-gcc", "qemu-system-arm"),
)

pytestmark = pytest.mark.skipif(bool(NO_CC), reason=NO_CC)
emulated = pytest.mark.skipif(bool(NO_ARM), reason=NO_ARM)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with cube_hub under sanitizers, and hub.elf where there is a cross compiler."""
    folder = tmp_path_factory.mktemp("firmware")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CFLAGS", "-fsanitize=address,undefined -fno-sanitize-recover=all")
        build(SOURCE, folder, "posix")
    if not NO_ARM:
        build(SOURCE, folder, "an386")
    return folder


class Capture(ctypes.Structure):
    _fields_ = (
        ("first", ctypes.c_uint32),
        ("last", ctypes.c_uint32),
        ("periods", ctypes.c_uint32),
    )


@pytest.fixture(scope="module")
def hub_frequency(tmp_path_factory: pytest.TempPathFactory):
    """The function of hub.c: captures and counter frequency to mHz."""
    library = tmp_path_factory.mktemp("library") / "hub.so"
    sources = [SOURCE / "hub.c", SOURCE / "posix" / "line.c", ROOT / "native" / "cube_wire.c"]
    includes = [f"-I{SOURCE}", f"-I{ROOT / 'native'}"]
    command = ["cc", "-std=c11", "-O1", "-shared", "-fPIC", *includes, *sources, "-o", library]
    subprocess.run(command, check=True, timeout=60)
    function = ctypes.CDLL(str(library)).hub_frequency
    function.restype = ctypes.c_uint32
    return lambda first, last, periods, hertz: function(
        ctypes.byref(Capture(first, last, periods)), ctypes.c_uint32(hertz)
    )


@settings(max_examples=300)
@given(
    hertz=st.integers(10_000, 4_000_000),
    phase=st.fractions(0, Fraction(999_999, 1_000_000)),
    counter=st.sampled_from([16_000_000, 25_000_000, 84_000_000, 125_000_000]),
    begin=st.integers(0, 2**32 - 1),
)
def test_reciprocal_counting_resolves_one_tick(hub_frequency, hertz, phase, counter, begin):
    """Against edges of an oscillator in exact fractions, wherever the counter wraps: right to one
    tick, and rounded to the nearest mHz of what was counted."""
    period = Fraction(counter, hertz)
    window = Fraction(counter, 400)
    n = int(window / period - phase)
    first, last = (int(begin + (phase + k) * period) for k in (0, n))
    found = hub_frequency(first % 2**32, last % 2**32, n, counter)
    if n == 0:
        assert found == 0
    else:
        # 1/2 mHz of rounding
        assert abs(found - 1000 * hertz) <= Fraction(1000 * found, last - first) + Fraction(1, 2)
        assert abs(found - Fraction(1000 * n * counter, last - first)) <= Fraction(1, 2)


def test_a_pad_that_stands_still_or_is_too_fast_is_not_measured(hub_frequency):
    assert hub_frequency(5, 5, 0, 10**6) == 0
    assert hub_frequency(5, 5, 7, 10**6) == 0
    assert hub_frequency(0, 1, 5, 10**6) == 0


def test_a_ring_needs_no_lock(tmp_path):
    """Between two threads, under the thread sanitizer."""
    program = tmp_path / "ring"
    source = ROOT / "test" / "ring_process.c"
    options = ["-std=c11", "-O2", "-fsanitize=thread", "-pthread", f"-I{SOURCE}"]
    subprocess.run(["cc", *options, source, "-o", program], check=True, timeout=60)
    done = subprocess.run([program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_captures_are_those_of_the_oscillators():
    """To the tick; a pad without two edges in the window has none."""
    millihertz = np.array([100_000_000, 0, 399_000, 3_000_000_000], np.uint32)
    found = find_edges(millihertz, np.array([0.25, 0.5, 0.5, 0.0]))
    ticks = [COUNTER_HZ * 1e3 / f for f in (1e8, 3e9)]
    assert found["periods"].tolist() == [249, 0, 0, 7499]
    assert found["first"].tolist() == [int(0.25 * ticks[0]), 0, 0, 0]
    assert found["last"].tolist() == [int(249.25 * ticks[0]), 0, 0, int(7499 * ticks[1])]
    assert (found["last"] < COUNTER_HZ * WINDOW_US // 10**6).all()


@contextlib.contextmanager
def cube_hub(program: Path, *options: str) -> Iterator[str]:
    """The port of a hub as a process."""
    process = subprocess.Popen([program, *options], stdout=subprocess.PIPE, text=True)
    try:
        yield process.stdout.readline().strip()
    finally:
        end(process)
        process.stdout.close()
    assert process.returncode == 0


@contextlib.contextmanager
def simulated_hub(folder: Path) -> Iterator[str]:
    """The port of a hub of the simulator."""
    module = "cube_tensor_driver.simulation.main"
    command = [sys.executable, "-m", module, "--config", str(SKIN), "--ports", str(folder)]
    command += ["--instants", "50"]  # else the load takes more time than a busy machine has
    process = subprocess.Popen(command)
    try:
        until = threading.Event()
        while not (folder / "hub0").is_symlink():
            assert process.poll() is None
            until.wait(0.02)
        yield str(folder / "hub0")
    finally:
        end(process)


@contextlib.contextmanager
def emulated_hub(image: Path, skin: Skin) -> Iterator[tuple[str, Oscillators]]:
    """The port of an emulated hub, and its pads under a load."""
    (hub,) = make_hub_cubes(skin)
    pads = Oscillators(hub, Load(skin, read_default_script()))
    with Emulator(image) as emulator:
        server = threading.Thread(target=pads.serve, args=(emulator.pads,))
        server.start()
        yield emulator.port, pads
    server.join()


@pytest.mark.parametrize("seed", range(3))
def test_noise_does_no_harm(out, tmp_path, seed):
    """Of all kinds: with few zeros and many, and with frames in it. The sanitizers look on."""
    random = np.random.default_rng(seed)
    noise = random.integers(0, 256, 60_000).astype(np.uint8)
    noise[random.random(len(noise)) < (0.001, 0.05, 0.5)[seed]] = 0
    with (
        cube_hub(out / "cube_hub", "--ports", str(tmp_path)) as port,
        PortWire(port, 921_600) as wire,
    ):
        for part in np.split(noise, 60):
            wire.send(part.tobytes() + b"\0" + encode(Request(Command.START)))
            wire.listen(1.0)
        wire.send(b"\0" + encode(Request(Command.TIME, 77)))
        decoder = Decoder()
        frames = [frame for _ in range(100) for frame in decoder.feed(wire.listen(0.05))]
        assert 77 in [frame.number for frame in frames if isinstance(frame, Time)]


def test_a_sample_goes_out_when_it_is_taken(out, tmp_path):
    """Not with the next one, a period later: by the clock of TIME."""
    period_s = 0.4
    with (
        cube_hub(out / "cube_hub", "--ports", str(tmp_path)) as port,
        PortWire(port, 921_600) as wire,
    ):
        ear = FrameListener()
        wire.send(encode(Request(Command.SET_PERIOD, round(1e6 * period_s))))
        wire.send(encode(Request(Command.START)) + encode(Request(Command.TIME)))
        heard = [one for _ in range(30) for one in ear.hear(wire.listen(0.05), wire.now())]
    offset_s = [one.at_s - 1e-6 * one.frame.device_us for one in heard if type(one.frame) is Time]
    came_s = [one.at_s - 1e-6 * one.frame.device_us for one in heard if type(one.frame) is Sample]
    assert len(came_s) >= 2 and max(came_s) - offset_s[0] < 0.7 * period_s


def test_a_step_names_the_package_that_it_needs(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FirmwareError, match=r"needs arm-none-eabi-gcc: apt-get install .*newlib"):
        need("the build", "arm-none-eabi-gcc")
    with pytest.raises(FirmwareError, match=r"apt-get install .* qemu-system-arm"):
        Emulator(tmp_path / "hub.elf")
    with pytest.raises(FirmwareError, match=r"needs make, cc: apt-get install .* make gcc"):
        build(SOURCE, tmp_path, "posix")


def checked_by_command(port: str) -> None:
    """As `./cube check`, which says the same in a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "check.json"
        code = main(["check", port, "--json", str(path)])
        result = json.loads(path.read_text())
    outcomes = [rule["outcome"] for rule in result["rules"]]
    assert (code, result["failed"]) == (0, 0) and outcomes.count("passed") == result["passed"] > 25


def checked(port: str) -> Checked:
    with PortWire(port, 921_600) as wire:
        return check(wire)


def free_tcp_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def wait_for_power_up(port: str) -> None:
    """Until the first STATS, of 1 s. QEMU takes a connection before it runs, and then loses the
    HELLO of power-up."""
    ear = FrameListener()
    with PortWire(port, 921_600) as wire:
        until_s = wire.now() + 30.0
        while not any(isinstance(one.frame, Stats) for one in ear.hear(wire.listen(1.0), 0.0)):
            assert wire.now() < until_s


def test_hubs_keep_every_rule_on_real_lines(out, tmp_path):
    """Checked at once, because a check mostly waits."""
    with contextlib.ExitStack() as stack:
        split = ("--cubes", "5", "--cubes-per-frame", "2")
        ports = {
            "terminal": stack.enter_context(
                cube_hub(out / "cube_hub", "--ports", str(tmp_path), *split)
            ),
            "simulator": stack.enter_context(simulated_hub(tmp_path / "ports")),
        }
        if not NO_ARM:
            ports["emulator"], _ = stack.enter_context(
                emulated_hub(out / "hub.elf", read_skin(SKIN))
            )
            wait_for_power_up(ports["emulator"])
        by_command = stack.enter_context(cube_hub(out / "cube_hub", "--tcp", str(free_tcp_port())))
        with ThreadPoolExecutor(len(ports) + 1) as pool:
            command = pool.submit(checked_by_command, by_command)
            results = dict(zip(ports, pool.map(checked, ports.values()), strict=True))
            command.result()
            # A busy machine starves hubs, an emulated one first: then once more.
            late = [name for name in ports if set(results[name].list_failed()) & OF_PERIODS]
            results |= zip(late, pool.map(checked, [ports[name] for name in late]), strict=True)
    assert {name: result.list_failed() for name, result in results.items()} == {
        name: [] for name in ports
    }
    assert results["terminal"].results["S3"].outcome is Outcome.PASSED
    assert results["terminal"].results["S9"].outcome is Outcome.PASSED
    assert results["simulator"].results["S9"].outcome is Outcome.PASSED


@emulated
def test_the_load_on_the_pads_comes_out_as_tensors(out, ros, tmp_path):
    """Load, captures, firmware on an emulated Cortex-M4, UART, driver, DDS: right to the resolution
    of the counter."""
    from cube_tensor_driver.msg import SkinStress

    skin = read_skin(SKIN)
    messages = ros.listen(SkinStress, "stress")
    with emulated_hub(out / "hub.elf", skin) as (port, pads), Children(tmp_path) as children:
        for process in list_skin_processes(SKIN, port=port, composed=True):
            children.start(process)
        ros.wait(lambda: len(messages) > 100)
        children.check()
    rows = concatenate([decoded(message).rows for message in messages])
    load, bound = Load(skin, read_default_script()), resolution(skin)
    middles = np.array(pads.windows)[rows.sequence]
    truth = np.array(
        [
            compute_skin_components(skin, *load.compute_stress_field(1e-6 * middle))[cube]
            for middle, cube in zip(middles.tolist(), rows.cube.tolist(), strict=True)
        ]
    )
    error = np.abs(np.hstack((rows.stress, rows.gradient)) - truth)
    seen = np.isfinite(error)
    # A busy machine holds the emulator up, and then stamps are in doubt.
    assert np.isin(rows.status, (0, STAMP)).all() and (seen.sum(axis=1) >= 6).all()
    assert (error[seen] <= bound[rows.cube][seen]).all()
    # and the load is far above that
    assert np.abs(truth[:, 2]).max() > 100 * bound[0, 2]


def resolution(skin: Skin) -> np.ndarray:
    """(cubes, 15) error of each component, Pa and Pa/m, if all pads are wrong by one tick between
    their first and last edge, in the worst directions."""
    ticks = COUNTER_HZ * WINDOW_US * 1e-6
    bounds = []
    for calibration in (cube.calibration for cube in skin.cubes):
        rest = calibration.rest_frequency
        stiffness = calibration.modulus * (1 + calibration.beta)
        # Less than two periods are missing at the ends; 1 % for slope and frequency under load.
        relative = 1.01 / (ticks - 2 * COUNTER_HZ / rest) + 1e-7
        matrix = make_estimator(calibration.response, calibration.noise, calibration.modes).matrix
        scale = calibration.component_scale
        bounds.append(scale * (np.abs(matrix) @ (stiffness * relative)))
    return np.array(bounds)
