"""The codec of the batch messages: serialised bytes to rows, and rows to serialised bytes.

Two messages with the same number of rows and pads, and frame ids of the same length, have their
fields at the same bytes. So a record type of numpy describes all of them, and nothing here loops
over rows. The bytes are little-endian CDR (OMG DDS-XTypes 7.4.1): a sequence begins with its number
of values as 4 bytes, at a multiple of 4.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import AnyArray, Index, Times
from ..core.errors import MessageError
from ..core.modes import GRADIENT, STRESS
from ..core.rows import FrequencyRows, StressRows

SECOND = 1_000_000_000
"""One second, in ns."""

MAX_CACHED_LAYOUTS = 32
"""Number of layouts of messages that a codec keeps in memory.

There is one per skin and number of scans in a message.
"""

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
"""First bytes of a message in little-endian CDR."""

PER_PAD = -1
"""Value of `_Field.width` for a field that has one value per pad in each row."""

PER_MESSAGE = 0
"""Value of `_Field.width` for a field that has one value per message."""

_SECONDS_AT = len(LITTLE_ENDIAN)
_NANOSECONDS_AT = _SECONDS_AT + 4
_FRAME_LENGTH_AT = _NANOSECONDS_AT + 4
_FRAME_AT = _FRAME_LENGTH_AT + 4

SHAPE_AT = _FRAME_LENGTH_AT
"""Place in a message of the bytes that `MessageCodec.shape_bytes` returns."""

AnyRows = TypeVar("AnyRows", FrequencyRows, StressRows)


class _Field(NamedTuple):
    """A field behind the header.

    Attributes:
        name: Name in the message definition.
        type: numpy's name of the type of a value, whose last character is its size in bytes.
        width: Number of values per row, or PER_PAD, or PER_MESSAGE.
    """

    name: str
    type: str
    width: int


_FREQUENCIES = (
    _Field("cube", "<u2", 1),
    _Field("sequence", "<u4", 1),
    _Field("time_offset", "<i4", 1),
    _Field("n_pads", "<u1", PER_MESSAGE),
    _Field("frequency", "<f4", PER_PAD),
    _Field("temperature", "<f4", 1),
    _Field("pad_fault", "<u4", 1),
    _Field("status", "<u2", 1),
)
_STRESS = (
    _Field("cube", "<u2", 1),
    _Field("sequence", "<u4", 1),
    _Field("time_offset", "<i4", 1),
    _Field("stress", "<f4", len(STRESS)),
    _Field("gradient", "<f4", len(GRADIENT)),
    _Field("residual", "<f4", 1),
    _Field("status", "<u2", 1),
    _Field("observed", "<u2", 1),
    _Field("left_out", "<u4", 1),
)


class _Shape(NamedTuple):
    """What determines the places of the fields of a message.

    Attributes:
        frame: Length of the frame id including its closing zero.
        rows: Number of rows.
        pads: Number of pads of a row; 0 in messages without pads.
    """

    frame: int
    rows: int
    pads: int


class _Place(NamedTuple):
    """The place of a field in a message.

    Attributes:
        field: The field.
        count_at: Place of its number of values; None if it is no sequence.
        at: Place of its values.
        values: Number of values.
    """

    field: _Field
    count_at: int | None
    at: int
    values: int


class _Layout(NamedTuple):
    """The layout of all messages of one shape.

    Attributes:
        shape: The shape.
        record: Record type of a message.
        sequences: Names of the sequences, `frame_id` first.
        counts: Numbers of values that these sequences must have.
        count_words: Places of these numbers, in units of 4 bytes.
    """

    shape: _Shape
    record: np.dtype[Any]
    sequences: list[str]
    counts: NDArray[np.uint32]
    count_words: Index


@dataclass(frozen=True, slots=True)
class Decoded(Generic[AnyRows]):
    """M messages of one shape.

    Attributes:
        rows: Rows of all messages, message after message. Those of a single message are views of
            its bytes.
        stamp_ns: Time stamps of the headers (M,), in ns.
        frame_id: Frame id of the headers, with its closing zero.
    """

    rows: AnyRows
    stamp_ns: Times
    frame_id: bytes

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def select(self, chosen: slice) -> Decoded[AnyRows]:
        """Return some neighbouring messages."""
        n_rows = len(self.rows) // len(self)
        begin, end, _ = chosen.indices(len(self))
        rows = self.rows.select(slice(begin * n_rows, end * n_rows))
        return Decoded(rows, self.stamp_ns[chosen], self.frame_id)

    def by_message(self, column: AnyArray) -> AnyArray:
        """Return a column of `rows` as (M, rows, ...), message by message."""
        return column.reshape(len(self), -1, *column.shape[1:])


class MessageBuffer(Generic[AnyRows]):
    """A serialised message of fixed shape that is filled in place again and again.

    Attributes:
        rows: Rows to write into. All columns but `stamp_ns` are views of the bytes of the message.
    """

    def __init__(
        self,
        codec: MessageCodec[AnyRows],
        layout: _Layout,
        frame_id: bytes,
    ) -> None:
        self._record = np.zeros(1, layout.record)
        codec.write_constants(self._record, layout, frame_id)
        stamp_ns = np.zeros(layout.shape.rows, np.int64)
        self.rows: AnyRows = codec.make_rows(self._record, stamp_ns)
        self._time_offset = self._record["time_offset"][0]
        # Looked up here once, because this takes as long as copying the rows of a small skin.
        self._names = [field.name for field in fields(self.rows)]
        self._columns = [getattr(self.rows, name) for name in self._names]

    def fill(self, rows: AnyRows) -> None:
        """Copy rows into the message; their number must be that of the buffer."""
        for name, column in zip(self._names, self._columns, strict=True):
            column[:] = getattr(rows, name)

    def data(self, stamp_ns: int | None = None) -> bytes:
        """Return the message as it is now.

        Args:
            stamp_ns: Time stamp of the header, in ns. None stands for that of the earliest row.
        """
        times_ns = self.rows.stamp_ns
        if stamp_ns is None:
            stamp_ns = int(times_ns.min())
        self._time_offset[:] = times_ns - stamp_ns
        self._record["sec"], self._record["nanosec"] = divmod(stamp_ns, SECOND)
        return self._record.tobytes()


class MessageCodec(Generic[AnyRows]):
    """Decodes and encodes one type of message."""

    def __init__(
        self,
        name: str,
        rows: type[AnyRows],
        message_fields: tuple[_Field, ...],
    ) -> None:
        """Describe a type of message.

        Args:
            name: Name for error messages.
            rows: Type of the rows.
            message_fields: Fields behind the header, in order.
        """
        self._name = name
        self._rows: type[AnyRows] = rows
        self._columns = [field.name for field in fields(rows)]
        self._fields = message_fields
        names = [field.name for field in message_fields]
        self._n_fields_before_pads = names.index("n_pads") if "n_pads" in names else None
        self._find_end = lru_cache(MAX_CACHED_LAYOUTS)(self._compute_end)
        self._find_layout = lru_cache(MAX_CACHED_LAYOUTS)(self._make_layout)

    def decode(self, *messages: bytes) -> Decoded[AnyRows]:
        """Decode one or several serialised messages of the same shape (`shape_bytes`).

        Raises:
            MessageError: A message is too short, its fields contradict each other, or the shapes
                differ.
        """
        layout, record = self._read_records(messages)
        stamp_ns, times_ns = _read_stamps(record)
        rows: AnyRows = self.make_rows(record, times_ns)
        frame_id = messages[0][_FRAME_AT : _FRAME_AT + layout.shape.frame]
        return Decoded(rows, stamp_ns, frame_id)

    def decode_columns(self, names: Sequence[str], *messages: bytes) -> list[AnyArray]:
        """Decode only `stamp_ns` and the named columns of the rows, without copying the others."""
        record: AnyArray = self._read_records(messages)[1]
        _, times_ns = _read_stamps(record)
        return [times_ns, *(_read_column(record, name) for name in names)]

    def shape_bytes(self, data: bytes) -> bytes:
        """Return the bytes at `SHAPE_AT` that hold frame id and number of rows.

        Messages of one length that agree in these bytes can be decoded together.
        """
        frame = int.from_bytes(data[_FRAME_LENGTH_AT:_FRAME_AT], "little")
        end = _align(_FRAME_AT + frame) + 4
        return data[SHAPE_AT:end]

    def buffer(
        self,
        frame_id: bytes,
        rows: int,
        pads: int = 0,
    ) -> MessageBuffer[AnyRows]:
        """Return a message to fill.

        Args:
            frame_id: Frame id with its closing zero.
            rows: Number of rows.
            pads: Number of pads of a row of frequencies; 0 for rows of stress.
        """
        layout = self._find_layout(_Shape(len(frame_id), rows, pads))
        return MessageBuffer(self, layout, frame_id)

    def encode(
        self,
        rows: AnyRows,
        frame_id: bytes,
        stamp_ns: int | None = None,
    ) -> bytes:
        """Encode rows as one message.

        Args:
            rows: The rows.
            frame_id: Frame id with its closing zero.
            stamp_ns: Time stamp of the header, in ns. None stands for that of the earliest row.
        """
        if stamp_ns is None:
            stamp_ns = int(rows.stamp_ns.min())
        return self.encode_many(rows, np.array([stamp_ns]), frame_id)[0]

    def encode_many(
        self,
        rows: AnyRows,
        stamp_ns: Times,
        frame_id: bytes,
    ) -> list[bytes]:
        """Encode rows as M messages of one shape.

        Args:
            rows: Rows of all messages, message after message.
            stamp_ns: Time stamps of the headers (M,), in ns.
            frame_id: Frame id with its closing zero.
        """
        count = len(stamp_ns)
        pads = rows.frequency.shape[1] if isinstance(rows, FrequencyRows) else 0
        shape = _Shape(len(frame_id), len(rows) // count, pads)
        layout = self._find_layout(shape)
        record = np.zeros(count, layout.record)
        self.write_constants(record, layout, frame_id)
        record["sec"], record["nanosec"] = np.divmod(stamp_ns, SECOND)
        # 4 bytes hold the time of a row only as the distance from the stamp of its message.
        times_ns = rows.stamp_ns.reshape(count, -1)
        record["time_offset"] = times_ns - stamp_ns[:, None]
        for name in self._columns:
            if name != "stamp_ns":
                record[name] = getattr(rows, name).reshape(record[name].shape)
        return [message.tobytes() for message in record]

    def make_rows(self, record: AnyArray, stamp_ns: Times) -> AnyRows:
        """Return the rows of records (M,): views of a single one, copies of several."""
        columns: dict[str, AnyArray] = {
            name: stamp_ns if name == "stamp_ns" else _read_column(record, name)
            for name in self._columns
        }
        return self._rows(**columns)

    def write_constants(
        self,
        record: AnyArray,
        layout: _Layout,
        frame_id: bytes,
    ) -> None:
        """Write what all messages of a layout have in common into records (M,)."""
        record["encapsulation"] = LITTLE_ENDIAN
        # Void data keep the closing zero, which numpy removes from strings of bytes.
        record["frame_id"] = np.void(frame_id)
        for name, count in zip(layout.sequences, layout.counts.tolist(), strict=True):
            record[f"length of {name}"] = count
        if self._n_fields_before_pads is not None:
            record["n_pads"] = layout.shape.pads

    def _read_records(self, messages: Sequence[bytes]) -> tuple[_Layout, AnyArray]:
        """Return messages of one shape as records (M,). MessageError: see `decode`."""
        layout = self._find_layout(self._read_shape(messages[0]))
        size, count = layout.record.itemsize, len(messages)
        data = messages[0]
        if count > 1:
            # Bytes that middleware has added at the end are cut off.
            data = b"".join(message[:size] for message in messages)
            if len(data) != count * size:
                raise MessageError(
                    f"{self._name}: {count} messages of different lengths; decode them one by one"
                )
        self._check_counts(layout, data, count)
        record: AnyArray = np.frombuffer(data, layout.record, count)
        return layout, record

    def _read_shape(self, data: bytes) -> _Shape:
        """Return the shape that a message states.

        Raises:
            MessageError: It is too short, or its length does not belong to this shape.
        """
        if len(data) < _FRAME_AT + 4 or data[:2] != LITTLE_ENDIAN[:2]:
            raise MessageError(
                f"{self._name} of {len(data)} bytes that begin with {data[:4].hex()}: "
                "not little-endian CDR"
            )
        (frame,) = struct.unpack_from("<I", data, _FRAME_LENGTH_AT)
        rows_at = _align(_FRAME_AT + frame)
        if rows_at + 4 > len(data):
            raise MessageError(
                f"{self._name} of {len(data)} bytes says its frame id has {frame}: damaged"
            )
        # The first sequence has one value per row.
        (rows,) = struct.unpack_from("<I", data, rows_at)
        pads = 0
        if self._n_fields_before_pads is not None:
            pads_at = self._find_end(_Shape(frame, rows, 0), self._n_fields_before_pads)
            # Only as long as the message has that byte; a wrong length is refused below.
            pads = data[pads_at] if pads_at < len(data) else 0
        shape = _Shape(frame, rows, pads)
        # Middleware may add up to three bytes at the end. Before this check nothing is allocated,
        # because a damaged message may state any number of rows.
        n_extra = len(data) - self._find_end(shape, len(self._fields))
        if not 0 <= n_extra < 4:
            raise MessageError(
                f"{self._name} of {len(data)} bytes says it has {rows} rows of {pads} pads: "
                "damaged, or of another version of the messages"
            )
        return shape

    def _check_counts(
        self,
        layout: _Layout,
        data: bytes,
        count: int,
    ) -> None:
        """Raise MessageError if a sequence does not have as many values as the rows need."""
        size, expected = layout.record.itemsize, layout.counts
        # The size of a message need not be a multiple of 4, so the rows of this view of words are
        # `size` bytes apart.
        words = np.ndarray((count, size // 4), "<u4", data, 0, (size, 4))
        counts = words.take(layout.count_words, axis=1)
        # Comparing bytes takes a third of the time that comparing arrays takes.
        if counts.tobytes() == expected.tobytes() * count:
            return
        message, which = np.argwhere(counts != expected)[0].tolist()
        raise MessageError(
            f"{self._name} of {layout.shape.rows} rows has {counts[message, which]} values of "
            f"{layout.sequences[which]}, they need {expected[which]}"
        )

    def _compute_end(self, shape: _Shape, n_fields: int) -> int:
        """Return the place where the first fields of a message end."""
        _, end = self._place_fields(shape, n_fields)
        return end

    def _place_fields(self, shape: _Shape, n_fields: int) -> tuple[list[_Place], int]:
        """Return the places of the first fields of a message, and where they end.

        Only integers are computed, because a damaged message may state any shape.
        """
        places = []
        end = _FRAME_AT + shape.frame
        for field in self._fields[:n_fields]:
            count_at, values = None, 1
            if field.width != PER_MESSAGE:
                # The values follow their number without a gap, as none is wider than 4 bytes.
                count_at = _align(end)
                end = count_at + 4
                width = shape.pads if field.width == PER_PAD else field.width
                values = shape.rows * width
            places.append(_Place(field, count_at, end, values))
            end += values * int(field.type[-1])
        return places, end

    def _make_layout(self, shape: _Shape) -> _Layout:
        places, size = self._place_fields(shape, len(self._fields))
        # Name, type and place of each entry of the record.
        entries: list[tuple[str, Any, int]] = [
            ("encapsulation", "S4", 0),
            ("sec", "<i4", _SECONDS_AT),
            ("nanosec", "<u4", _NANOSECONDS_AT),
            ("length of frame_id", "<u4", _FRAME_LENGTH_AT),
            ("frame_id", f"V{shape.frame}", _FRAME_AT),
        ]
        sequences = ["frame_id"]
        counts = [shape.frame]
        counts_at = [_FRAME_LENGTH_AT]
        for field, count_at, at, values in places:
            if count_at is not None:
                entries.append((f"length of {field.name}", "<u4", count_at))
                sequences.append(field.name)
                counts.append(values)
                counts_at.append(count_at)
            form = (field.type, _dimensions(field.width, shape))
            entries.append((field.name, form, at))
        names, formats, offsets = zip(*entries, strict=True)
        record = np.dtype(
            {
                "names": names,
                "formats": formats,
                "offsets": offsets,
                "itemsize": size,
            }
        )
        return _Layout(
            shape=shape,
            record=record,
            sequences=sequences,
            counts=np.array(counts, "<u4"),
            count_words=np.array(counts_at) // 4,
        )


def _dimensions(width: int, shape: _Shape) -> tuple[int, ...]:
    """Return the shape of a field's values in one message."""
    if width == PER_MESSAGE:
        return ()
    if width == 1:
        return (shape.rows,)
    return (shape.rows, shape.pads if width == PER_PAD else width)


def _read_stamps(record: AnyArray) -> tuple[Times, Times]:
    """Return the time stamps of records (M,), and those of all their rows one after the other."""
    seconds = record["sec"].astype(np.int64)
    stamp_ns: Times = seconds * SECOND + record["nanosec"]
    times_ns: Times = stamp_ns[:, None] + record["time_offset"]
    return stamp_ns, times_ns.reshape(-1)


def _read_column(record: AnyArray, name: str) -> AnyArray:
    """Return a field of records (M,), with the rows of all of them one after the other."""
    values: AnyArray = record[name]
    if len(record) == 1:
        # A single message is not copied, which matters in the nodes.
        view: AnyArray = values[0]
        return view
    return values.reshape(-1, *values.shape[2:])


def _align(place: int) -> int:
    """Round a place up to a multiple of 4."""
    return -(-place // 4) * 4


frequency_codec = MessageCodec("SkinFrequencies", FrequencyRows, _FREQUENCIES)
stress_codec = MessageCodec("SkinStress", StressRows, _STRESS)
