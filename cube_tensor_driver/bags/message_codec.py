"""Batch messages as numpy records: serialised messages of one shape are one array, read and made
without a loop.

A message of so many rows, pads and letters in its frame id always has the same bytes in the same
places (CDR, little-endian, OMG DDS-XTypes 7.4.1), so a record type says where every field is. Does
not import ROS.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import MessageError
from ..core.modes import COMPONENTS, STRESS

SECOND = 1_000_000_000
SHAPES_KEPT = 32
"""Record types remembered at a time."""
LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_START = len(LITTLE_ENDIAN)
_FIRST_COUNT = _START + 8  # after sec and nanosec: length of the frame id
# What follows the header: name, type, width of a row (0: one value of the message).
_FREQUENCIES = (
    ("cube", "u2", 1),
    ("sequence", "u4", 1),
    ("time_offset", "i4", 1),
    ("n_pads", "u1", 0),
    ("frequency", "f4", -1),
    ("temperature", "f4", 1),
    ("pad_fault", "u4", 1),
)
_STRESS = (
    ("cube", "u2", 1),
    ("sequence", "u4", 1),
    ("time_offset", "i4", 1),
    ("stress", "f4", len(STRESS)),
    ("gradient", "f4", len(COMPONENTS) - len(STRESS)),
    ("residual", "f4", 1),
    ("status", "u2", 1),
    ("observed", "u2", 1),
    ("left_out", "u4", 1),
)
_STRESS_1 = _STRESS[:-1]
"""Of version 1 of the messages."""


class Shape(NamedTuple):
    """What fixes a message's bytes: length of the frame id with its closing zero, rows, pads of a
    row."""

    frame: int
    rows: int
    pads: int


class Batch(NamedTuple):
    """B messages of one shape. stamp_ns (B,); fields as in the message file, (B, rows) or (B, rows,
    width), views."""

    shape: Shape
    stamp_ns: NDArray[np.int64]
    field: NDArray[Any]

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """(B, rows) when each row was sampled."""
        times: NDArray[np.int64] = self.stamp_ns[:, None] + self.field["time_offset"].astype(
            np.int64
        )
        return times

    @property
    def newest_ns(self) -> NDArray[np.int64]:
        """(B,) when the newest row of each message was sampled; its stamp where it has none."""
        newest: NDArray[np.int64] = self.stamp_ns + self.field["time_offset"].max(axis=1, initial=0)
        return newest


class MessageBuffer:
    """A serialised message of one shape to fill in place, again and again. field: views on its
    bytes, by name."""

    def __init__(
        self, fields: tuple[tuple[str, str, int], ...], shape: Shape, frame_id: bytes
    ) -> None:
        self._record = np.zeros(1, _record(fields, shape))
        self.field: dict[str, NDArray[Any]] = {
            name: self._record[name][0] for name, _, width in fields if width
        }
        self._record["encapsulation"] = LITTLE_ENDIAN
        self._record["n of frame_id"] = shape.frame
        self._record["frame_id"] = np.void(frame_id)
        for name, _, width in fields:
            if width:
                self._record[f"n of {name}"] = shape.rows * (shape.pads if width < 0 else width)
            elif name == "n_pads":
                self._record[name] = shape.pads

    def fill(self, *values: NDArray[Any]) -> None:
        """Set all fields, in the order of the message."""
        for field, value in zip(self.field.values(), values, strict=True):
            field[:] = value

    def data(self, stamp_ns: int) -> bytes:
        """The message as it is now, stamped."""
        self._record["sec"], self._record["nanosec"] = divmod(stamp_ns, SECOND)
        return self._record.tobytes()


def frequencies_buffer(frame_id: bytes, rows: int, pads: int) -> MessageBuffer:
    """A SkinFrequencies to fill; frame_id with its closing zero."""
    return MessageBuffer(_FREQUENCIES, Shape(len(frame_id), rows, pads), frame_id)


def stress_buffer(frame_id: bytes, rows: int) -> MessageBuffer:
    """A SkinStress to fill; frame_id with its closing zero."""
    return MessageBuffer(_STRESS, Shape(len(frame_id), rows, 0), frame_id)


@lru_cache(maxsize=SHAPES_KEPT)
def _record(fields: tuple[tuple[str, str, int], ...], shape: Shape) -> np.dtype[Any]:
    """The record type of a shape. Counts of sequences are fields named `n of` them."""
    names = ["encapsulation", "sec", "nanosec", "n of frame_id", "frame_id"]
    formats: list[Any] = ["S4", "<i4", "<u4", "<u4", f"V{shape.frame}"]
    offsets = [0, _START, _START + 4, _FIRST_COUNT, _FIRST_COUNT + 4]
    place = _FIRST_COUNT + 4 + shape.frame
    for name, kind, width in fields:
        item = np.dtype(f"<{kind}")
        if width:
            place = -(-place // 4) * 4
            names.append(f"n of {name}")
            formats.append("<u4")
            offsets.append(place)
            place += 4
        names.append(name)
        offsets.append(place)
        columns = shape.pads if width < 0 else width
        each = () if not width else (shape.rows,) if width == 1 else (shape.rows, columns)
        formats.append((f"<{kind}", each))
        place += item.itemsize * (shape.rows * columns if width else 1)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": place})


@lru_cache(maxsize=SHAPES_KEPT)
def _counts(
    fields: tuple[tuple[str, str, int], ...], shape: Shape
) -> tuple[np.dtype[Any], list[str], NDArray[np.intp], NDArray[Any]]:
    """The record type of a shape; of its fields with a count: their names, at which word it stands,
    what it must be."""
    record = _record(fields, shape)
    widths = {name: shape.pads if width < 0 else width for name, _, width in fields if width}
    places = [record.fields[f"n of {name}"][1] // 4 for name in widths]  # type: ignore[index]
    return (
        record,
        list(widths),
        np.array(places),
        shape.rows * np.array(list(widths.values()), "<u4"),
    )


def frequencies_shape(data: bytes) -> Shape:
    """Shape of a serialised SkinFrequencies. MessageError: too short, or its fields contradict each
    other."""
    frame, rows = _begin(data)
    record = _record(_FREQUENCIES, Shape(frame, rows, 0))
    place = record.fields["n_pads"][1]  # type: ignore[index]
    return _checked(data, _FREQUENCIES, Shape(frame, rows, data[place] if place < len(data) else 0))


def stress_shape(data: bytes, version: int = 2) -> Shape:
    """Shape of a serialised SkinStress. MessageError: too short, or its fields contradict each
    other."""
    return _checked(data, _STRESS_1 if version == 1 else _STRESS, Shape(*_begin(data), 0))


def same_shape(one: bytes, other: bytes, shape: Shape) -> bool:
    """Whether a message of a type has the shape that another one has; what else its bytes say,
    reading checks."""
    # From the frame id's length to the number of rows.
    end = -(-(_FIRST_COUNT + 4 + shape.frame) // 4) * 4 + 4
    return len(one) == len(other) and one[_FIRST_COUNT:end] == other[_FIRST_COUNT:end]


def read_frequencies(data: Sequence[bytes], shape: Shape) -> Batch:
    """Serialised SkinFrequencies of one shape. MessageError: fields contradict each other."""
    return _read(data, _FREQUENCIES, shape)


def read_stress(data: Sequence[bytes], shape: Shape, version: int = 2) -> Batch:
    """Serialised SkinStress of one shape; version 1 has no left_out. MessageError: fields
    contradict each other."""
    return _read(data, _STRESS_1 if version == 1 else _STRESS, shape)


def stress_messages(
    batch: Batch, rows: Sequence[NDArray[Any]], before: int = 0
) -> NDArray[np.uint8]:
    """The serialised SkinStress of each SkinFrequencies of a batch, each behind so many bytes: (B,
    before + bytes).

    rows: stress, gradient, residual, status, observed of all rows of the batch in order, as a
    pipeline gives them, and the pads left out of each.
    """
    record = _record(_STRESS, batch.shape._replace(pads=0))
    made = np.zeros((len(batch.field), before + record.itemsize), np.uint8)
    out = np.ndarray(len(made), record, made.data, before, made.strides[:1])
    for name in ("encapsulation", "sec", "nanosec", "frame_id", "cube", "sequence", "time_offset"):
        out[name] = batch.field[name]
    out["n of frame_id"] = batch.shape.frame
    for (name, _, _), values in zip(_STRESS[3:], rows, strict=True):
        out[name] = np.reshape(values, out[name].shape)
    for name, _, width in _STRESS:
        out[f"n of {name}"] = batch.shape.rows * width
    return made


def stress_of_today(data: bytes) -> bytes:
    """A serialised SkinStress of version 1 as one of today. MessageError: damaged."""
    shape = stress_shape(data, version=1)
    size = _record(_STRESS_1, shape).itemsize
    return data[:size] + bytes(-size % 4) + struct.pack("<I", shape.rows) + bytes(4 * shape.rows)


def _begin(data: bytes) -> tuple[int, int]:
    """Length of the frame id, number of rows."""
    if len(data) < _FIRST_COUNT + 8 or data[:2] != LITTLE_ENDIAN[:2]:
        raise MessageError(
            f"a batch message of {len(data)} bytes that begin with {data[:4].hex()}: not little-endian CDR"
        )
    (frame,) = struct.unpack_from("<I", data, _FIRST_COUNT)
    place = -(-(_FIRST_COUNT + 4 + frame) // 4) * 4
    if place + 4 > len(data):
        raise MessageError(
            f"a batch message of {len(data)} bytes says its frame id has {frame}: damaged"
        )
    return frame, struct.unpack_from("<I", data, place)[0]


def _checked(data: bytes, fields: tuple[tuple[str, str, int], ...], shape: Shape) -> Shape:
    # Middleware may fill up to four bytes at the end; the bound on rows comes before a record type
    # is made.
    if shape.rows <= len(data) and 0 <= len(data) - _record(fields, shape).itemsize < 4:
        return shape
    raise MessageError(
        f"a batch message of {len(data)} bytes says it has {shape.rows} rows of {shape.pads} pads: damaged, or of "
        "another version of the messages"
    )


def _read(data: Sequence[bytes], fields: tuple[tuple[str, str, int], ...], shape: Shape) -> Batch:
    record, names, places, expected = _counts(fields, shape)
    size = record.itemsize
    whole = b"".join(data if len(data[0]) == size else [one[:size] for one in data])
    counts = np.ndarray((len(data), size // 4), "<u4", whole, 0, (size, 4)).take(places, axis=1)
    # Bytes, because one comparison of arrays costs as much as all the rest here.
    if counts.tobytes() != expected.tobytes() * len(data):
        message, which = np.argwhere(counts != expected)[0].tolist()
        raise MessageError(
            f"a message of {shape.rows} rows has {counts[message, which]} values of {names[which]}, "
            f"they need {expected[which]}"
        )
    field = np.frombuffer(whole, record)
    return Batch(shape, field["sec"].astype(np.int64) * SECOND + field["nanosec"], field)
