"""The Python module of the wire in C gives what the Python code gives, bit by bit."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_native_wire import pieces
from test_protocol import cobs_of

from conftest import ROOT
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.device.scans import scan
from cube_tensor_driver.device.scans.cube_table import CubeAddress
from cube_tensor_driver.device.scans.scan import ScanBuilder
from cube_tensor_driver.device.wire import cobs, native
from cube_tensor_driver.device.wire.decoder import NativeDecoder, PythonDecoder
from cube_tensor_driver.device.wire.protocol import (
    TEMPERATURE_UNKNOWN,
    Hello,
    Sample,
    Stats,
    encode,
)

needs_the_module = pytest.mark.skipif(native.wire is None, reason="was not compiled")


@needs_the_module
@settings(max_examples=100, deadline=None)
@given(parts=st.lists(pieces, max_size=8), cuts=st.lists(st.integers(0, 2**16), max_size=8))
def test_both_decoders_give_the_same(parts: list[bytes], cuts: list[int]) -> None:
    data = b"".join(parts)
    python, c = PythonDecoder(), NativeDecoder()
    at = 0
    for cut in [*sorted(cut % (len(data) + 1) for cut in cuts), len(data)]:
        found = [encode(frame) for frame in c.feed(data[at:cut])]
        assert found == [encode(frame) for frame in python.feed(data[at:cut])]
        at = cut
    python.reset()
    c.reset()
    assert c.counters == python.counters
    assert c.other_version == python.other_version


@needs_the_module
@settings(max_examples=100, deadline=None)
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
            builder.add(link, [sample], [1_700_000_000_000_000_000 + link])
        built.append(builder.build())
    for field in fields(FrequencyRows):
        c, python = (getattr(rows, field.name) for rows in built)
        assert c.dtype == python.dtype
        np.testing.assert_array_equal(c.view(np.uint8), python.view(np.uint8), field.name)


@needs_the_module
def test_rows_are_made_of_samples_only() -> None:
    sample = random_sample(np.random.default_rng(1), 2, 3)
    memory = bytearray(2 * (20 + 4 * 3))

    def place(raws: list[bytes], stamps: list[int], n_pads: int) -> None:
        native.wire.place_rows(raws, stamps, n_pads, memory)

    place([sample.raw], [1], 3)
    with pytest.raises(ValueError, match="size of the rows"):
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
    os.set_blocking(near, False)
    decoder, other, stats = native.wire.Decoder(), native.wire.Decoder(), encode(Stats(1, 2, 3))
    read = native.wire.read_links
    assert read([(decoder, near)], lambda: 5) == (5, [(-errno.EAGAIN, [])])
    os.write(far, stats + stats[:9])
    _, [(size, frames), (failed, none)] = read([(decoder, near), (other, -1)], lambda: 5)
    assert (size, len(frames)) == (len(stats) + 9, 1)
    assert (failed, none) == (-errno.EBADF, [])
    with pytest.raises(RuntimeError, match="has this decoder"):
        read([(decoder, near), (decoder, near)], lambda: 5)
    with pytest.raises(ZeroDivisionError):
        read([(decoder, near)], lambda: 1 // 0)
    for wrong in ([1], [(decoder,)], [(decoder, "x")], [("x", near)]):
        with pytest.raises(TypeError):
            read(wrong, lambda: 5)
    os.write(far, stats[9:])
    os.close(far)
    assert [len(frames) for _, frames in read([(decoder, near)], lambda: 5)[1]] == [1]
    assert read([(decoder, near)], lambda: 5) == (5, [(0, [])])
    assert decoder.counters()[:2] == (2 * len(stats), 2)
    os.close(near)


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
