"""Images of a bag as a data set keeps them: compressed ones as they are, raw ones as PNG."""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from PIL import Image, UnidentifiedImageError

from ..bags.read import Bag
from ..bags.recording import stamp_ns
from ..core.arrays import Single
from ..core.errors import BagError
from .plan import Episode

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""ROS message types that contain one image."""

MODES = {
    "rgb8": ("RGB", "RGB"),
    "8UC3": ("RGB", "RGB"),
    "bgr8": ("RGB", "BGR"),
    "rgba8": ("RGBA", "RGBA"),
    "bgra8": ("RGBA", "BGRA"),
    "mono8": ("L", "L"),
    "8UC1": ("L", "L"),
}
"""Mode of the image in Pillow, and order of the bands in the message, for each encoding of
sensor_msgs/Image that can be exported."""

MODE_OF_BANDS = {1: "L", 3: "RGB", 4: "RGBA"}
"""Mode of an image in Pillow, for each number of bands (colour channels)."""

Shape = tuple[int, int, int]
"""Height, width and number of bands of an image."""


@dataclass(frozen=True)
class EncodedImage:
    """An image in a file format.

    Attributes:
        data: Content of the file.
        shape: Its height, width and number of bands.
    """

    data: bytes
    shape: Shape

    def pixels(self) -> Single:
        """Return the pixels (H, W, bands) from 0 to 1."""
        with Image.open(io.BytesIO(self.data)) as image:
            pixels: Single = np.asarray(image, np.float32) / np.float32(255)
        return pixels.reshape(self.shape)


class ImageStream:
    """The images on one topic of a bag in the order of recording; none where it lacks the topic.

    Attributes:
        shape: Shape of all images.
    """

    def __init__(
        self,
        bag: Bag,
        topic: str,
        shape: Shape | None = None,
    ) -> None:
        """Read the first image.

        Args:
            bag: Open bag.
            topic: Topic of the images.
            shape: Shape that all images must have; None: that of the first.

        Raises:
            BagError: The image cannot be read.
        """
        self._bag = bag
        self._topic = topic
        self._unread = self._read()
        self._next = next(self._unread, None)
        if shape is None:
            shape = (1, 1, 1)
            if self._next:
                shape = self._encode(self._next[1]).shape
        self.shape = shape
        # Black stands in the frames before the first image.
        height, width, bands = shape
        black = Image.new(MODE_OF_BANDS[bands], (width, height))
        self._latest = _as_png(black)

    def at(
        self,
        episode: Episode,
        first: int,
        last: int,
    ) -> list[EncodedImage]:
        """Return the newest image before the end of each frame from first to before last.

        Raises:
            BagError: An image cannot be read, or has another shape.
        """
        frames = range(first, last)
        return [self._newest_in(episode, frame) for frame in frames]

    def _newest_in(self, episode: Episode, frame: int) -> EncodedImage:
        """Return the newest image before the end of a frame, reading the bag as far as needed."""
        message = None
        while self._next:
            stamp = np.array(self._next[0])
            if episode.frame_of(stamp) > frame:
                break
            # Only the last image of a frame is encoded, because encoding is slow.
            message = self._next[1]
            self._next = next(self._unread, None)
        if message is not None:
            # A feature has one shape in the whole data set.
            self._latest = self._encode(message)
            if self._latest.shape != self.shape:
                self._fail(f"an image of {self._latest.shape} after ones of {self.shape}")
        return self._latest

    def _read(self) -> Iterator[tuple[int, Any]]:
        """Yield stamp and message."""
        for entry in self._bag.entries({self._topic}):
            message = self._bag.decode(entry)
            yield stamp_ns(message), message

    def _encode(self, message: Any) -> EncodedImage:
        """Convert a message to an image in a file format."""
        try:
            return encode_raw(message) if hasattr(message, "encoding") else keep_encoded(message)
        except (UnidentifiedImageError, OSError, ValueError) as error:
            self._fail(str(error))

    def _fail(self, reason: str) -> NoReturn:
        raise BagError(
            f"{self._bag.path}: {self._topic}: {reason}; leave the topic out by naming the others "
            "with --topics"
        ) from None


def encode_raw(message: Any) -> EncodedImage:
    """Encode a sensor_msgs/Image as PNG.

    Raises:
        ValueError: PNG does not have its encoding, or it has too few bytes.
    """
    if message.encoding not in MODES:
        raise ValueError(f"encoding {message.encoding}; known: {', '.join(MODES)}")
    mode, order = MODES[message.encoding]
    size = int(message.width), int(message.height)
    if not all(size):
        raise ValueError(f"an image of {size[0]} x {size[1]} pixels")
    # Pillow checks the number of bytes. A line may be longer than its pixels: `step` is its length.
    image = Image.frombuffer(
        mode,
        size,
        np.asarray(message.data).tobytes(),
        "raw",
        order,
        int(message.step),
        1,
    )
    return _as_png(image)


def keep_encoded(message: Any) -> EncodedImage:
    """Take the image of a sensor_msgs/CompressedImage without decoding it.

    Raises:
        OSError: Pillow does not know the format.
    """
    data = bytes(message.data)
    # Opening reads the head of the file only: the pixels are not decoded here.
    with Image.open(io.BytesIO(data)) as image:
        return EncodedImage(data, _shape(image))


def _as_png(image: Image.Image) -> EncodedImage:
    """Encode pixels as PNG."""
    file = io.BytesIO()
    # The lowest level takes a fifth of the time of the default, for files that are a fifth larger.
    image.save(file, "PNG", compress_level=1)
    return EncodedImage(file.getvalue(), _shape(image))


def _shape(image: Image.Image) -> Shape:
    """Return height, width and number of bands."""
    return image.height, image.width, len(image.getbands())
