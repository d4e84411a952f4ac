"""The frames of wire protocol version 1 and their bytes, without input or output.

A frame is ``type:u8 version:u8 length:u16 payload crc:u32``, little-endian, where `length` is that
of the payload and `crc` is the IEEE 802.3 CRC-32 of all bytes before it. On the wire a frame is
COBS-encoded between two zero bytes. docs/protocol.md has the fields and an annotated dump of each
type. The driver and the simulated hubs share this file.

`encode` turns a frame into bytes; `decoder.py` does the reverse. Arrays must have the dtype that
the docstring of the frame names, because nothing is converted. The arrays of decoded frames are
read-only and are made when they are first used.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from functools import lru_cache
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...core.errors import ProtocolError
from . import cobs

VERSION = 1
"""Protocol version of the frames that are sent and accepted."""
MAX_PAYLOAD = 0xFFFF
"""Largest payload of a frame, in bytes."""
MAX_FRAME = 4 + MAX_PAYLOAD + 4
"""Length of the longest frame, in bytes, with header and CRC and before COBS."""
TEMPERATURE_UNKNOWN = -32768
"""Value of `Sample.temperature` where the hub does not know the temperature."""
NOT_MEASURED = 0
"""Value of `Sample.frequency` where the hub did not measure a pad."""

HEADER = struct.Struct("<BBH")
"""Type, version and length of a frame."""
OVERHEAD = HEADER.size + 4
"""Bytes of a frame beside its payload: header and CRC."""
_HELLO = struct.Struct("<QIHBBI")
_SAMPLE = struct.Struct("<IHHQB3x")
_FREQUENCY = HEADER.size + _SAMPLE.size
"""Position of the frequencies in a decoded SAMPLE."""
_U32 = np.dtype("<u4")
_U64 = np.dtype("<u8")
_I16 = np.dtype("<i2")
_Arrays = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.int16]]
"""Frequencies, pad faults and temperatures."""


class Command(IntEnum):
    """What a `Request` asks for. Each comment gives the argument."""

    HELLO = 1  # none (0)
    START = 2  # none (0)
    STOP = 3  # none (0)
    SET_PERIOD = 4  # sample period, µs
    IDENTIFY = 5  # duration for which the hub shows itself, s
    TIME = 6  # any number, which the answer repeats; the answer is a `Time`


class Result(IntEnum):
    """What an `Ack` answers."""

    DONE = 0
    UNKNOWN = 1  # the hub does not know the request
    REFUSED = 2  # the hub cannot do it; the argument of the ACK is the value in force


@dataclass(frozen=True, slots=True, eq=False)
class Hello:
    """Identification of a hub, sent at power-up, on request, and once a second.

    Attributes:
        hub_uid: Unique number of the hub, u64.
        firmware: Version of its firmware, u32.
        n_pads: Number of pads of each cube, u8.
        period_us: Sample period in force, in µs, u32.
        cube_uids: Unique numbers of the cubes (n_cubes,) uint64.
        flags: 0 in version 1, u8.
    """

    hub_uid: int
    firmware: int
    n_pads: int
    period_us: int
    cube_uids: NDArray[np.uint64]
    flags: int = 0

    @property
    def n_cubes(self) -> int:
        """Number of cubes of the hub."""
        return len(self.cube_uids)

    def _pack(self) -> bytes:
        uids = _check_array("cube_uids", self.cube_uids, _U64, (self.n_cubes,))
        numbers = _HELLO.pack(
            self.hub_uid,
            self.firmware,
            self.n_cubes,
            self.n_pads,
            self.flags,
            self.period_us,
        )
        return numbers + uids.tobytes()

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Hello | None:
        if size < _HELLO.size:
            return None
        hub_uid, firmware, n_cubes, n_pads, flags, period_us = _HELLO.unpack_from(raw, HEADER.size)
        if size != _HELLO.size + 8 * n_cubes:
            return None
        first_uid = HEADER.size + _HELLO.size
        uids: NDArray[np.uint64] = np.frombuffer(raw, _U64, n_cubes, first_uid)
        return cls(hub_uid, firmware, n_pads, period_us, uids, flags)


class Sample:
    """One measurement of all pads of successive cubes of a hub, at the same instant.

    Attributes:
        sequence: Number of the sample, u32, which wraps. The hub counts when it samples, so a
            sample that it drops leaves a gap.
        first_cube: Index of the first cube on the hub, u16.
        device_us: Device time of the measurement, in µs, u64.
        shape: (n_cubes, n_pads).
        raw: Decoded bytes from type to CRC; empty if the sample was not decoded.
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
        self.shape: tuple[int, int] = frequency.shape
        self._arrays: _Arrays | None = (frequency, pad_fault, temperature)
        self.raw = b""

    def __repr__(self) -> str:
        return (
            f"Sample(sequence={self.sequence}, first_cube={self.first_cube}, "
            f"device_us={self.device_us}, shape={self.shape})"
        )

    @property
    def n_cubes(self) -> int:
        """Number of cubes in the sample."""
        return self.shape[0]

    @property
    def n_pads(self) -> int:
        """Number of pads of each cube."""
        return self.shape[1]

    @property
    def frequency(self) -> NDArray[np.uint32]:
        """Frequencies (n_cubes, n_pads) in mHz; 0 where a pad was not measured."""
        return self._make_arrays()[0]

    @property
    def pad_fault(self) -> NDArray[np.uint32]:
        """Pad faults (n_cubes,); bit p is set if the hub reports that pad p is faulty."""
        return self._make_arrays()[1]

    @property
    def temperature(self) -> NDArray[np.int16]:
        """Temperatures (n_cubes,) in 0.01 °C; -32768 where unknown."""
        return self._make_arrays()[2]

    @property
    def spare(self) -> bytes:
        """The spare bytes as they were received, which hubs send as 0."""
        return self.raw[_FREQUENCY - 3 : _FREQUENCY] or bytes(3)

    def _make_arrays(self) -> _Arrays:
        # The arrays are made late, because `join` makes those of several samples at once.
        if self._arrays is None:
            self._arrays = join([self])
        return self._arrays

    def _pack(self) -> bytes:
        if len(self.shape) != 2:
            raise ProtocolError(
                f"frequency has {len(self.shape)} dimensions, must have 2: (n_cubes, n_pads)"
            )
        n_cubes, n_pads = self.shape
        frequency = _check_array("frequency", self.frequency, _U32, (n_cubes, n_pads))
        pad_fault = _check_array("pad_fault", self.pad_fault, _U32, (n_cubes,))
        temperature = _check_array("temperature", self.temperature, _I16, (n_cubes,))
        numbers = _SAMPLE.pack(
            self.sequence,
            self.first_cube,
            n_cubes,
            self.device_us,
            n_pads,
        )
        arrays = frequency, pad_fault, temperature
        return numbers + b"".join(array.tobytes() for array in arrays)

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Sample | None:
        if size < _SAMPLE.size:
            return None
        sequence, first_cube, n_cubes, device_us, n_pads = _SAMPLE.unpack_from(raw, HEADER.size)
        if size != _SAMPLE.size + n_cubes * (4 * n_pads + 6):
            return None
        sample = cls.__new__(cls)
        sample.sequence, sample.first_cube, sample.device_us = sequence, first_cube, device_us
        sample.shape = n_cubes, n_pads
        sample.raw, sample._arrays = raw, None
        return sample


@lru_cache(maxsize=64)
def _split_fields(n_cubes: int, n_pads: int) -> struct.Struct:
    """Return what splits a decoded SAMPLE into frequencies, faults and temperatures."""
    sizes = 4 * n_cubes * n_pads, 4 * n_cubes, 2 * n_cubes
    fields = "".join(f"{size}s" for size in sizes)
    return struct.Struct(f"{_FREQUENCY}x{fields}4x")


def join(samples: Sequence[Sample]) -> _Arrays:
    """Return the arrays of samples with the same number of pads, one after the other.

    The bytes of all decoded samples become arrays at once, which are read-only.

    Returns:
        Frequencies (N, n_pads), pad faults (N,) and temperatures (N,).
    """
    if not all(sample.raw for sample in samples):
        arrays = [sample._make_arrays() for sample in samples]
        frequency, pad_fault, temperature = zip(*arrays, strict=True)
        return (
            np.concatenate(frequency),
            np.concatenate(pad_fault),
            np.concatenate(temperature),
        )

    parts: list[bytes] = []
    for sample in samples:
        parts += _split_fields(*sample.shape).unpack(sample.raw)
    # Each sample gave three parts: frequencies, pad faults and temperatures.
    frequencies = np.frombuffer(b"".join(parts[::3]), _U32)
    pad_faults = np.frombuffer(b"".join(parts[1::3]), _U32)
    temperatures = np.frombuffer(b"".join(parts[2::3]), _I16)
    shape = len(pad_faults), samples[0].n_pads
    return frequencies.reshape(shape), pad_faults, temperatures


_Fixed = TypeVar("_Fixed", bound="_FixedFrame")


class _FixedFrame:
    """A frame whose payload is a fixed sequence of numbers, the fields in their order."""

    __slots__ = ()
    _PAYLOAD: ClassVar[struct.Struct]

    def _pack(self) -> bytes:
        numbers = (getattr(self, field.name) for field in fields(self))  # type: ignore[arg-type]
        return self._PAYLOAD.pack(*numbers)

    @classmethod
    def _unpack(cls: type[_Fixed], raw: bytes, size: int) -> _Fixed | None:
        if size != cls._PAYLOAD.size:
            return None
        return cls(*cls._PAYLOAD.unpack_from(raw, HEADER.size))


@dataclass(frozen=True, slots=True)
class Stats(_FixedFrame):
    """Counters of a hub.

    Attributes:
        uptime_ms: Time since power-up, in ms, u64.
        taken: Samples taken since power-up, u32, which wraps.
        dropped: Samples dropped in the hub since power-up, u32, which wraps.
        supply_mv: Supply voltage, in mV, u16; 0 if unknown.
    """

    _PAYLOAD = struct.Struct("<QIIH")

    uptime_ms: int
    taken: int
    dropped: int
    supply_mv: int = 0


@dataclass(frozen=True, slots=True)
class Request(_FixedFrame):
    """Request of the host to a hub.

    Attributes:
        request: A `Command`, u8. To other numbers the hub answers UNKNOWN.
        argument: Argument of the command, u32.
    """

    _PAYLOAD = struct.Struct("<BI")

    request: int
    argument: int = 0


@dataclass(frozen=True, slots=True)
class Ack(_FixedFrame):
    """Answer of a hub to a request other than TIME.

    Attributes:
        request: The `Command` that is answered, u8.
        result: A `Result`, u8.
        argument: The value that is now in force, u32.
    """

    _PAYLOAD = struct.Struct("<BBI")

    request: int
    result: int = 0
    argument: int = 0


@dataclass(frozen=True, slots=True)
class Time(_FixedFrame):
    """Answer of a hub to the request TIME, in place of an `Ack`.

    Attributes:
        number: The argument of the request, u32.
        device_us: Device time between the end of the request and the beginning of the answer, in
            µs, u64.
    """

    _PAYLOAD = struct.Struct("<IQ")

    number: int
    device_us: int


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
"""For each type code the function that turns the bytes of a frame and the length of its payload
into the frame, or into None if they do not fit."""


def sample_bytes(n_cubes: int, n_pads: int) -> int:
    """Return the length on the wire, in bytes, of one SAMPLE of all cubes of a hub in one frame."""
    frame = _FREQUENCY + n_cubes * (4 * n_pads + 4 + 2) + 4
    # COBS adds one byte in 254, and each frame lies between two zeros.
    return frame + 1 + frame // 254 + 2


def encode(frame: Frame, version: int = VERSION) -> bytes:
    """Return the bytes of one frame on the wire: a zero, the COBS-encoded frame, and a zero.

    The first zero ends an unfinished frame before it, which would otherwise absorb this one.

    Args:
        frame: The frame.
        version: Protocol version; another than ours is for tests of the other end.

    Raises:
        ProtocolError: A field is out of its range, an array has the wrong dtype or shape, or the
            payload is longer than 65535 bytes.
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
    crc = zlib.crc32(body).to_bytes(4, "little")
    return b"\0" + cobs.encode(body + crc) + b"\0"


def _check_array(
    name: str,
    value: Any,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
) -> NDArray[Any]:
    """Return a field that is an array of this dtype and shape; raise ProtocolError otherwise."""
    if isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == shape:
        return value
    actual = type(value).__name__
    if isinstance(value, np.ndarray):
        actual = f"{value.dtype} {value.shape}"
    raise ProtocolError(
        f"{name} is {actual}, must be an array of {dtype.name} {shape}; convert and round it first"
    )
