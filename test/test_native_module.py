"""The Python module of the wire in C gives what the Python code gives, bit by bit."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_device_protocol import cobs_of
from test_native_wire import pieces

from conftest import ROOT
from cube_tensor_driver.device import cobs, native
from cube_tensor_driver.device.decoder import NativeDecoder, PythonDecoder
from cube_tensor_driver.device.protocol import encode

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


@needs_the_module
def test_decoders_end_without_a_leak() -> None:
    """Each has a buffer of 66 kB."""
    script = """
import resource
from cube_tensor_driver.device.decoder import NativeDecoder
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
from cube_tensor_driver.device import cobs, native
from cube_tensor_driver.device.decoder import Decoder, PythonDecoder
from cube_tensor_driver.device.protocol import Stats, encode
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
