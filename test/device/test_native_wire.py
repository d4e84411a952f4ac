# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""native/cube_wire.c and the Python codec agree on every byte, counter and frame, whatever comes
and wherever it is cut. The C side runs under the address and undefined-behaviour sanitizers."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sysconfig
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from test_protocol import BAD, FRAMES, cobs_of, dump, wire

from conftest import ROOT
from cube_tensor_driver.device.wire.decoder import MAX_RUN, Counters, PythonDecoder
from cube_tensor_driver.device.wire.protocol import Ack, Hello, Request, Sample, Stats, Time, encode

NATIVE = ROOT / "native"
STRICT = ["-std=c11", "-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wshadow", "-Werror"]
SANITIZED = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
GAP = 8
COUNTERS = struct.Struct("<8Qq")
NAMES = ("bytes", "frames", "crc", "framing", "length", "version", "unknown_type", "overrun")

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: apt install gcc")


class Frame(NamedTuple):
    """A frame as C sees it: decoded, and built again from its fields."""

    raw: bytes
    wire: bytes


class Wire:
    """The process of wire_process.c."""

    def __init__(self, program: Path) -> None:
        pipe = subprocess.PIPE
        self._process = subprocess.Popen([program], stdin=pipe, stdout=pipe, stderr=pipe)

    def close(self) -> str:
        """What it wrote to standard error."""
        _, errors = self._process.communicate(timeout=10)
        return errors.decode()

    def new(self, capacity: int = MAX_RUN + GAP) -> bool:
        """Whether a buffer of this size is large enough."""
        self._send(b"N", capacity)
        return self._take(1) == b"\1"

    def decode(self, data: bytes) -> list[Frame]:
        self._send(b"D", len(data), data)
        frames = []
        while self._take(1) == b"F":
            frames.append(Frame(self._block(), self._block()))
        self._read_counters()
        return frames

    def reset(self) -> None:
        self._send(b"R", 0)
        self._take(1)
        self._read_counters()

    def encode(self, data: bytes) -> tuple[bytes, int]:
        """COBS and CRC-32."""
        self._send(b"E", len(data), data)
        return self._block(), int.from_bytes(self._take(4), "little")

    def _read_counters(self) -> None:
        *counters, other = COUNTERS.unpack(self._take(COUNTERS.size))
        self.counters = Counters(**dict(zip(NAMES, counters, strict=True)))
        self.other_version = None if other < 0 else other

    def _send(self, command: bytes, size: int, data: bytes = b"") -> None:
        try:
            self._process.stdin.write(command + size.to_bytes(4, "little") + data)
            self._process.stdin.flush()
        except BrokenPipeError:
            pytest.fail(self.close())

    def _block(self) -> bytes:
        return self._take(int.from_bytes(self._take(4), "little"))

    def _take(self, size: int) -> bytes:
        data = self._process.stdout.read(size)
        if len(data) < size:
            pytest.fail(self.close())
        return data


@pytest.fixture(scope="module")
def c(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Wire]:
    program = tmp_path_factory.mktemp("native") / "wire_process"
    sources = [NATIVE / "cube_wire.c", ROOT / "test" / "wire_process.c"]
    command = ["cc", *STRICT, *SANITIZED, f"-I{NATIVE}", *sources, "-o", program]
    subprocess.run(command, check=True, timeout=60)
    process = Wire(program)
    yield process
    assert process.close() == ""


@pytest.mark.parametrize("options", [["-O2"], ["-Os", "-DCUBE_WIRE_SMALL"]], ids=["fast", "small"])
def test_it_compiles_without_a_warning_and_without_a_library(options: list[str], tmp_path) -> None:
    compiled = tmp_path / "wire.o"
    source = NATIVE / "cube_wire.c"
    subprocess.run(["cc", *STRICT, *options, "-c", source, "-o", compiled], check=True, timeout=60)
    undefined = subprocess.run(["nm", "-u", compiled], check=True, capture_output=True, text=True)
    names = {line.split()[-1] for line in undefined.stdout.splitlines()}
    assert names <= {"memcpy", "memset", "memchr", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}


PYTHON_H = Path(sysconfig.get_paths()["include"])


@pytest.mark.skipif(not (PYTHON_H / "Python.h").is_file(), reason="no headers: python3-dev")
def test_the_python_module_compiles_without_a_warning() -> None:
    # Without -Wpedantic: Python's slots hold functions as pointers to data.
    strict = [option for option in STRICT if option != "-Wpedantic"]
    for options, name in ((STRICT, "cube_track.c"), (strict, "python_wire.c")):
        command = ["cc", *options, "-fsyntax-only", "-isystem", PYTHON_H, NATIVE / name]
        subprocess.run(command, check=True, timeout=60)


@pytest.mark.parametrize("name", list(FRAMES))
def test_it_builds_and_decodes_the_dumps_of_the_page(name: str, c: Wire) -> None:
    assert c.new()
    (frame,) = c.decode(dump("wire", name))
    assert frame == (dump("frame", name), dump("wire", name))


@pytest.mark.parametrize("name", list(BAD))
def test_bad_runs_are_counted_as_python_counts_them(name: str, c: Wire) -> None:
    data, counter = BAD[name]
    assert c.new()
    assert c.decode(data) == []
    assert getattr(c.counters, counter) == 1
    assert sum(getattr(c.counters, other) for other in NAMES[1:]) == 1


U8, U16, U32, U64 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64))


@st.composite
def samples(draw: st.DrawFn) -> Sample:
    random = np.random.default_rng(draw(U32))
    n, pads = draw(st.integers(0, 12)), draw(st.integers(0, 12))
    density = draw(st.sampled_from([1, 0.2]))  # few zero bytes, or many
    frequency = random.integers(0, 2**32, (n, pads)) * (random.random((n, pads)) < density)
    fault, temperature = random.integers(0, 2**32, n), random.integers(-(2**15), 2**15, n)
    return Sample(
        draw(U32),
        draw(U16),
        draw(U64),
        frequency.astype("<u4"),
        fault.astype("<u4"),
        temperature.astype("<i2"),
    )


uids = st.lists(U64, max_size=40).map(lambda values: np.array(values, "<u8"))
frames = st.one_of(
    samples(),
    st.builds(Hello, U64, U32, U8, U32, uids, U8),
    st.builds(Stats, U64, U32, U32, U16),
    st.builds(Time, U32, U64),
    st.builds(Request, U8, U32),
    st.builds(Ack, U8, U8, U32),
)


@st.composite
def harmed(draw: st.DrawFn) -> bytes:
    data = bytearray(encode(draw(frames)))
    for _ in range(draw(st.integers(1, 3))):
        data[draw(st.integers(0, len(data) - 1))] = draw(U8)
    return bytes(data)


@st.composite
def sound_but_wrong(draw: st.DrawFn) -> bytes:
    """A right checksum around anything."""
    payload = draw(st.binary(max_size=60))
    says = draw(st.one_of(st.just(len(payload)), st.integers(0, 70)))
    kind = draw(st.sampled_from([0, 1, 2, 3, 4, 5, 0x0F, 0x10, 0x11, 0x12, 255]))
    version = draw(st.sampled_from([1, 1, 1, 0, 2, 255]))
    return wire(bytes([kind, version]) + says.to_bytes(2, "little") + payload)


long_runs = st.integers(MAX_RUN - 2, MAX_RUN + 3).map(lambda n: b"\1" * n + b"\0")
pieces = st.one_of(
    frames.map(encode),
    harmed(),
    sound_but_wrong(),
    st.binary(max_size=600),
    st.lists(st.integers(0, 1), max_size=100).map(bytes),
    st.lists(st.integers(1, 18), min_size=14, max_size=18).map(lambda run: bytes(run) + b"\0"),
    st.lists(st.integers(1, 255), min_size=240, max_size=520).map(bytes),
    long_runs,
)
thorough = settings(
    max_examples=200,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@thorough
@given(parts=st.lists(pieces, max_size=12), cuts=st.lists(U16, max_size=12), ends=st.booleans())
def test_c_and_python_agree(c: Wire, parts: list[bytes], cuts: list[int], ends: bool) -> None:
    data = b"".join(parts)
    python = PythonDecoder()
    c.new()
    at = 0
    for cut in [*sorted(cut % (len(data) + 1) for cut in cuts), len(data)]:
        expected = [encode(frame) for frame in python.feed(data[at:cut])]
        found = c.decode(data[at:cut])
        assert [frame.wire for frame in found] == expected
        assert c.counters == python.counters
        at = cut
    if ends:
        python.reset()
        c.reset()
    assert (c.counters, c.other_version) == (python.counters, python.other_version)


@thorough
@given(data=st.one_of(st.binary(max_size=700), st.lists(st.integers(0, 1)).map(bytes)))
@example(data=b"\1" * 253)
@example(data=b"\1" * 254)
@example(data=b"\1" * 254 + b"\0")
@example(data=b"\1" * 255)
@example(data=b"")
def test_cobs_and_crc_agree_with_other_programs(c: Wire, data: bytes) -> None:
    """With the algorithm of the paper, and with zlib."""
    assert c.encode(data) == (cobs_of(data), zlib.crc32(data))


@pytest.mark.parametrize("capacity", [0, 21, 22, 23, 60])
def test_a_hub_needs_little_memory(capacity: int, c: Wire) -> None:
    """A run that is too long for the buffer is thrown away; the next one comes through."""
    request, stats = encode(Request(4, 0x01010101)), encode(Stats(1, 2, 3))
    assert c.new(capacity) == (len(request) - 2 + GAP <= capacity)
    if capacity < 22:
        return
    for step in (1, 100):
        data = stats * 2 + request
        found = [f.wire for at in range(0, len(data), step) for f in c.decode(data[at : at + step])]
        assert found == ([*[stats] * 2, request] if capacity == 60 else [request])
    assert c.counters.frames + c.counters.overrun == 6
