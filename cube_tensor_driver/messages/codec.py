"""The codec of the batch messages: serialised bytes to rows, and rows to serialised bytes.

A message of a given number of rows, pads and letters in its frame id always has the same fields at
the same bytes (CDR, little-endian, OMG DDS-XTypes 7.4.1). So a numpy record type describes it, and
nothing here loops over rows. ROS is not imported: nodes and bags share this codec.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.errors import MessageError
from ..core.modes import COMPONENTS, STRESS
from ..core.rows import FrequencyRows, StressRows

SECOND = 1_000_000_000
LAYOUTS_KEPT = 32
"""Layouts of messages that a codec remembers."""
LITTLE_ENDIAN = b"\x00\x01\x00\x00"
PADS = -1
"""Width of a field that has one value per pad in each row."""
ONCE = 0
"""Width of a field that has one value per message."""
_SECONDS_AT = len(LITTLE_ENDIAN)
_FRAME_LENGTH_AT = _SECONDS_AT + 8
SHAPE_AT = _FRAME_LENGTH_AT
"""Where in a message `shape_bytes` are."""
_FRAME_AT = _FRAME_LENGTH_AT + 4

AnyRows = TypeVar("AnyRows", FrequencyRows, StressRows)


class _Field(NamedTuple):
    """A field behind the header. type: numpy's; width: values per row, or PADS, or ONCE."""

    name: str
    type: str
    width: int


_FREQUENCIES = (
    _Field("cube", "<u2", 1),
    _Field("sequence", "<u4", 1),
    _Field("time_offset", "<i4", 1),
    _Field("n_pads", "<u1", ONCE),
    _Field("frequency", "<f4", PADS),
    _Field("temperature", "<f4", 1),
    _Field("pad_fault", "<u4", 1),
    _Field("status", "<u2", 1),
)
_STRESS = (
    _Field("cube", "<u2", 1),
    _Field("sequence", "<u4", 1),
    _Field("time_offset", "<i4", 1),
    _Field("stress", "<f4", len(STRESS)),
    _Field("gradient", "<f4", len(COMPONENTS) - len(STRESS)),
    _Field("residual", "<f4", 1),
    _Field("status", "<u2", 1),
    _Field("observed", "<u2", 1),
    _Field("left_out", "<u4", 1),
)


class _Shape(NamedTuple):
    """What decides where the fields of a message are. frame: length of the frame id with its
    closing zero; pads: of a row, 0 in messages without pads."""

    frame: int
    rows: int
    pads: int


class _Item(NamedTuple):
    """Where a field is. count_at: where its number of values is, None if it has none."""

    field: _Field
    count_at: int | None
    at: int
    values: int


class _Layout(NamedTuple):
    """Messages of one shape. count_words: which 4-byte words hold the lengths of its sequences;
    counts: what they must be; names: of these sequences."""

    shape: _Shape
    record: np.dtype[Any]
    count_words: NDArray[np.intp]
    counts: NDArray[np.uint32]
    names: list[str]


@dataclass(frozen=True, slots=True)
class Decoded(Generic[AnyRows]):
    """M messages of one shape.

    rows: of all of them, message after message; views on the bytes of a single message
    stamp_ns: (M,) of their headers
    frame_id: of their headers, with its closing zero
    """

    rows: AnyRows
    stamp_ns: NDArray[np.int64]
    frame_id: bytes

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def select(self, chosen: slice) -> Decoded[AnyRows]:
        """Some of the messages, neighbours."""
        rows = len(self.rows) // len(self.stamp_ns)
        begin, end, _ = chosen.indices(len(self))
        part = self.rows.select(slice(begin * rows, end * rows))
        return Decoded(part, self.stamp_ns[chosen], self.frame_id)

    def by_message(self, column: NDArray[Any]) -> NDArray[Any]:
        """(M, rows, ...) a column of `rows`, message by message."""
        rows = len(self.rows) // len(self.stamp_ns)
        return column.reshape(len(self.stamp_ns), rows, *column.shape[1:])


class MessageBuffer(Generic[AnyRows]):
    """A serialised message of fixed shape, to be filled in place again and again.

    rows: write into its arrays. All but `stamp_ns` are views on the message's bytes.
    """

    def __init__(self, codec: MessageCodec[AnyRows], layout: _Layout, frame_id: bytes) -> None:
        self._record = np.zeros(1, layout.record)
        codec.write_constants(self._record, layout, frame_id)
        stamp_ns = np.zeros(layout.shape.rows, np.int64)
        self.rows: AnyRows = codec.make_rows(self._record, stamp_ns)
        self._time_offset = self._record["time_offset"][0]
        self._columns = [getattr(self.rows, field.name) for field in fields(self.rows)]
        self._names = [field.name for field in fields(self.rows)]

    def fill(self, rows: AnyRows) -> None:
        """Copy rows into it, as many as it was made for."""
        for name, column in zip(self._names, self._columns, strict=True):
            column[:] = getattr(rows, name)

    def data(self, stamp_ns: int | None = None) -> bytes:
        """The message as it is now. stamp_ns: of its header; None: that of the earliest row."""
        times_ns = self.rows.stamp_ns
        if stamp_ns is None:
            stamp_ns = int(times_ns.min())
        self._time_offset[:] = times_ns - stamp_ns
        self._record["sec"], self._record["nanosec"] = divmod(stamp_ns, SECOND)
        return self._record.tobytes()


class MessageCodec(Generic[AnyRows]):
    """Decodes and encodes one type of message."""

    def __init__(self, name: str, rows: type[AnyRows], message_fields: tuple[_Field, ...]) -> None:
        self._name = name
        self._rows: type[AnyRows] = rows
        self._fields = message_fields
        names = [field.name for field in fields(rows)]
        self._values = [
            field.name for field in message_fields if field.name in names[names.index("stamp_ns") :]
        ]
        field_names = [field.name for field in message_fields]
        self._has_pads = "n_pads" in field_names
        self._before_pads = field_names.index("n_pads") if self._has_pads else 0
        self._end = lru_cache(LAYOUTS_KEPT)(self._find_end)
        self._layout = lru_cache(LAYOUTS_KEPT)(self._make_layout)

    def decode(self, *messages: bytes) -> Decoded[AnyRows]:
        """The rows of serialised messages, one or several of the same shape (`shape_bytes`).

        MessageError: too short, fields that contradict each other, or shapes that differ.
        """
        layout, record = self._records(messages)
        stamp_ns, times_ns = _stamps(record)
        rows: AnyRows = self.make_rows(record, times_ns)
        frame_id = messages[0][_FRAME_AT : _FRAME_AT + layout.shape.frame]
        return Decoded(rows, stamp_ns, frame_id)

    def decode_columns(self, names: Sequence[str], *messages: bytes) -> list[NDArray[Any]]:
        """`stamp_ns` and the named columns of what `decode` gives: it does not copy the others."""
        record: NDArray[Any] = self._records(messages)[1]
        return [_stamps(record)[1], *(_flat(record, name) for name in names)]

    def shape_bytes(self, data: bytes) -> bytes:
        """Frame id and number of rows. Messages of one length that have the same bytes at SHAPE_AT
        can be decoded together."""
        frame = int.from_bytes(data[_FRAME_LENGTH_AT:_FRAME_AT], "little")
        return data[SHAPE_AT : _aligned(_FRAME_AT + frame) + 4]

    def buffer(self, frame_id: bytes, rows: int, pads: int = 0) -> MessageBuffer[AnyRows]:
        """A message to fill. frame_id: with its closing zero; pads: of a row of frequencies."""
        return MessageBuffer(self, self._layout(_Shape(len(frame_id), rows, pads)), frame_id)

    def encode(self, rows: AnyRows, frame_id: bytes, stamp_ns: int | None = None) -> bytes:
        """One message of rows; arguments as in `MessageBuffer`."""
        pads = rows.frequency.shape[1] if isinstance(rows, FrequencyRows) else 0
        buffer = self.buffer(frame_id, len(rows), pads)
        buffer.fill(rows)
        return buffer.data(stamp_ns)

    def encode_many(
        self, rows: AnyRows, stamp_ns: NDArray[np.int64], frame_id: bytes
    ) -> list[bytes]:
        """M messages of one shape.

        rows: of all of them, message after message; stamp_ns: (M,) of their headers.
        """
        count = len(stamp_ns)
        pads = rows.frequency.shape[1] if isinstance(rows, FrequencyRows) else 0
        layout = self._layout(_Shape(len(frame_id), len(rows) // count, pads))
        record = np.zeros(count, layout.record)
        self.write_constants(record, layout, frame_id)
        record["sec"], record["nanosec"] = np.divmod(stamp_ns, SECOND)
        record["time_offset"] = rows.stamp_ns.reshape(count, -1) - stamp_ns[:, None]
        for name in ("cube", "sequence", *self._values):
            record[name] = getattr(rows, name).reshape(record[name].shape)
        return [one.tobytes() for one in record]

    def make_rows(self, record: NDArray[Any], stamp_ns: NDArray[np.int64]) -> AnyRows:
        """The rows of records (M,): views of a single one, copies of several."""
        columns: list[NDArray[Any]] = [_flat(record, "cube"), _flat(record, "sequence"), stamp_ns]
        columns += [_flat(record, name) for name in self._values]
        return self._rows(*columns)

    def write_constants(self, record: NDArray[Any], layout: _Layout, frame_id: bytes) -> None:
        """Write into records (M,) what all messages of a layout have in common."""
        record["encapsulation"] = LITTLE_ENDIAN
        record["frame_id"] = np.void(frame_id)
        for name, values in zip(layout.names, layout.counts.tolist(), strict=True):
            record[f"length of {name}"] = values
        if self._has_pads:
            record["n_pads"] = layout.shape.pads

    def _records(self, messages: Sequence[bytes]) -> tuple[_Layout, NDArray[Any]]:
        """Messages of one shape as records (M,). MessageError: as `decode`."""
        layout = self._layout(self._shape(messages[0]))
        size, count = layout.record.itemsize, len(messages)
        data = messages[0]
        if count > 1:
            data = b"".join(message[:size] for message in messages)
            if len(data) != count * size:
                raise MessageError(f"{self._name}: {count} messages of different lengths")
        self._check(layout, data, count)
        record: NDArray[Any] = np.frombuffer(data, layout.record, count)
        return layout, record

    def _shape(self, data: bytes) -> _Shape:
        """MessageError: too short, or its length is not that of so many rows."""
        if len(data) < _FRAME_AT + 4 or data[:2] != LITTLE_ENDIAN[:2]:
            raise MessageError(
                f"{self._name} of {len(data)} bytes that begin with {data[:4].hex()}: "
                "not little-endian CDR"
            )
        (frame,) = struct.unpack_from("<I", data, _FRAME_LENGTH_AT)
        rows_at = _aligned(_FRAME_AT + frame)
        if rows_at + 4 > len(data):
            raise MessageError(
                f"{self._name} of {len(data)} bytes says its frame id has {frame}: damaged"
            )
        (rows,) = struct.unpack_from("<I", data, rows_at)
        pads = 0
        if self._has_pads:
            pads_at = self._end(_Shape(frame, rows, 0), self._before_pads)
            pads = data[pads_at] if pads_at < len(data) else 0
        shape = _Shape(frame, rows, pads)
        # Middleware may add up to three bytes at the end. Nothing of a size that the message only
        # claims is made before this.
        if not 0 <= len(data) - self._end(shape, len(self._fields)) < 4:
            raise MessageError(
                f"{self._name} of {len(data)} bytes says it has {rows} rows of {pads} pads: "
                "damaged, or of another version of the messages"
            )
        return shape

    def _check(self, layout: _Layout, data: bytes, count: int) -> None:
        """MessageError: a sequence does not have as many values as the rows need."""
        size, expected = layout.record.itemsize, layout.counts
        words = np.ndarray((count, size // 4), "<u4", data, 0, (size, 4))
        counts = words.take(layout.count_words, axis=1)
        # Comparing bytes takes a third of the time that comparing arrays takes.
        if counts.tobytes() == expected.tobytes() * count:
            return
        message, which = np.argwhere(counts != expected)[0].tolist()
        raise MessageError(
            f"{self._name} of {layout.shape.rows} rows has {counts[message, which]} values of "
            f"{layout.names[which]}, they need {expected[which]}"
        )

    def _find_end(self, shape: _Shape, count: int) -> int:
        """Where the first fields of a message end."""
        return self._items(shape, count)[1]

    def _items(self, shape: _Shape, count: int) -> tuple[list[_Item], int]:
        """Where the first fields of a message are, and where they end. Only integers of Python are
        made: the shape may be a wrong claim."""
        items = []
        end = _FRAME_AT + shape.frame
        for field in self._fields[:count]:
            count_at, values = None, 1
            if field.width != ONCE:
                count_at, end = _aligned(end), _aligned(end) + 4
                values = shape.rows * (shape.pads if field.width == PADS else field.width)
            items.append(_Item(field, count_at, end, values))
            end += values * int(field.type[-1])
        return items, end

    def _make_layout(self, shape: _Shape) -> _Layout:
        items, size = self._items(shape, len(self._fields))
        names = ["encapsulation", "sec", "nanosec", "length of frame_id", "frame_id"]
        formats: list[Any] = ["S4", "<i4", "<u4", "<u4", f"V{shape.frame}"]
        offsets = [0, _SECONDS_AT, _SECONDS_AT + 4, _FRAME_LENGTH_AT, _FRAME_AT]
        for field, count_at, at, _ in items:
            if count_at is not None:
                names.append(f"length of {field.name}")
                formats.append("<u4")
                offsets.append(count_at)
            names.append(field.name)
            formats.append((field.type, _dimensions(field.width, shape)))
            offsets.append(at)
        record = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
        )
        counted: list[_Item] = [item for item in items if item.count_at is not None]
        counts_at = [_FRAME_LENGTH_AT, *(item.count_at or 0 for item in counted)]
        return _Layout(
            shape,
            record,
            np.array(counts_at) // 4,
            np.array([shape.frame, *(item.values for item in counted)], "<u4"),
            ["frame_id", *(item.field.name for item in counted)],
        )


def _dimensions(width: int, shape: _Shape) -> tuple[int, ...]:
    if width == ONCE:
        return ()
    if width == 1:
        return (shape.rows,)
    return (shape.rows, shape.pads if width == PADS else width)


def _stamps(record: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of records (M,): their stamps, and those of all their rows one after the other."""
    stamp_ns = record["sec"].astype(np.int64) * SECOND + record["nanosec"]
    return stamp_ns, (stamp_ns[:, None] + record["time_offset"]).reshape(-1)


def _flat(record: NDArray[Any], name: str) -> NDArray[Any]:
    """A field of records (M,), the rows of all of them one after the other."""
    values = record[name]
    if len(record) == 1:
        return values[0]  # type: ignore[no-any-return]
    return values.reshape(-1, *values.shape[2:])


def _aligned(place: int) -> int:
    return -(-place // 4) * 4


frequency_codec = MessageCodec("SkinFrequencies", FrequencyRows, _FREQUENCIES)
stress_codec = MessageCodec("SkinStress", StressRows, _STRESS)
