"""A serialised MarkerArray whose points, colours and texts are written in place.

The points and colours of a marker are thousands of Python objects to rclpy. So the array is
serialised once, and each picture is numpy writing into those bytes.

A message is serialised as CDR: four bytes of encapsulation, then all fields in order, each aligned
to its size; before a text and before the items of a sequence stands their number, 4 bytes. Source:
OMG Common Object Request Broker Architecture 3.3, part 2, section 9.3 (CDR transfer syntax).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from visualization_msgs.msg import Marker, MarkerArray

from ...core.errors import MessageError

ENCAPSULATION_BYTES = 4
SIZES = {
    "boolean": 1,
    "octet": 1,
    "uint8": 1,
    "int32": 4,
    "uint32": 4,
    "float": 4,
    "double": 8,
}
"""Bytes of the plain types that a Marker contains."""


class MarkerArrays(NamedTuple):
    """Views on the bytes of a marker.

    points: (n, 3) m. colours: (n, 4) of the points, or (0, 4). text: in ASCII. position: (3,) m of
    the whole. colour: (4,) where points have none.
    """

    points: NDArray[np.float64]
    colours: NDArray[np.float32]
    text: NDArray[np.uint8]
    position: NDArray[np.float64]
    colour: NDArray[np.float32]


class SerialisedMarkers:
    """data: the message. Its arrays are found by the markers' namespaces."""

    def __init__(self, markers: Sequence[Marker]) -> None:
        """Numbers of points and colours and lengths of texts stay as they are in `markers`."""
        self.data = bytearray(serialize_message(MarkerArray(markers=list(markers))))
        self._arrays: dict[str, MarkerArrays] = {}
        walk = _CdrWalk()
        walk.skip("uint32", len(markers))
        for marker in markers:
            at = walk.skip_message(marker)
            points = self._view("<f8", at["points"], (len(marker.points), 3))
            colours = self._view("<f4", at["colors"], (len(marker.colors), 4))
            text = self._view("u1", at["text"], (len(marker.text),))
            position = self._view("<f8", _aligned(at["pose"], 8), (3,))
            colour = self._view("<f4", _aligned(at["color"], 4), (4,))
            self._arrays[marker.ns] = MarkerArrays(points, colours, text, position, colour)
        # The middleware may fill up the last four bytes.
        expected = ENCAPSULATION_BYTES + walk.end
        if not 0 <= len(self.data) - expected < 4:
            raise MessageError(
                f"MarkerArray: serialised into {len(self.data)} bytes, expected are {expected}: "
                "this version of visualization_msgs is not known"
            )

    def __getitem__(self, namespace: str) -> MarkerArrays:
        return self._arrays[namespace]

    def __contains__(self, namespace: str) -> bool:
        return namespace in self._arrays

    def _view(self, dtype: str, start: int, shape: tuple[int, ...]) -> NDArray[Any]:
        return np.ndarray(shape, dtype, self.data, ENCAPSULATION_BYTES + start)


class _CdrWalk:
    """Goes through serialised values in order; end: where the last one ended, without
    encapsulation."""

    def __init__(self) -> None:
        self.end = 0

    def skip(self, type_name: str, value: Any) -> int:
        """Go over a value; returns where its content begins."""
        sequence = re.fullmatch(r"sequence<(.*)>", type_name)
        if sequence:
            return self._skip_sequence(sequence[1], value)
        if type_name == "string":
            start = self.skip("uint32", len(value)) + SIZES["uint32"]
            self.end = start + len(value.encode()) + 1  # with a closing zero
            return start
        if type_name in SIZES:
            size = SIZES[type_name]
            start = self._align(size)
            self.end = start + size
            return start
        start = self.end
        self.skip_message(value)
        return start

    def skip_message(self, message: Any) -> dict[str, int]:
        """Go over a message; returns where the content of each field begins."""
        types = message.get_fields_and_field_types()
        return {name: self.skip(types[name], getattr(message, name)) for name in types}

    def _skip_sequence(self, item_type: str, items: Sequence[Any]) -> int:
        self.skip("uint32", len(items))
        if not len(items):
            return self.end
        # All items are alike, and their size is a multiple of their alignment.
        start = self.skip(item_type, items[0]) if item_type in SIZES else self._first(items[0])
        self.end = start + len(items) * (self.end - start)
        return start

    def _first(self, message: Any) -> int:
        """Go over the first message of a sequence; returns where its first field begins."""
        return min(self.skip_message(message).values())

    def _align(self, size: int) -> int:
        self.end = _aligned(self.end, size)
        return self.end


def _aligned(place: int, size: int) -> int:
    """The first multiple of a size from a place on."""
    return -(-place // size) * size
