"""Images of a bag as a data set keeps them: compressed ones as they are, raw ones as PNG."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from ..bags.read import Bag
from ..core.errors import BagError
from .frames import Frames
from .topics import stamp_ns

ENCODINGS: dict[str, tuple[str, list[int] | None]] = {
    "rgb8": ("RGB", None),
    "8UC3": ("RGB", None),
    "bgr8": ("RGB", [2, 1, 0]),
    "rgba8": ("RGBA", None),
    "bgra8": ("RGBA", [2, 1, 0, 3]),
    "mono8": ("L", None),
    "8UC1": ("L", None),
}
"""Of sensor_msgs/Image -> mode of Pillow, and the order of its bands in the message."""
BANDS = {"L": 1, "RGB": 3, "RGBA": 4}


@dataclass(frozen=True)
class Encoded:
    """An image in a file format. shape: height, width, bands."""

    data: bytes
    shape: tuple[int, int, int]

    def pixels(self) -> NDArray[np.float32]:
        """(H, W, bands) from 0 to 1."""
        with Image.open(io.BytesIO(self.data)) as image:
            return np.asarray(image, np.float32).reshape(self.shape) / np.float32(255)


class ImageStream:
    """The images on one topic of a bag, in the order of recording; of a bag without it, none.

    shape: of all images; None: of the first. BagError: one cannot be read, or has another shape.
    """

    def __init__(
        self, bag: Bag, topic: str, kind: str, shape: tuple[int, int, int] | None = None
    ) -> None:
        self._bag, self._topic = bag, topic
        self._raw = kind.endswith("/Image")
        self._coming = self._read()
        self._next = next(self._coming, None)
        self._newest: Encoded | None = None
        self._black: Encoded | None = None
        if shape is None:
            shape = self._encode(self._next[1]).shape if self._next else (1, 1, 1)
        self.shape = shape

    def at(self, frames: Frames, first: int, last: int) -> list[Encoded]:
        """The newest image before the end of each frame; black before the first."""
        return [self._at(frames, number) for number in range(first, last)]

    def _at(self, frames: Frames, number: int) -> Encoded:
        message = None
        while self._next and frames.number_of(np.array(self._next[0])) <= number:
            message = self._next[1]
            self._next = next(self._coming, None)
        if message is not None:
            self._newest = self._encode(message)
            if self._newest.shape != self.shape:
                raise BagError(
                    f"{self._bag.path}: {self._topic}: an image of {self._newest.shape} after "
                    f"ones of {self.shape}; leave the topic out by naming the others with --topics"
                )
        if self._newest is None and self._black is None:
            self._black = black(self.shape)
        return self._newest or self._black  # type: ignore[return-value]

    def _read(self) -> Iterator[tuple[int, Any]]:
        for entry in self._bag.entries({self._topic}):
            message = self._bag.decode(entry)
            yield stamp_ns(message), message

    def _encode(self, message: Any) -> Encoded:
        where = f"{self._bag.path}: {self._topic}"
        try:
            return as_png(message) if self._raw else as_it_is(message)
        except (UnidentifiedImageError, OSError, ValueError) as error:
            raise BagError(
                f"{where}: {error}; leave the topic out by naming the others with --topics"
            ) from None


def as_png(message: Any) -> Encoded:
    """A sensor_msgs/Image. ValueError: an encoding that PNG does not have, or too few bytes."""
    if message.encoding not in ENCODINGS:
        raise ValueError(f"encoding {message.encoding}; known: {', '.join(ENCODINGS)}")
    mode, order = ENCODINGS[message.encoding]
    shape = (int(message.height), int(message.width), BANDS[mode])
    size = shape[1] * shape[2]
    if message.step < size or len(message.data) < message.step * shape[0] or not size * shape[0]:
        raise ValueError(f"{len(message.data)} bytes for an image of {shape}")
    lines = np.asarray(message.data)[: message.step * shape[0]].reshape(shape[0], message.step)
    pixels = lines[:, :size].reshape(shape)
    return _png(pixels if order is None else pixels[..., order], mode)


def as_it_is(message: Any) -> Encoded:
    """A sensor_msgs/CompressedImage. OSError: no image that Pillow knows."""
    data = bytes(message.data)
    with Image.open(io.BytesIO(data)) as image:
        return Encoded(data, (image.height, image.width, len(image.getbands())))


def black(shape: tuple[int, int, int]) -> Encoded:
    """What stands where no image had come yet."""
    mode = next(mode for mode, bands in BANDS.items() if bands == shape[2])
    return _png(np.zeros(shape, np.uint8), mode)


def _png(pixels: NDArray[np.uint8], mode: str) -> Encoded:
    file = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(pixels.squeeze(-1) if mode == "L" else pixels))
    image.save(file, "PNG", compress_level=1)
    return Encoded(file.getvalue(), (pixels.shape[0], pixels.shape[1], BANDS[mode]))
