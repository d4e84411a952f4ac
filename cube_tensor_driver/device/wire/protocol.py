# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of wire protocol version 1 and their bytes, without input or output.

A frame is ``type:u8 version:u8 length:u16 payload crc:u32``, little-endian. `length` is the length
of the payload in bytes, and `crc` is the IEEE 802.3 CRC-32 of all bytes before it. On the wire a
frame is COBS-encoded (see `cobs.py`) between two zero bytes. docs/protocol.md has the fields and an
annotated dump of each type. The driver and the simulated hubs share this file.

`encode` converts a frame to bytes; `decoder.py` does the reverse. Arrays must have the dtype that
the docstring of the frame names; other dtypes are refused. The arrays of decoded frames are
read-only and are made when they are first used.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import AnyArray, Single
from ...core.errors import ProtocolError
from . import cobs

VERSION = 1
"""Protocol version of the frames that are sent and accepted."""
MAX_PAYLOAD = 0xFFFF
"""Largest payload of a frame, in bytes."""
MAX_FRAME = 4 + MAX_PAYLOAD + 4
"""Length of the longest frame, in bytes, with header and CRC, before COBS encoding."""
TEMPERATURE_UNKNOWN = -32768
"""Value of `Sample.temperature` for a cube whose temperature the hub did not measure."""
NOT_MEASURED = 0
"""Value of `Sample.frequency` for a pad (capacitive sensor of a cube) that was not measured."""

HEADER = struct.Struct("<BBH")
"""Header of a frame: type, protocol version, and length of the payload in bytes."""
OVERHEAD = HEADER.size + 4
"""Number of bytes of a frame besides its payload: header and CRC-32 (checksum, 4 bytes)."""
_HELLO = struct.Struct("<QIHBBI")
"""Layout of the start of the payload of HELLO: uid of the hub, firmware version, number of cubes,
number of pads per cube, flags, and sample period in µs. The uids of the cubes follow."""
_SAMPLE = struct.Struct("<IHHQB3x")
"""Layout of the start of the payload of SAMPLE: number of the sample, index of the first cube,
number of cubes, device time in µs, number of pads per cube, and 3 unused bytes. The arrays with
the measurements of the cubes follow."""
_FREQUENCY = HEADER.size + _SAMPLE.size
"""Byte offset of the frequencies from the start of a decoded SAMPLE frame."""
_U32 = np.dtype("<u4")
"""Type of frequencies and pad faults in the payload."""
_U64 = np.dtype("<u8")
"""Type of the uids of cubes in the payload."""
_I16 = np.dtype("<i2")
"""Type of temperatures in the payload."""
_Arrays = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.int16]]
"""Arrays of a SAMPLE frame: frequencies, pad faults and temperatures (see `Sample`)."""


class Command(IntEnum):
    """Number of a request to a hub, the field `request` of `Request`.

    Attributes:
        HELLO: Identify yourself; the hub answers by a `Hello`. The argument is 0.
        START: Send samples. The argument is 0.
        STOP: Send no more samples. The argument is 0.
        SET_PERIOD: Set the sample period. The argument is the period in µs.
        IDENTIFY: Show a person which hub this is, for example by a light. The argument is the
            duration in s.
        TIME: Report the device time; the hub answers by a `Time`. The argument is any number, which
            the answer repeats.
    """

    HELLO = 1
    START = 2
    STOP = 3
    SET_PERIOD = 4
    IDENTIFY = 5
    TIME = 6


class Result(IntEnum):
    """Result of a request, the field `result` of `Ack`.

    Attributes:
        DONE: The hub has executed the request.
        UNKNOWN: The firmware of the hub does not support the request.
        REFUSED: The hub cannot use the requested value; the argument of the ACK is the value that
            remains in force.
    """

    DONE = 0
    UNKNOWN = 1
    REFUSED = 2


@dataclass(frozen=True, slots=True, eq=False)
class Hello:
    """Identification of a hub, sent at power-up, on request, and once a second.

    Attributes:
        hub_uid: Unique number of the hub, u64.
        firmware: Version of its firmware, u32.
        n_pads: Number of pads of each cube, u8.
        period_us: Sample period in force, in µs, u32.
        cube_uids: Unique numbers of the cubes (n_cubes,) uint64, in the order of their indices.
        flags: Reserved, u8; 0 in protocol version 1.
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
        uids = _check_array(
            "cube_uids",
            self.cube_uids,
            _U64,
            (self.n_cubes,),
        )
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
        uids: NDArray[np.uint64] = np.frombuffer(
            raw,
            _U64,
            n_cubes,
            first_uid,
        )
        return cls(hub_uid, firmware, n_pads, period_us, uids, flags)


class Sample:
    """One measurement of all pads of successive cubes of a hub, at the same instant.

    Attributes:
        sequence: Number of the sample, u32, which wraps to 0. The hub increases it whenever it
            samples, so a sample that is then dropped leaves a gap in the numbers.
        first_cube: Index on the hub of the first cube in this frame, u16. A hub with many cubes
            splits a sample into several frames.
        device_us: Time of the measurement by the hub's clock, in µs, u64.
        shape: Numbers of cubes in this frame and of pads per cube: (n_cubes, n_pads).
        raw: Bytes of the received frame from its type to its CRC; empty if the sample was not
            received but made from arrays.
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
        self.sequence = sequence
        self.first_cube = first_cube
        self.device_us = device_us
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
        """Number of cubes in this frame."""
        return self.shape[0]

    @property
    def n_pads(self) -> int:
        """Number of pads of each cube."""
        return self.shape[1]

    @property
    def frequency(self) -> NDArray[np.uint32]:
        """Frequencies of the pads (n_cubes, n_pads) in mHz; 0 where a pad was not measured."""
        return self._make_arrays()[0]

    @property
    def pad_fault(self) -> NDArray[np.uint32]:
        """Bit mask of each cube (n_cubes,); bit p is set if the hub reports pad p as faulty."""
        return self._make_arrays()[1]

    @property
    def temperature(self) -> NDArray[np.int16]:
        """Temperatures of the cubes (n_cubes,) in 0.01 °C; -32768 where not measured."""
        return self._make_arrays()[2]

    @property
    def spare(self) -> bytes:
        """The three reserved bytes of the received frame, which hubs send as 0."""
        return self.raw[_FREQUENCY - 3 : _FREQUENCY] or bytes(3)

    def _make_arrays(self) -> _Arrays:
        # The module in C reads the bytes, so the arrays are made only if somebody asks for them.
        if self._arrays is None:
            n_cubes, n_pads = self.shape
            faults = _FREQUENCY + 4 * n_cubes * n_pads
            self._arrays = (
                np.frombuffer(self.raw, _U32, n_cubes * n_pads, _FREQUENCY).reshape(self.shape),
                np.frombuffer(self.raw, _U32, n_cubes, faults),
                np.frombuffer(self.raw, _I16, n_cubes, faults + 4 * n_cubes),
            )
        return self._arrays

    def _pack(self) -> bytes:
        if len(self.shape) != 2:
            raise ProtocolError(
                f"frequency has {len(self.shape)} dimensions, must have 2: (n_cubes, n_pads)"
            )
        n_cubes, n_pads = self.shape
        frequency = _check_array(
            "frequency",
            self.frequency,
            _U32,
            (n_cubes, n_pads),
        )
        pad_fault = _check_array(
            "pad_fault",
            self.pad_fault,
            _U32,
            (n_cubes,),
        )
        temperature = _check_array(
            "temperature",
            self.temperature,
            _I16,
            (n_cubes,),
        )
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
        sample.sequence = sequence
        sample.first_cube = first_cube
        sample.device_us = device_us
        sample.shape = n_cubes, n_pads
        sample.raw = raw
        sample._arrays = None
        return sample


_Fixed = TypeVar("_Fixed", bound="_FixedFrame")


class _FixedFrame:
    """Base class of frames whose payload is a fixed sequence of numbers: the fields, in order."""

    __slots__ = ()
    _PAYLOAD: ClassVar[struct.Struct]
    """Numbers of the payload, in the order of the fields."""

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
    """Counters of a hub, which it sends once a second.

    Attributes:
        uptime_ms: Time since power-up of the hub, in ms, u64.
        taken: Number of samples taken since power-up, u32, which wraps to 0.
        dropped: Number of samples that the hub has taken but not sent since power-up, u32, which
            wraps to 0.
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
        request: A `Command`, u8. To any other number the hub answers by an `Ack` with the result
            UNKNOWN.
        argument: Argument of the command, u32; see `Command`.
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
        argument: The value that is now in force, for example the sample period in µs, u32.
    """

    _PAYLOAD = struct.Struct("<BBI")

    request: int
    result: int = 0
    argument: int = 0


@dataclass(frozen=True, slots=True)
class Time(_FixedFrame):
    """Answer of a hub to the request TIME, in place of an `Ack`.

    Attributes:
        number: The argument of the request, by which the host knows which one is answered, u32.
        device_us: Time of the hub's clock, in µs, u64, read after the hub had received the whole
            request and before it sent this answer.
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
"""Number of a type in the header -> class of the frame."""
_CODES = {frame_type: code for code, frame_type in _TYPES.items()}
"""Class of a frame -> number of its type in the header."""
UNPACK: dict[int, Callable[[bytes, int], Frame | None]] = {
    code: frame_type._unpack for code, frame_type in _TYPES.items()
}
"""Function for each type code (first byte of a frame) that makes the frame. Its arguments are the
decoded bytes from type to CRC and the length of the payload; it returns None if the fields do not
fit the length."""


def to_hertz(millihertz: NDArray[np.uint32]) -> Single:
    """Convert frequencies in mHz, as `Sample` has them, to Hz; NaN where a pad was not measured.

    They are converted in double precision and rounded to float32 once, at the end, because float32
    cannot resolve 1 mHz at 100 kHz.
    """
    hertz = (millihertz * 1e-3).astype(np.float32)
    hertz[millihertz == NOT_MEASURED] = np.nan
    return hertz


def count_sample_bytes(n_cubes: int, n_pads: int) -> int:
    """Return the largest number of bytes on the wire of one SAMPLE frame.

    Args:
        n_cubes: Number of cubes in the frame.
        n_pads: Number of pads of each cube.
    """
    frame = _FREQUENCY + n_cubes * (4 * n_pads + 4 + 2) + 4
    # COBS encoding adds at most one byte, and one more for each 254 bytes. On the wire, a zero byte
    # stands before and after each frame.
    return frame + 1 + frame // 254 + 2


def encode(frame: Frame, version: int = VERSION) -> bytes:
    """Return the bytes of one frame on the wire: a zero, the COBS-encoded frame, and a zero.

    The first zero ends a frame before it that was cut off; otherwise the two would be read as one.

    Args:
        frame: The frame.
        version: Protocol version in the header. Other values than `VERSION` serve to test how a
            receiver handles them.

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
    value: object,
    dtype: np.dtype[np.generic],
    shape: tuple[int, ...],
) -> AnyArray:
    """Return `value` if it is an array of this dtype and shape; otherwise raise ProtocolError.

    Args:
        name: Name of the field, for the error message.
        value: Value of the field.
        dtype: Required dtype.
        shape: Required shape.
    """
    if isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == shape:
        return value
    actual = type(value).__name__
    if isinstance(value, np.ndarray):
        actual = f"{value.dtype} {value.shape}"
    raise ProtocolError(
        f"{name} is {actual}, must be an array of {dtype.name} {shape}; convert and round it first"
    )
