# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of a bag's images for a data set: compressed ones are kept, raw ones become PNG."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from PIL import Image, UnidentifiedImageError

from ..bags.read import Bag, stamp_ns
from ..core.arrays import Single
from ..core.errors import BagError
from .plan import Episode

if TYPE_CHECKING:
    from sensor_msgs.msg import CompressedImage
    from sensor_msgs.msg import Image as ImageMessage

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""ROS message types that contain one image."""

PILLOW_MODES = {
    "rgb8": ("RGB", "RGB"),
    "8UC3": ("RGB", "RGB"),
    "bgr8": ("RGB", "BGR"),
    "rgba8": ("RGBA", "RGBA"),
    "bgra8": ("RGBA", "BGRA"),
    "mono8": ("L", "L"),
    "8UC1": ("L", "L"),
}
"""Mode (pixel format) of an image in the library Pillow, and order of the bands (colour channels)
in the message, for each value of `encoding` in a sensor_msgs/Image that can be exported."""

Shape = tuple[int, int, int]
"""Height and width of an image in pixels, and its number of bands (colour channels)."""


class ImageStream:
    """The images on one topic of a bag, read in the order of recording.

    If the bag does not have the topic, every frame (time step of the data set) gets a black image.

    Attributes:
        shape: Height, width and number of bands (colour channels) of every image.
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
            shape: Height, width and number of bands that every image must have; None: those of the
                first image.

        Raises:
            BagError: The first image cannot be read.
        """
        self._bag = bag
        self._topic = topic
        self._unread = self._read()
        self._next = next(self._unread, None)
        if shape is None:
            shape = (1, 1, 1)
            if self._next:
                _, shape = self._encode(self._next[1])
        self.shape = shape
        # Frames (time steps of the data set) that end before the first image of the topic get a
        # black image. Pillow takes grey images as arrays without the axis of the bands.
        black = np.zeros(shape, np.uint8)
        if shape[2] == 1:
            black = black[..., 0]
        self._latest = _as_png(Image.fromarray(black))

    def at(
        self,
        episode: Episode,
        first: int,
        last: int,
    ) -> list[bytes]:
        """Return the file of one image for each of several successive frames.

        It is the newest image that is stamped before the end of the frame (time step of the data
        set); a black image if there is none.

        Args:
            episode: Episode of the frames.
            first: Number of the first frame in the episode.
            last: Number of the frame after the last one; the next call must begin with it, because
                the bag is read only once.

        Raises:
            BagError: An image cannot be read, or has another shape than `shape`.
        """
        return [self._find_newest_in(episode, frame) for frame in range(first, last)]

    def _find_newest_in(self, episode: Episode, frame: int) -> bytes:
        """Return the file of the newest image that is stamped before the end of a frame.

        The bag is read as far as the first image after the frame. If there is no image before the
        end of the frame, the result is a black image.

        Args:
            episode: Episode of the frame.
            frame: Number of the frame in the episode, not below that of the call before.
        """
        message = None
        while self._next:
            stamp = np.array(self._next[0])
            if episode.frame_of(stamp) > frame:
                break
            # Only the last image before the end of the frame is encoded, because encoding is slow.
            message = self._next[1]
            self._next = next(self._unread, None)
        if message is not None:
            self._latest, shape = self._encode(message)
            # LeRobot requires that all images of a feature (column) have the same shape.
            if shape != self.shape:
                self._fail(f"an image of {shape} after ones of {self.shape}")
        return self._latest

    def _read(self) -> Iterator[tuple[int, ImageMessage | CompressedImage]]:
        """Yield the stamp, in ns since the Unix epoch, and the message of each image."""
        for _, message in self._bag.decoded({self._topic}):
            yield stamp_ns(message), message

    def _encode(self, message: ImageMessage | CompressedImage) -> tuple[bytes, Shape]:
        """Convert an Image or CompressedImage message to an image file, such as PNG or JPEG.

        Returns:
            Content of the file, and the height, width and number of bands of the image.

        Raises:
            BagError: The image is damaged, or its format is not known.
        """
        try:
            # Only uncompressed images state an encoding; compressed ones are image files already.
            is_raw = hasattr(message, "encoding")
            file = encode_raw(message) if is_raw else bytes(message.data)
            # Opening an image reads only the header of its file, and decodes no pixels.
            with Image.open(io.BytesIO(file)) as image:
                bands = len(image.getbands())
                return file, (image.height, image.width, bands)
        except (UnidentifiedImageError, OSError, ValueError) as error:
            self._fail(str(error))

    def _fail(self, reason: str) -> NoReturn:
        """Raise a BagError that names the bag, the topic, the reason and the remedy.

        Args:
            reason: Why an image cannot be used, such as the text of an error of Pillow.
        """
        raise BagError(
            f"{self._bag.path}: {self._topic}: {reason}; leave the topic out by naming the others "
            "with --topics"
        ) from None


def encode_raw(message: ImageMessage) -> bytes:
    """Encode a sensor_msgs/Image (uncompressed pixels) as PNG.

    Raises:
        ValueError: The encoding is not in `PILLOW_MODES`, or the message has no pixels or too few
            bytes.
    """
    if message.encoding not in PILLOW_MODES:
        raise ValueError(f"encoding {message.encoding}; known: {', '.join(PILLOW_MODES)}")
    mode, order = PILLOW_MODES[message.encoding]
    size = int(message.width), int(message.height)
    if not all(size):
        raise ValueError(f"an image of {size[0]} x {size[1]} pixels")
    # `message.step` is the length of a line of the image in bytes, which may be more than its
    # pixels need. Pillow raises a ValueError if the message has too few bytes.
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


def decode_image(file: bytes) -> Single:
    """Decode an image file and return its pixels (height, width, bands), scaled to 0 to 1."""
    with Image.open(io.BytesIO(file)) as image:
        values = np.asarray(image, np.float32)
    pixels: Single = values / np.float32(255)
    return np.atleast_3d(pixels)


def _as_png(image: Image.Image) -> bytes:
    """Encode an image of the library Pillow as a PNG file in memory."""
    file = io.BytesIO()
    # Compression level 1 takes a fifth of the default's time and makes files a fifth larger.
    image.save(file, "PNG", compress_level=1)
    return file.getvalue()
