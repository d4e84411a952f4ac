"""Wire protocol, version 1: frames to bytes and bytes to frames, without any I/O.

A frame is ``type:u8 version:u8 length:u16 payload crc:u32``, little-endian, `length` counting the payload,
`crc` the CRC-32 of IEEE 802.3 over all before it. It travels COBS-encoded between two zero bytes. Layouts and
one annotated hex dump per frame type: docs/protocol.md. The driver and the simulated hubs share this file.

Contracts
    `encode` takes a frame and returns bytes, or raises `ProtocolError`.
    `Decoder.feed` takes any bytes and never raises: every non-empty run of bytes closed by a zero becomes
    exactly one frame or is counted in exactly one counter of `Counters`. Arrays of decoded frames are read-only,
    made when first asked for. Arrays to encode must have the dtype named in the frame's docstring;
    nothing is converted behind the caller's back.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from cobs import cobs  # type: ignore[import-untyped]
from numpy.typing import NDArray

from ..core.errors import ProtocolError

VERSION = 1
MAX_PAYLOAD = 0xFFFF
MAX_FRAME = 4 + MAX_PAYLOAD + 4
MAX_RUN = MAX_FRAME + (MAX_FRAME + 253) // 254
"""Longest run of bytes between two zeros that can be a frame: COBS adds at most one byte in 254."""

TEMPERATURE_UNKNOWN = -32768
NOT_MEASURED = 0

_HEADER = struct.Struct("<BBH")
_HELLO = struct.Struct("<QIHBBI")
_SAMPLE = struct.Struct("<IHHQB3x")
_STATS = struct.Struct("<QIIH")
_REQUEST = struct.Struct("<BI")
_ACK = struct.Struct("<BBI")
_U16, _U32, _U64, _I16 = (np.dtype(code) for code in ("<u2", "<u4", "<u8", "<i2"))
_Arrays = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.int16]]
_OVERHEAD = _HEADER.size + 4
_FREQUENCY = _HEADER.size + _SAMPLE.size
MIN_RUN = _OVERHEAD + _REQUEST.size + 1
"""Shortest run that can be a frame, of any version: to try shorter ones would let noise slow the decoder down."""
SHORT_RUN, CROWD = 32, 32
"""More runs in a feed than CROWD that are shorter than any SAMPLE are noise: see `Decoder._thinned`."""
# CRC-32 over data followed by its own CRC is this constant: no slice, no second look at the frame's end.
_CRC_RESIDUE = 0x2144DF1C


class Command(IntEnum):
    """What a REQUEST asks for; the comment is the unit of its argument."""

    HELLO = 1  # 0
    START = 2  # 0
    STOP = 3  # 0
    SET_PERIOD = 4  # µs
    IDENTIFY = 5  # s, how long the hub shows itself


class Result(IntEnum):
    """What an ACK answers."""

    DONE = 0
    UNKNOWN = 1  # the hub does not know the request
    REFUSED = 2  # argument outside what the hub can do; the ACK's argument is what is in force


@dataclass(frozen=True, slots=True, eq=False)
class Hello:
    """Who the hub is. Sent at power-up, on request and then at 1 Hz.

    hub_uid u64; firmware u32; n_pads per cube u8; flags u8 (0 in version 1); period_us sample period u32, µs;
    cube_uids (n_cubes,) uint64.
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
            _HELLO.pack(self.hub_uid, self.firmware, len(uids), self.n_pads, self.flags, self.period_us)
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
    """One reading of cubes first_cube .. first_cube + n_cubes − 1 of a hub, all at the same instant.

    sequence: u32, given when the sample is taken, so that a sample dropped in the hub leaves a gap; wraps.
    first_cube: index on the hub, u16. device_us: hub clock, µs, u64. shape: (n_cubes, n_pads).
    frequency: (n_cubes, n_pads) uint32, mHz, 0 not measured.
    pad_fault: (n_cubes,) uint32, bit p set = pad p reported faulty by the hub.
    temperature: (n_cubes,) int16, 0.01 °C, −32768 unknown.
    """

    __slots__ = ("_arrays", "_raw", "device_us", "first_cube", "sequence", "shape")

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
        self._raw = b""

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
        return self._made()[0]

    @property
    def pad_fault(self) -> NDArray[np.uint32]:
        return self._made()[1]

    @property
    def temperature(self) -> NDArray[np.int16]:
        return self._made()[2]

    def _made(self) -> _Arrays:
        # Of decoded samples `join` mostly makes the arrays of several at once.
        if self._arrays is None:
            self._arrays = join([self])
        return self._arrays

    def _pack(self) -> bytes:
        if len(self.shape) != 2:
            raise ProtocolError(f"frequency has {len(self.shape)} dimensions, must have 2: (n_cubes, n_pads)")
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
        sample.sequence, sample.first_cube, n_cubes, sample.device_us, n_pads = _SAMPLE.unpack_from(raw, 4)
        if size != _SAMPLE.size + n_cubes * (4 * n_pads + 6):
            return None
        sample.shape = n_cubes, n_pads
        sample._raw, sample._arrays = raw, None
        return sample


def join(samples: Sequence[Sample]) -> _Arrays:
    """frequency (N, P), pad_fault (N,) and temperature (N,) of all cubes of samples with P pads, one after the other.

    Decoded bytes become arrays once for all of them. Read-only where all were decoded.
    """
    width = samples[0].n_pads
    parts: list[bytes] = []
    for sample in samples:
        raw, n_cubes = sample._raw, sample.shape[0]
        if not raw:
            frequency, pad_fault, temperature = zip(*(sample._made() for sample in samples), strict=True)
            return np.concatenate(frequency), np.concatenate(pad_fault), np.concatenate(temperature)
        at_fault = _FREQUENCY + 4 * n_cubes * width
        at_temperature = at_fault + 4 * n_cubes
        parts += raw[_FREQUENCY:at_fault], raw[at_fault:at_temperature], raw[at_temperature:-4]
    return (
        np.frombuffer(b"".join(parts[::3]), _U32).reshape(sum(sample.n_cubes for sample in samples), width),
        np.frombuffer(b"".join(parts[1::3]), _U32),
        np.frombuffer(b"".join(parts[2::3]), _I16),
    )


@dataclass(frozen=True, slots=True)
class Stats:
    """The hub's own book: uptime_ms u64; samples taken u32 and dropped in the hub u32, since power-up,
    wrapping; supply_mv u16, mV, 0 unknown."""

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
    """Host to hub: request u8 (a `Command`; other numbers pass, the hub answers UNKNOWN), argument u32."""

    request: int
    argument: int = 0

    def _pack(self) -> bytes:
        return _REQUEST.pack(self.request, self.argument)

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Request | None:
        return cls(*_REQUEST.unpack_from(raw, 4)) if size == _REQUEST.size else None


@dataclass(frozen=True, slots=True)
class Ack:
    """Hub to host, one per REQUEST: its request u8, result u8 (a `Result`, 0 done), argument u32 now in
    force."""

    request: int
    result: int = 0
    argument: int = 0

    def _pack(self) -> bytes:
        return _ACK.pack(self.request, self.result, self.argument)

    @classmethod
    def _unpack(cls, raw: bytes, size: int) -> Ack | None:
        return cls(*_ACK.unpack_from(raw, 4)) if size == _ACK.size else None


Frame = Hello | Sample | Stats | Request | Ack

_TYPES: dict[int, type[Frame]] = {0x01: Hello, 0x02: Sample, 0x03: Stats, 0x10: Request, 0x11: Ack}
_CODES = {frame_type: code for code, frame_type in _TYPES.items()}
_UNPACK: dict[int, Callable[[bytes, int], Frame | None]] = {code: kind._unpack for code, kind in _TYPES.items()}


def encode(frame: Frame, version: int = VERSION) -> bytes:
    """Bytes of one frame: a zero, the COBS code of header, payload and CRC-32, a zero.

    The leading zero ends whatever half frame or garbage came before, which would otherwise swallow this
    frame. version: another one than ours, to try the other end with. ProtocolError: a field out of its range,
    an array of the wrong dtype or shape, a payload over 65535 bytes.
    """
    code = _CODES.get(type(frame))
    if code is None:
        raise ProtocolError(
            f"cannot encode {type(frame).__name__}; a frame is one of " + ", ".join(k.__name__ for k in _CODES)
        )
    try:
        payload = frame._pack()
    except struct.error as error:
        raise ProtocolError(f"{type(frame).__name__}: {error}; see the field ranges in its docstring") from error
    if len(payload) > MAX_PAYLOAD:
        raise ProtocolError(
            f"{type(frame).__name__} payload has {len(payload)} bytes, the limit is {MAX_PAYLOAD}: "
            "split the cubes over several frames with first_cube"
        )
    body = _HEADER.pack(code, version, len(payload)) + payload
    code_words: bytes = cobs.encode(body + zlib.crc32(body).to_bytes(4, "little"))
    return b"\0" + code_words + b"\0"


@dataclass(slots=True)
class Counters:
    """What became of the bytes fed to a `Decoder`. All but `bytes` count frames or runs between zeros."""

    bytes: int = 0
    frames: int = 0
    crc: int = 0  # checksum wrong
    framing: int = 0  # not COBS, or cut off by the end of the stream
    length: int = 0  # too short for a frame, or the length does not fit the contents
    version: int = 0  # sound, but of another protocol version: see Decoder.other_version
    unknown_type: int = 0  # sound, but of a type that version 1 does not have
    overrun: int = 0  # longer than any frame can be, thrown away up to the next zero

    def as_dict(self) -> dict[str, int]:
        return {name: getattr(self, name) for name in self.__slots__}


class Decoder:
    """Bytes in, frames out. Holds at most MAX_RUN bytes between calls.

    counters: `Counters`, growing for the life of the decoder.
    other_version: the last version other than ours that a sound frame named, None if there was none.
    """

    def __init__(self) -> None:
        self.counters = Counters()
        self.other_version: int | None = None
        self._tail = bytearray()
        self._discarding = False

    def feed(self, data: bytes | bytearray) -> list[Frame]:
        """Frames that `data` completes, in order. Never raises, whatever the bytes are."""
        self.counters.bytes += len(data)
        last = len(data) - 1
        if last > MIN_RUN and not data[0] and data.find(0, 1) == last and not (self._tail or self._discarding):
            # One frame and nothing else, as it mostly comes.
            only = self._decode(bytes(data[1:last]))
            return [] if only is None else [only]
        data = bytes(data)
        runs = (self._thinned(data) if data.count(0) > CROWD else data).split(b"\0")
        rest = runs.pop()
        frames: list[Frame] = []
        if runs:
            if self._tail or self._discarding:
                runs[0] = b"" if self._discarding else bytes(self._tail + runs[0])
                self._tail.clear()
                self._discarding = False
            for run in runs:
                if len(run) >= MIN_RUN:
                    frame = self._decode(run)
                    if frame is not None:
                        frames.append(frame)
                elif run:
                    self.counters.length += 1
        if not self._discarding:
            self._tail += rest
            if len(self._tail) > MAX_RUN:
                self.counters.overrun += 1
                self._tail.clear()
                self._discarding = True
        return frames

    def reset(self) -> None:
        """The stream ended: what is left of it is no frame (counted as framing). Counters go on."""
        self.counters.framing += bool(self._tail)
        self._tail.clear()
        self._discarding = False

    def _thinned(self, data: bytes) -> bytes:
        """Data without the short runs that can be no frame, where they are a crowd: counted without a step each.

        To decode each would take longer than good frames of the same size. A short frame with a sound checksum but type
        or version 0, which no version has, counts as crc here.
        """
        code = np.frombuffer(data + b"\0", np.uint8)  # one more, where what leads beyond the data ends
        zeros = np.flatnonzero(code[:-1] == 0)
        length = np.diff(zeros) - 1
        tiny = np.count_nonzero(length < MIN_RUN) - np.count_nonzero(length == 0)
        kept = length >= MIN_RUN
        short = np.flatnonzero(kept & (length < SHORT_RUN))
        if len(short) > CROWD:
            # Each code word says where the next one is; a run is COBS where that leads to its end, a zero, which stays.
            at = np.minimum(np.arange(len(code)) + code, len(code) - 1)
            for _ in range((SHORT_RUN - 1).bit_length()):
                at = at[at]
            first, end, size = zeros[short] + 1, zeros[short + 1], length[short]
            sound = at[first] == end
            # The header's fourth byte, the high one of its length, is the only one of four that is 0.
            hopeful = sound & (code[first] == 4) & (code[first + 3] == size - 1 - _OVERHEAD)
            kept[short] = hopeful
            self.counters.framing += len(short) - int(np.count_nonzero(sound))
            self.counters.crc += int(np.count_nonzero(sound)) - int(np.count_nonzero(hopeful))
        elif tiny <= CROWD:
            return data
        self.counters.length += tiny
        chosen = np.flatnonzero(kept)
        runs = [data[i:j] for i, j in zip((zeros[chosen] + 1).tolist(), zeros[chosen + 1].tolist(), strict=True)]
        return b"\0".join([data[: zeros[0]], *runs, data[zeros[-1] + 1 :]])

    def _decode(self, run: bytes) -> Frame | None:
        counters = self.counters
        if len(run) > MAX_RUN:
            counters.overrun += 1
            return None
        try:
            raw = cobs.decode(run)
        except cobs.DecodeError:
            counters.framing += 1
            return None
        if zlib.crc32(raw) != _CRC_RESIDUE:
            counters.crc += 1
            return None
        code, version, size = _HEADER.unpack_from(raw)
        if version != VERSION:
            counters.version += 1
            self.other_version = version
            return None
        unpack = _UNPACK.get(code)
        if unpack is None:
            counters.unknown_type += 1
            return None
        frame = unpack(raw, size) if size == len(raw) - _OVERHEAD else None
        if frame is None:
            counters.length += 1
        else:
            counters.frames += 1
        return frame


def _array(name: str, value: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    if not isinstance(value, np.ndarray) or value.dtype != dtype or value.shape != shape:
        found = f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
        raise ProtocolError(f"{name} is {found}, must be an array of {dtype.name} {shape}; convert and round it first")
    return value
