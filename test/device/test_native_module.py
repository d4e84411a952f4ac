# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The Python module of the wire in C gives what the Python code gives, bit by bit."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import sysconfig
import threading
from ctypes import addressof

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_protocol import cobs_of

from conftest import ROOT
from cube_tensor_driver.device.clock.hub_clock import HubClock
from cube_tensor_driver.device.scans import scan
from cube_tensor_driver.device.scans.cube_table import CubeAddress
from cube_tensor_driver.device.scans.scan import ScanBuilder
from cube_tensor_driver.device.scans.sequence import Arrival, SampleAccount
from cube_tensor_driver.device.track import LinkTrack
from cube_tensor_driver.device.wire import cobs, native
from cube_tensor_driver.device.wire.decoder import PythonDecoder
from cube_tensor_driver.device.wire.protocol import (
    TEMPERATURE_UNKNOWN,
    Hello,
    Sample,
    Stats,
    encode,
)

needs_the_module = pytest.mark.skipif(native.wire is None, reason="was not compiled")


@needs_the_module
@settings(max_examples=100)
@given(st.one_of(st.binary(max_size=600), st.lists(st.integers(0, 2)).map(bytes)))
def test_cobs_is_the_same(data: bytes) -> None:
    """As the algorithm of the paper, there and back; and of bytes that are no code."""
    for encoded, decode in (
        (cobs.encode_in_python(data), cobs.decode_in_python),
        (native.wire.cobs_encode(data), native.wire.cobs_decode),
    ):
        assert encoded == cobs_of(data)
        assert decode(encoded) == data
    assert cobs.decode_in_python(data) == native.wire.cobs_decode(data)


@needs_the_module
@pytest.mark.parametrize("not_bytes", ["text", 3, None, np.zeros(3)])
def test_what_is_no_bytes_is_refused(not_bytes: object) -> None:
    decoder = native.wire.Decoder()
    for function in (decoder.feed, native.wire.cobs_encode, native.wire.cobs_decode):
        with pytest.raises(TypeError):
            function(not_bytes)
    assert decoder.counters() == (0,) * 8


def random_sample(random: np.random.Generator, n_cubes: int, n_pads: int) -> Sample:
    frequency = random.integers(0, 2**32, (n_cubes, n_pads)) * random.integers(0, 3, n_pads)
    temperature = random.integers(-(2**15), 2**15, n_cubes)
    temperature[::3] = TEMPERATURE_UNKNOWN
    sample = Sample(
        int(random.integers(2**32)),
        0,
        0,
        frequency.astype("<u4"),
        random.integers(0, 2**32, n_cubes).astype("<u4"),
        temperature.astype("<i2"),
    )
    (decoded,) = PythonDecoder().feed(encode(sample))
    return decoded


@needs_the_module
@pytest.mark.parametrize("pads", [(8, 8, 8), (3, 3, 8), (2, 5, 2)])
def test_rows_have_the_same_bits(pads: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of links with as many pads or with others, where pads were not measured as well."""
    random = np.random.default_rng(sum(pads))
    samples = [random_sample(random, n + 1, width) for n, width in enumerate(pads)]
    built = []
    for implementation in (native.wire, None):
        monkeypatch.setattr(scan, "wire", implementation)
        addresses = [
            CubeAddress(f"{link} {index}", link, index, None, width)
            for link, width in enumerate(pads)
            for index in range(link + 1)
        ]
        builder = ScanBuilder(len(pads), addresses)
        for link, sample in enumerate(samples):
            uids = np.arange(1, sample.n_cubes + 1, dtype="<u8") + 100 * link
            assert builder.cubes.learn(link, Hello(link, 0, sample.n_pads, 1, uids)) == []
            builder.add(link, sample, 1_700_000_000_000_000_000 + link)
        built.append(builder.build())
    for name, c in built[0].collect_columns().items():
        python = getattr(built[1], name)
        assert c.dtype == python.dtype
        np.testing.assert_array_equal(c.view(np.uint8), python.view(np.uint8), name)


@needs_the_module
def test_rows_are_made_of_samples_only() -> None:
    sample = random_sample(np.random.default_rng(1), 2, 3)
    rows = scan.make_empty_rows(2, 3)
    columns = rows.stamp_ns, rows.sequence, rows.pad_fault, rows.temperature, rows.frequency
    addresses = tuple(column.ctypes.data for column in columns)

    def place(raws: list[bytes], stamps: list[int], n_pads: int) -> None:
        native.wire.place_rows(raws, stamps, 2, n_pads, addresses)

    place([sample.raw], [1], 3)
    assert rows.stamp_ns.tolist() == [1, 1]
    with pytest.raises(ValueError, match="one row for each cube"):
        place([sample.raw] * 2, [1, 2], 3)
    (stats,) = native.wire.Decoder().feed(encode(Stats(1, 2, 3)))
    for raw in (b"", sample.raw[:-1], sample.raw + b"\0", stats, b"\2\1" + bytes(26)):
        with pytest.raises(ValueError, match="no SAMPLE"):
            place([sample.raw, raw], [1, 2], 3)
    with pytest.raises(ValueError, match="more pads"):
        place([sample.raw], [1], 2)
    with pytest.raises(ValueError, match="one stamp"):
        place([sample.raw], [], 3)
    for wrong in ([1.5], [None]):
        with pytest.raises(TypeError):
            place([sample.raw], wrong, 3)
    with pytest.raises(OverflowError):
        place([sample.raw], [2**63], 3)


@needs_the_module
def test_links_are_read_once_each_and_their_errors_told() -> None:
    near, far = os.pipe()
    wake, waker = os.pipe()
    os.set_blocking(near, False)
    decoder, other, stats = native.wire.Decoder(), native.wire.Decoder(), encode(Stats(1, 2, 3))
    track = LinkTrack()
    here = (decoder, near, addressof(track))

    def read(links: list, timeout_s: float = 0.0, clock=lambda: 5) -> tuple:
        return native.wire.read_links(links, wake, timeout_s, 0.0, len(links), clock)

    assert read([here]) == (False, [], [], [], [])
    os.write(far, stats + stats[:9])
    closed = (other, -1, addressof(LinkTrack()))
    is_late, *handled, [(index, arrival_ns, size, frames)] = read([closed, here])
    assert (is_late, handled) == (True, [[], [], []]), "data were there before the call"
    assert (index, arrival_ns, size, len(frames)) == (1, 5, len(stats) + 9, 1)
    with pytest.raises(RuntimeError, match="has this decoder"):
        read([here, here])
    os.write(far, stats[9:])
    with pytest.raises(ZeroDivisionError):
        read([here], clock=lambda: 1 // 0)
    for wrong in ([1], [(decoder, near)], [(decoder, "x", 0)], [("x", near, 0)]):
        with pytest.raises(TypeError):
            read(wrong)
    os.write(waker, b"x")
    assert read([here], timeout_s=60.0) == (True, [], [], [], [])
    os.write(far, stats)
    os.close(far)
    # A process that is behind reads all that is there, up to the end of the stream.
    (*_, frames), ended = read([here])[-1]
    assert len(frames) == 1 and ended == (0, 5, 0, [])
    for fd in (near, wake, waker):
        os.close(fd)


class UsualLink:
    """Account and clock of one link of a hub with two cubes of three pads."""

    def __init__(self) -> None:
        self.track = LinkTrack()
        self.account, self.clock = SampleAccount(self.track), HubClock(self.track)
        self.account.announce(2, 3)

    def handle(self, samples: list[Sample], arrival_ns: int, is_late: bool) -> list[int]:
        """Count and stamp samples in Python, as the chain does with those that are not usual."""
        for sample in samples:
            assert self.account.classify(sample) is Arrival.NEW
        numbers = [sample.sequence for sample in samples]
        times_us = [sample.device_us for sample in samples]
        stamps = self.clock.update(times_us, arrival_ns, numbers, is_late)
        self.track.is_native_allowed = self.account.has_whole_samples and self.clock.is_steady
        return stamps


def read_of_samples(random: np.random.Generator, number: int, step_us: int) -> list[Sample]:
    """One to three samples at 1 kHz behind a number, 0.5 % of them lost, with 30 µs of jitter."""
    samples = []
    for _ in range(int(random.integers(1, 4))):
        number += 1 if random.random() < 0.995 else 5
        sample = random_sample(random, 2, 3)
        sample.sequence = number % 2**32
        sample.device_us = 1000 * number + step_us + int(random.integers(0, 30))
        samples.append(sample)
    return samples


@needs_the_module
@pytest.mark.parametrize("seed", range(2))
def test_usual_samples_have_the_same_stamps_and_counters_in_c(seed: int) -> None:
    """Over the wrap of numbers; with delays, answers to TIME, and a clock that is set. What is not
    usual is handled in Python, and then C continues."""
    random = np.random.default_rng(seed)
    here, there = UsualLink(), UsualLink()
    near, far = os.pipe()
    wake, waker = os.pipe()
    decoder = native.wire.Decoder()
    number, step_us, arrival_ns, n_native, n_late = 2**32 - 1000, 0, 0, 0, 0
    for turn in range(2000):
        step_us += 20_000 if turn % 800 == 600 else 0
        samples = read_of_samples(random, number, step_us)
        for sample in samples:
            number += (sample.sequence - number) % 2**32
        sampled_ns = 1_000_000 * number
        arrival_ns = max(arrival_ns, sampled_ns + 2_200_000 + int(random.exponential(3e5)))
        data = b"".join(map(encode, samples))
        # Data that come during the wait show that this process is in time.
        timer = threading.Timer(2e-4 if turn % 5 else 0, os.write, (far, data))
        timer.start()
        is_late, _, _, stamps, events = native.wire.read_links(
            [(decoder, near, addressof(here.track))], wake, 60.0, 0.0, 1, lambda now=arrival_ns: now
        )
        timer.join()
        n_native += len(stamps)
        n_late += is_late
        if events:
            stamps = here.handle(samples, arrival_ns, is_late)
        assert stamps == there.handle(samples, arrival_ns, is_late)
        if turn % 800 == 300:
            # The answer shows that stamps are 2 ms late. Corrected ones must not go back.
            device_us = arrival_ns // 1000 + step_us + 50
            for link in (here, there):
                link.clock.add_answer(arrival_ns, device_us, arrival_ns + 100_000)
        assert here.account.count_samples() == there.account.count_samples()
        for name in LinkTrack.__annotations__:
            if name not in ("is_native_allowed", "n_native", "seen"):
                assert getattr(here.track, name) == getattr(there.track, name), name
    assert sorted(map(tuple, here.track.seen)) == sorted(map(tuple, there.track.seen))
    assert n_native > 2000 > n_late
    assert here.clock.resets == there.clock.resets == 2
    for fd in (near, far, wake, waker):
        os.close(fd)


@needs_the_module
def test_decoders_end_without_a_leak() -> None:
    """Each has a buffer of 66 kB."""
    script = """
import resource
from cube_tensor_driver.device.wire.decoder import NativeDecoder
def peak(count):
    for _ in range(count):
        NativeDecoder().feed(bytes(70_000) + b"abc")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before = peak(100)
print(peak(1000) - before)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert int(done.stdout) < 10_000


def test_without_the_module_all_works_in_python() -> None:
    script = """
import sys
sys.modules["cube_tensor_driver._wire"] = None
from cube_tensor_driver.device.wire import cobs, native
from cube_tensor_driver.device.wire.decoder import Decoder, PythonDecoder
from cube_tensor_driver.device.wire.protocol import Stats, encode
assert native.wire is None and Decoder is PythonDecoder
assert cobs.encode is cobs.encode_in_python
print(Decoder().feed(encode(Stats(1, 2, 3))))
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env=os.environ,
    )
    assert done.stdout == "[Stats(uptime_ms=1, taken=2, dropped=3, supply_mv=0)]\n"


def test_a_free_threaded_python_is_told_why_the_wire_is_slow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Such a Python does not look for modules of the stable ABI."""
    assert "install a compiler" in native.NOT_COMPILED
    spec = importlib.util.find_spec(native.__name__)
    assert spec is not None and spec.loader is not None
    with monkeypatch.context() as patch:
        patch.setattr(sysconfig, "get_config_var", {"Py_GIL_DISABLED": 1}.get)
        again = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(again)
    assert "free-threaded" in again.NOT_COMPILED and "\n" not in again.NOT_COMPILED
