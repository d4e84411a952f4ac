# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The codec of SkinFrequencies and SkinStress: serialised bytes to rows, rows to serialised bytes.

Each of these messages holds many rows (one row is one sample of one cube). Two messages with the
same numbers of rows and pads, and frame ids of the same length, have each field at the same byte
offset. So one structured dtype of numpy describes all of them, and there is no loop over rows. The
bytes are little-endian CDR (OMG DDS-XTypes 7.4.1): a sequence begins with the number of its values
as 4 bytes, at an offset that is a multiple of 4.
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import AnyArray, Integers, Records, Times
from ..core.errors import MessageError
from ..core.modes import GRADIENT, STRESS
from ..core.rows import FrequencyRows, StressRows

SECOND = 1_000_000_000
"""Number of nanoseconds in one second."""

MAX_CACHED_LAYOUTS = 32
"""Number of message layouts (byte offsets of all fields) that a codec keeps in memory.

Messages of one skin have one layout for each number of rows that occurs.
"""

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
"""First 4 bytes of every serialised message in little-endian CDR."""

PER_PAD = -1
"""Value of `_Field.width` for a field with one value per pad in each row (sample of a cube)."""

PER_MESSAGE = 0
"""Value of `_Field.width` (number of values per row) for a field that is not a sequence, but holds
one value for the whole message."""

_SECONDS_AT = len(LITTLE_ENDIAN)
"""Byte offset of the seconds of the stamp, an int32, in a serialised message."""
_NANOSECONDS_AT = _SECONDS_AT + 4
"""Byte offset of the nanoseconds of the stamp, a uint32, in a serialised message."""
_FRAME_LENGTH_AT = _NANOSECONDS_AT + 4
"""Byte offset of the length of the frame id, a uint32, in a serialised message."""
_FRAME_AT = _FRAME_LENGTH_AT + 4
"""Byte offset of the text of the frame id in a serialised message."""

SHAPE_AT = _FRAME_LENGTH_AT
"""Byte offset, from the start of a serialised message, of the bytes that
`MessageCodec.read_shape_bytes` returns: length and text of the frame id, then number of rows."""

_Scalar = TypeVar("_Scalar", bound=np.generic)
AnyRows = TypeVar("AnyRows", FrequencyRows, StressRows)


class _Field(NamedTuple):
    """Definition of one field that follows the header of a message.

    Attributes:
        name: Name in the message definition.
        type: numpy's name of the type of a value, such as "<f4"; its last character is the size in
            bytes.
        width: Number of values in each row, or PER_PAD, or PER_MESSAGE.
    """

    name: str
    type: str
    width: int


_FIRST_FIELDS = (
    _Field("cube", "<u2", 1),
    _Field("sequence", "<u4", 1),
    _Field("time_offset", "<i4", 1),
)
"""Fields that follow the header in SkinFrequencies as well as in SkinStress."""
_FREQUENCIES = (
    *_FIRST_FIELDS,
    _Field("n_pads", "<u1", PER_MESSAGE),
    _Field("frequency", "<f4", PER_PAD),
    _Field("temperature", "<f4", 1),
    _Field("pad_fault", "<u4", 1),
    _Field("status", "<u2", 1),
)
"""Fields of SkinFrequencies after the header, in the order of the message definition."""
_STRESS = (
    *_FIRST_FIELDS,
    _Field("stress", "<f4", len(STRESS)),
    _Field("gradient", "<f4", len(GRADIENT)),
    _Field("residual", "<f4", 1),
    _Field("status", "<u2", 1),
    _Field("observed", "<u2", 1),
    _Field("left_out", "<u4", 1),
)
"""Fields of SkinStress after the header, in the order of the message definition."""


class _Shape(NamedTuple):
    """Lengths that determine the byte offsets of all fields of a message.

    Attributes:
        frame: Length of the frame id in bytes, including its closing zero.
        rows: Number of rows (samples of one cube each).
        pads: Number of pads in each row; 0 in SkinStress, which has no values per pad.
    """

    frame: int
    rows: int
    pads: int


class _Layout(NamedTuple):
    """Byte offsets of the fields of all messages that have the same `_Shape`.

    Attributes:
        shape: Length of the frame id, number of rows and number of pads of these messages.
        record: Structured dtype of numpy that describes a whole message.
        sequences: Names of the fields that are sequences, `frame_id` first.
        counts: Numbers of values that these sequences must have.
        numbers: Struct that reads, from a message, the seconds and nanoseconds of the header, then
            the numbers of values of the `sequences`.
    """

    shape: _Shape
    record: np.dtype[np.void]
    sequences: list[str]
    counts: list[int]
    numbers: struct.Struct


@dataclass(frozen=True, slots=True)
class Decoded(Generic[AnyRows]):
    """Contents of M decoded messages with the same numbers of rows and pads.

    Attributes:
        rows: Rows of all messages, message after message. With M = 1, most columns are views of the
            bytes of the message; with more they are copies.
        stamp_ns: Time stamps of the headers (M,), in ns since the Unix epoch.
        frame_id: Frame id of the headers, with its closing zero.
    """

    rows: AnyRows
    stamp_ns: Times
    frame_id: bytes

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def select(self, chosen: slice) -> Decoded[AnyRows]:
        """Return some successive messages of these M messages.

        Args:
            chosen: Slice of the message numbers 0 to M - 1, without a step.
        """
        n_rows = len(self.rows) // len(self)
        begin, end, _ = chosen.indices(len(self))
        rows = self.rows.select(slice(begin * n_rows, end * n_rows))
        return Decoded(rows, self.stamp_ns[chosen], self.frame_id)

    def group_by_message(self, column: AnyArray) -> AnyArray:
        """Reshape a column of `rows` so that its first axis counts the messages.

        Args:
            column: Column of the rows of all M messages, for example `rows.frequency`.

        Returns:
            The column with the shape (M, rows of one message, ...).
        """
        return column.reshape(len(self), -1, *column.shape[1:])


class MessageBuffer(Generic[AnyRows]):
    """Memory of a serialised message with fixed numbers of rows and pads, which is used repeatedly.

    The caller writes values into `rows` and calls `encode` to get the bytes of the message.

    Args:
        codec: Codec of the type of message.
        layout: Byte offsets of the fields.
        frame_id: Frame id with its closing zero.

    Attributes:
        rows: Rows to write into. All columns but `stamp_ns` are views of the bytes of the message.
    """

    def __init__(
        self,
        codec: MessageCodec[AnyRows],
        layout: _Layout,
        frame_id: bytes,
    ) -> None:
        self._record: Records = np.zeros(1, layout.record)
        codec.write_constants(self._record, layout, frame_id)
        stamp_ns = np.zeros(layout.shape.rows, np.int64)
        self.rows: AnyRows = codec.make_rows(self._record, stamp_ns)
        self._time_offset = self._record["time_offset"][0]

    def encode(self, stamp_ns: int | None = None) -> bytes:
        """Return the bytes of the message with the values that `rows` has now.

        Args:
            stamp_ns: Time stamp of the header, in ns since the Unix epoch. None takes the stamp of
                the earliest row.
        """
        times_ns = self.rows.stamp_ns
        if stamp_ns is None:
            stamp_ns = int(times_ns.min())
        self._time_offset[:] = times_ns - stamp_ns
        self._record["sec"], self._record["nanosec"] = divmod(stamp_ns, SECOND)
        return self._record.tobytes()


class MessageCodec(Generic[AnyRows]):
    """Converts one type of message between serialised bytes and rows.

    Attributes:
        columns: Names of the columns of the rows that the message contains.
    """

    def __init__(
        self,
        name: str,
        rows: type[AnyRows],
        message_fields: tuple[_Field, ...],
    ) -> None:
        """Describe a type of message.

        Args:
            name: Name of the message type, for error messages.
            rows: Class of the rows: FrequencyRows or StressRows.
            message_fields: Fields that follow the header, in order.
        """
        self._name = name
        self._rows: type[AnyRows] = rows
        self._fields = message_fields
        names = [field.name for field in message_fields]
        self.columns = [name for name in names if name not in ("time_offset", "n_pads")]
        self.columns.append("stamp_ns")
        self._has_pads = "n_pads" in names
        self._find_layout = lru_cache(MAX_CACHED_LAYOUTS)(self._make_layout)

    def decode(self, messages: bytes | AnyArray) -> Decoded[AnyRows]:
        """Decode one or several serialised messages.

        Args:
            messages: The bytes of one message, or an array (M, length) of the bytes of M messages.

        Raises:
            MessageError: A message is too short, its fields contradict each other, or the messages
                have different frame ids or numbers of rows or pads.
        """
        record, stamp_ns = self._read_records(messages)
        times_ns = _compute_row_times(record, stamp_ns)
        rows: AnyRows = self.make_rows(record, times_ns)
        frame_id = record["frame_id"][0].tobytes()
        return Decoded(rows, stamp_ns, frame_id)

    def decode_columns(
        self,
        names: Sequence[str],
        messages: bytes | AnyArray,
    ) -> list[Integers]:
        """Decode only some columns of the rows, without copying the others.

        Args:
            names: Names of the columns, for example "cube".
            messages: See `decode`.

        Returns:
            The column `stamp_ns`, in ns since the Unix epoch, then the named columns.

        Raises:
            MessageError: See `decode`.
        """
        record, stamp_ns = self._read_records(messages)
        columns: list[Integers] = [_compute_row_times(record, stamp_ns)]
        for name in names:
            columns.append(_join_messages(record[name]))
        return columns

    def read_shape_bytes(self, data: bytes) -> bytes:
        """Return the bytes of a serialised message that hold its frame id and number of rows.

        They begin at the byte offset `SHAPE_AT`. Messages of the same length that agree in these
        bytes can be decoded together.
        """
        frame = int.from_bytes(data[_FRAME_LENGTH_AT:_FRAME_AT], "little")
        end = _align(_FRAME_AT + frame) + 4
        return data[SHAPE_AT:end]

    def make_buffer(
        self,
        frame_id: bytes,
        rows: int,
        pads: int = 0,
    ) -> MessageBuffer[AnyRows]:
        """Return the memory of a message, for the caller to fill.

        Args:
            frame_id: Frame id with its closing zero.
            rows: Number of rows.
            pads: Number of pads in each row of SkinFrequencies; 0 for SkinStress.
        """
        layout = self._find_layout(_Shape(len(frame_id), rows, pads))
        return MessageBuffer(self, layout, frame_id)

    def encode(
        self,
        rows: AnyRows,
        stamp_ns: Times,
        frame_id: bytes,
    ) -> list[bytes]:
        """Return the bytes of M messages with the same number of rows.

        Args:
            rows: Rows of all messages, message after message.
            stamp_ns: Time stamps of the headers (M,), in ns since the Unix epoch.
            frame_id: Frame id with its closing zero, the same in all messages.
        """
        count = len(stamp_ns)
        pads = rows.frequency.shape[1] if isinstance(rows, FrequencyRows) else 0
        shape = _Shape(len(frame_id), len(rows) // count, pads)
        layout = self._find_layout(shape)
        record = np.zeros(count, layout.record)
        self.write_constants(record, layout, frame_id)
        record["sec"], record["nanosec"] = np.divmod(stamp_ns, SECOND)
        # A message stores the time of a row in 4 bytes, as the difference in ns from the time stamp
        # of its header.
        times_ns = rows.stamp_ns.reshape(count, -1)
        record["time_offset"] = times_ns - stamp_ns[:, None]
        for name in self.columns:
            if name != "stamp_ns":
                record[name] = getattr(rows, name).reshape(record[name].shape)
        return [message.tobytes() for message in record]

    def make_rows(self, record: Records, stamp_ns: Times) -> AnyRows:
        """Return the rows (samples of cubes) of serialised messages.

        Args:
            record: Messages (M,) as an array of the structured dtype of their layout.
            stamp_ns: Times of all their rows, in ns since the Unix epoch.

        Returns:
            Rows of all messages. With M = 1 their columns are views of `record`, else copies.
        """
        columns: dict[str, AnyArray] = {
            name: stamp_ns if name == "stamp_ns" else _join_messages(record[name])
            for name in self.columns
        }
        return self._rows.from_columns(columns)

    def write_constants(
        self,
        record: Records,
        layout: _Layout,
        frame_id: bytes,
    ) -> None:
        """Write the values that are equal in all messages of a layout: lengths and frame id.

        Args:
            record: Messages (M,) to write into, as an array of the structured dtype of the layout.
            layout: Layout of the messages.
            frame_id: Frame id with its closing zero.
        """
        record["encapsulation"] = LITTLE_ENDIAN
        # Void data keep the closing zero, which numpy removes from strings of bytes.
        record["frame_id"] = np.void(frame_id)
        for name, count in zip(layout.sequences, layout.counts, strict=True):
            record[f"length of {name}"] = count
        if self._has_pads:
            record["n_pads"] = layout.shape.pads

    def _read_records(self, messages: bytes | AnyArray) -> tuple[Records, Times]:
        """View serialised messages as an array (M,) of the structured dtype of their layout.

        The layout states the byte offset and type of each field.

        Args:
            messages: See `decode`.

        Returns:
            The array, and the time stamps of the headers (M,), in ns since the Unix epoch.

        Raises:
            MessageError: See `decode`.
        """
        first = messages if isinstance(messages, bytes) else messages[0].tobytes()
        layout: _Layout = self._read_layout(first)
        stamp_ns = np.array([self._read_stamp(layout, first)])
        if isinstance(messages, bytes) or len(messages) == 1:
            return np.frombuffer(first, layout.record, 1), stamp_ns
        # DDS middleware may have added bytes at the end of the messages, which are cut off.
        content = np.ascontiguousarray(messages[:, : layout.record.itemsize])
        record: Records = content.view(layout.record)[:, 0]
        for name in ("frame_id", *(f"length of {name}" for name in layout.sequences)):
            if (record[name] != record[name][0]).any():
                raise MessageError(
                    f"{self._name}: {len(messages)} messages differ in the {name}; decode them one "
                    "by one"
                )
        stamp_ns = record["sec"].astype(np.int64) * SECOND + record["nanosec"]
        return record, stamp_ns

    def _read_layout(self, data: bytes) -> _Layout:
        """Return the layout of a message with the numbers of rows and pads that it states.

        Args:
            data: Bytes of the serialised message.

        Raises:
            MessageError: The message is too short, is not little-endian CDR, or has another length
                than follows from these numbers.
        """
        is_too_short = len(data) < _FRAME_AT + 4
        if is_too_short or data[:2] != LITTLE_ENDIAN[:2]:
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
        # The first field that follows the header is a sequence with one value per row, so its
        # number of values is the number of rows.
        (rows,) = struct.unpack_from("<I", data, rows_at)
        shape = _Shape(frame, rows, 0)
        # A damaged message may state any number of rows. Computing a layout allocates no memory for
        # the rows, and numpy raises a ValueError if the layout would be longer than any message.
        with contextlib.suppress(ValueError):
            layout: _Layout = self._find_layout(shape)
            if self._has_pads and layout.record.fields:
                pads_at = layout.record.fields["n_pads"][1]
                # A damaged message may be too short to have this byte. Then the check of its length
                # below refuses it.
                pads = data[pads_at] if pads_at < len(data) else 0
                shape = _Shape(frame, rows, pads)
                layout = self._find_layout(shape)
            # DDS middleware may add up to three bytes at the end.
            if 0 <= len(data) - layout.record.itemsize < 4:
                return layout
        raise MessageError(
            f"{self._name} of {len(data)} bytes says it has {rows} rows of {shape.pads} pads: "
            "damaged, or of another version of the messages"
        )

    def _read_stamp(self, layout: _Layout, message: bytes) -> int:
        """Check the sequences of a message, and return its time stamp in ns since the Unix epoch.

        Args:
            layout: Layout that the message must have.
            message: Bytes of the serialised message.

        Raises:
            MessageError: The number of values of a sequence does not fit the message's numbers of
                rows and pads.
        """
        seconds, nanoseconds, *counts = layout.numbers.unpack_from(message)
        for name, found, needed in zip(
            layout.sequences,
            counts,
            layout.counts,
            strict=True,
        ):
            if found != needed:
                raise MessageError(
                    f"{self._name} of {layout.shape.rows} rows has {found} values of {name}, "
                    f"they need {needed}"
                )
        return int(seconds * SECOND + nanoseconds)

    def _make_layout(self, shape: _Shape) -> _Layout:
        # Each entry of the structured dtype has a name, a type and a byte offset.
        entries: list[tuple[str, object, int]] = [
            ("encapsulation", "S4", 0),
            ("sec", "<i4", _SECONDS_AT),
            ("nanosec", "<u4", _NANOSECONDS_AT),
            ("length of frame_id", "<u4", _FRAME_LENGTH_AT),
            ("frame_id", f"V{shape.frame}", _FRAME_AT),
        ]
        sequences = ["frame_id"]
        counts = [shape.frame]
        counts_at: list[int] = [_FRAME_LENGTH_AT]
        end = _FRAME_AT + shape.frame
        for field in self._fields:
            dimensions = _make_dimensions(field.width, shape)
            values = math.prod(dimensions)
            if field.width != PER_MESSAGE:
                # The values follow their number (4 bytes) without a gap, because CDR aligns values
                # to their size, and no value is larger than 4 bytes.
                count_at = _align(end)
                entries.append((f"length of {field.name}", "<u4", count_at))
                sequences.append(field.name)
                counts.append(values)
                counts_at.append(count_at)
                end = count_at + 4
            entries.append((field.name, (field.type, dimensions), end))
            end += values * int(field.type[-1])
        names, formats, offsets = zip(*entries, strict=True)
        record = np.dtype(
            {
                "names": names,
                "formats": formats,
                "offsets": offsets,
                "itemsize": end,
            }
        )
        return _Layout(
            shape=shape,
            record=record,
            sequences=sequences,
            counts=counts,
            numbers=_make_struct([_SECONDS_AT, _NANOSECONDS_AT, *counts_at]),
        )


def _make_dimensions(width: int, shape: _Shape) -> tuple[int, ...]:
    """Return the array shape of the values of one field in one message.

    Args:
        width: Number of values in each row, or PER_PAD, or PER_MESSAGE.
        shape: Numbers of rows and pads of the message.
    """
    if width == PER_MESSAGE:
        return ()
    if width == 1:
        return (shape.rows,)
    return (shape.rows, shape.pads if width == PER_PAD else width)


def _make_struct(offsets: Sequence[int]) -> struct.Struct:
    """Return the struct that reads 32-bit integers at these byte offsets, the first one signed."""
    form, end = "<", 0
    for offset in offsets:
        form += f"{offset - end}x{'I' if end else 'i'}"
        end = offset + 4
    return struct.Struct(form)


def _compute_row_times(record: Records, stamp_ns: Times) -> Times:
    """Return the times of the rows of all messages, one after the other, in ns since 1970.

    Args:
        record: Messages (M,) as an array of the structured dtype of their layout.
        stamp_ns: Time stamps of the headers (M,), in ns since the Unix epoch.
    """
    times_ns: Times = stamp_ns[:, None] + record["time_offset"]
    return times_ns.reshape(-1)


def _join_messages(values: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """Return the values of a field for the rows of all messages, one after the other.

    Args:
        values: Values of the field in M messages (M, rows of one message, ...).
    """
    if len(values) == 1:
        # The values of a single message are not copied, which saves time in the nodes.
        view: NDArray[_Scalar] = values[0]
        return view
    return values.reshape(-1, *values.shape[2:])


def _align(offset: int) -> int:
    """Round a byte offset up to a multiple of 4, at which CDR begins values of 4 bytes."""
    return -(-offset // 4) * 4


frequency_codec = MessageCodec("SkinFrequencies", FrequencyRows, _FREQUENCIES)
stress_codec = MessageCodec("SkinStress", StressRows, _STRESS)
