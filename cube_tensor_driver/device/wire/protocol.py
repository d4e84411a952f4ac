"""Wire protocol, version 1: the frames and their bytes, without any I/O.

A frame is ``type:u8 version:u8 length:u16 payload crc:u32``, little-endian. `length` is that of the
payload, `crc` the CRC-32 of IEEE 802.3 of all bytes before it. On the wire a frame is COBS-encoded,
between two zero bytes. docs/protocol.md has the fields and an annotated hex dump of each frame
type. The driver and the simulated hubs share this file.

`encode` makes bytes of a frame, or raises `ProtocolError`. Arrays must have the dtype that the
frame's docstring names; nothing is converted. decoder.py makes frames of bytes. The arrays of
decoded frames are read-only, and made when they are first asked for.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.errors import ProtocolError
from . import cobs

VERSION = 1
MAX_PAYLOAD = 0xFFFF
MAX_FRAME = 4 + MAX_PAYLOAD + 4

TEMPERATURE_UNKNOWN = -32768
NOT_MEASURED = 0

HEADER = struct.Struct("<BBH")
_HELLO = struct.Struct("<QIHBBI")
_SAMPLE = struct.Struct("<IHHQB3x")
_STATS = struct.Struct("<QIIH")
REQUEST = struct.Struct("<BI")
_ACK = struct.Struct("<BBI")
_TIME = struct.Struct("<IQ")
_U16, _U32, _U64, _I16 = (np.dtype(code) for code in ("<u2", "<u4", "<u8", "<i2"))
_Arrays = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.int16]]
OVERHEAD = HEADER.size + 4
_FREQUENCY = HEADER.size + _SAMPLE.size


class Command(IntEnum):
    """What a REQUEST asks for; the comment says what its argument is."""

    HELLO = 1  # 0
    START = 2  # 0
    STOP = 3  # 0
    SET_PERIOD = 4  # sample period, µs
    IDENTIFY = 5  # how long the hub shows itself, s
    TIME = 6  # a number, which the answer repeats; the answer is a `Time`


class Result(IntEnum):
    """What an ACK answers."""

    DONE = 0
    UNKNOWN = 1  # the hub does not know the request
    REFUSED = 2  # the hub cannot do it; the ACK's argument is the value in force


@dataclass(frozen=True, slots=True, eq=False)
class Hello:
    """Who the hub is. Sent at power-up, on request, and once a second.

    hub_uid: u64
    firmware: u32
    n_pads: per cube, u8
    period_us: sample period in force, µs, u32
    cube_uids: (n_cubes,) uint64
    flags: u8, 0 in version 1
    """

    hub_uid: int
    firmware: int
    n_pads: int
    period_us: int
    cube_uids: NDArray[np.uint64]
    flags: int = 0

    @property
    def n_cubes(self) -> int:
        return len(self.cube_uids)

    def _pack(self) -> bytes:
        uids = _array("cube_uids", self.cube_uids, _U64, (len(self.cube_uids),))
        return (
            _HELLO.pack(
                self.hub_uid, self.firmware, len(uids), self.n_pads, self.flags, self.period_us
            )
            + uids.tobytes()
        )

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Hello | None:
        if size < _HELLO.size:
            return None
        hub_uid, firmware, n_cubes, n_pads, flags, period_us = _HELLO.unpack_from(raw, 4)
        if size != _HELLO.size + 8 * n_cubes:
            return None
        uids: NDArray[np.uint64] = np.ndarray((n_cubes,), _U64, raw, 4 + _HELLO.size)
        return cls(hub_uid, firmware, n_pads, period_us, uids, flags)


class Sample:
    """One reading of n_cubes cubes of a hub, first_cube and those after it, at the same instant.

    sequence: u32, wraps; given when the sample is taken, so one dropped in the hub leaves a gap
    first_cube: index on the hub, u16
    device_us: hub clock, µs, u64
    shape: (n_cubes, n_pads)
    frequency: (n_cubes, n_pads) uint32, mHz; 0 not measured
    pad_fault: (n_cubes,) uint32; bit p: the hub reports that pad p is faulty
    temperature: (n_cubes,) int16, 0.01 °C; -32768 unknown
    raw: the decoded bytes, from type to CRC; empty if the sample was not decoded
    """

    __slots__ = ("_arrays", "device_us", "first_cube", "raw", "sequence", "shape")

    def __init__(
        self,
        sequence: int,
        first_cube: int,
        device_us: int,
        frequency: NDArray[np.uint32],
        pad_fault: NDArray[np.uint32],
        temperature: NDArray[np.int16],
    ) -> None:
        self.sequence, self.first_cube, self.device_us = sequence, first_cube, device_us
        self.shape = frequency.shape
        self._arrays: _Arrays | None = (frequency, pad_fault, temperature)
        self.raw = b""

    def __repr__(self) -> str:
        numbers = f"{self.sequence}, {self.first_cube}, {self.device_us}"
        return f"Sample({numbers}, {self.frequency!r}, {self.pad_fault!r}, {self.temperature!r})"

    @property
    def n_cubes(self) -> int:
        return self.shape[0]

    @property
    def n_pads(self) -> int:
        return self.shape[1]

    @property
    def frequency(self) -> NDArray[np.uint32]:
        return self._made_arrays()[0]

    @property
    def pad_fault(self) -> NDArray[np.uint32]:
        return self._made_arrays()[1]

    @property
    def temperature(self) -> NDArray[np.int16]:
        return self._made_arrays()[2]

    @property
    def spare(self) -> bytes:
        """The spare bytes as they came, which hubs send as 0."""
        return self.raw[_FREQUENCY - 3 : _FREQUENCY] or bytes(3)

    def _made_arrays(self) -> _Arrays:
        # Made late, because `join` makes the arrays of several samples at once.
        if self._arrays is None:
            self._arrays = join([self])
        return self._arrays

    def _pack(self) -> bytes:
        if len(self.shape) != 2:
            raise ProtocolError(
                f"frequency has {len(self.shape)} dimensions, must have 2: (n_cubes, n_pads)"
            )
        n_cubes, n_pads = self.shape
        frequency = _array("frequency", self.frequency, _U32, (n_cubes, n_pads))
        pad_fault = _array("pad_fault", self.pad_fault, _U32, (n_cubes,))
        temperature = _array("temperature", self.temperature, _I16, (n_cubes,))
        head = _SAMPLE.pack(self.sequence, self.first_cube, n_cubes, self.device_us, n_pads)
        return b"".join((head, frequency.tobytes(), pad_fault.tobytes(), temperature.tobytes()))

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Sample | None:
        if size < _SAMPLE.size:
            return None
        sample = cls.__new__(cls)
        sample.sequence, sample.first_cube, n_cubes, sample.device_us, n_pads = _SAMPLE.unpack_from(
            raw, 4
        )
        if size != _SAMPLE.size + n_cubes * (4 * n_pads + 6):
            return None
        sample.shape = n_cubes, n_pads
        sample.raw, sample._arrays = raw, None
        return sample


@lru_cache(maxsize=64)
def _fields(n_cubes: int, n_pads: int) -> struct.Struct:
    """Splits a decoded SAMPLE into the bytes of its frequencies, faults and temperatures."""
    return struct.Struct(f"{_FREQUENCY}x{4 * n_cubes * n_pads}s{4 * n_cubes}s{2 * n_cubes}s4x")


def join(samples: Sequence[Sample]) -> _Arrays:
    """frequency (N, P), pad_fault (N,) and temperature (N,) of samples with P pads, one after the
    other.

    The bytes of all decoded samples become arrays at once, which are read-only.
    """
    width = samples[0].n_pads
    parts: list[bytes] = []
    for sample in samples:
        if not sample.raw:
            frequency, pad_fault, temperature = zip(
                *(sample._made_arrays() for sample in samples), strict=True
            )
            return np.concatenate(frequency), np.concatenate(pad_fault), np.concatenate(temperature)
        parts += _fields(*sample.shape).unpack(sample.raw)
    return (
        np.frombuffer(b"".join(parts[::3]), _U32).reshape(
            sum(sample.n_cubes for sample in samples), width
        ),
        np.frombuffer(b"".join(parts[1::3]), _U32),
        np.frombuffer(b"".join(parts[2::3]), _I16),
    )


@dataclass(frozen=True, slots=True)
class Stats:
    """What the hub has counted.

    uptime_ms: since power-up, u64
    taken, dropped: samples taken, and dropped in the hub, since power-up; u32, wrap
    supply_mv: mV, u16; 0 unknown
    """

    uptime_ms: int
    taken: int
    dropped: int
    supply_mv: int = 0

    def _pack(self) -> bytes:
        return _STATS.pack(self.uptime_ms, self.taken, self.dropped, self.supply_mv)

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Stats | None:
        return cls(*_STATS.unpack_from(raw, 4)) if size == _STATS.size else None


@dataclass(frozen=True, slots=True)
class Request:
    """From host to hub.

    request: a `Command`, u8; to other numbers the hub answers UNKNOWN
    argument: u32
    """

    request: int
    argument: int = 0

    def _pack(self) -> bytes:
        return REQUEST.pack(self.request, self.argument)

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Request | None:
        return cls(*REQUEST.unpack_from(raw, 4)) if size == REQUEST.size else None


@dataclass(frozen=True, slots=True)
class Ack:
    """From hub to host, one for each REQUEST but TIME.

    request: the one answered, u8
    result: a `Result`, u8
    argument: the value now in force, u32
    """

    request: int
    result: int = 0
    argument: int = 0

    def _pack(self) -> bytes:
        return _ACK.pack(self.request, self.result, self.argument)

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Ack | None:
        return cls(*_ACK.unpack_from(raw, 4)) if size == _ACK.size else None


@dataclass(frozen=True, slots=True)
class Time:
    """From hub to host: the answer to request TIME, in place of an `Ack`.

    number: the argument of the request, u32
    device_us: hub clock between the end of the request and the beginning of the answer, µs, u64
    """

    number: int
    device_us: int

    def _pack(self) -> bytes:
        return _TIME.pack(self.number, self.device_us)

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Time | None:
        return cls(*_TIME.unpack_from(raw, 4)) if size == _TIME.size else None


Frame = Hello | Sample | Stats | Time | Request | Ack

_TYPES: dict[int, type[Frame]] = {
    0x01: Hello,
    0x02: Sample,
    0x03: Stats,
    0x04: Time,
    0x10: Request,
    0x11: Ack,
}
_CODES = {frame_type: code for code, frame_type in _TYPES.items()}
UNPACK: dict[int, Callable[[bytes, int], Frame | None]] = {
    code: frame_type._unpack for code, frame_type in _TYPES.items()
}


def sample_bytes(n_cubes: int, n_pads: int) -> int:
    """How many bytes one SAMPLE of all cubes of a hub takes on the wire, in one frame."""
    frame = _FREQUENCY + n_cubes * (4 * n_pads + 4 + 2) + 4
    # COBS adds one byte in 254, and each frame lies between two zeros.
    return frame + 1 + frame // 254 + 2


def encode(frame: Frame, version: int = VERSION) -> bytes:
    """Bytes of one frame: a zero, the COBS code of header, payload and CRC-32, a zero.

    The leading zero ends any unfinished frame before it, which would otherwise swallow this one.
    version: another one than ours, for tests of the other end.
    ProtocolError: a field out of its range, an array of the wrong dtype or shape, a payload of over
    65535 bytes.
    """
    code = _CODES.get(type(frame))
    if code is None:
        names = ", ".join(frame_type.__name__ for frame_type in _CODES)
        raise ProtocolError(f"cannot encode {type(frame).__name__}; a frame is one of {names}")
    try:
        payload = frame._pack()
    except struct.error as error:
        raise ProtocolError(
            f"{type(frame).__name__}: {error}; see the field ranges in its docstring"
        ) from error
    if len(payload) > MAX_PAYLOAD:
        raise ProtocolError(
            f"the payload of {type(frame).__name__} has {len(payload)} bytes, "
            f"the limit is {MAX_PAYLOAD}: split the cubes over several frames with first_cube"
        )
    body = HEADER.pack(code, version, len(payload)) + payload
    code_words = cobs.encode(body + zlib.crc32(body).to_bytes(4, "little"))
    return b"\0" + code_words + b"\0"


def _array(name: str, value: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    if isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == shape:
        return value
    actual = type(value).__name__
    if isinstance(value, np.ndarray):
        actual = f"{value.dtype} {value.shape}"
    raise ProtocolError(
        f"{name} is {actual}, must be an array of {dtype.name} {shape}; convert and round it first"
    )
