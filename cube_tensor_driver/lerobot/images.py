# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of a bag's images for a data set: compressed ones are kept, raw ones become PNG."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from ..bags.read import Bag, stamp_ns
from ..core.arrays import Single
from ..core.errors import BagError

if TYPE_CHECKING:
    from sensor_msgs.msg import CompressedImage
    from sensor_msgs.msg import Image as RawImage

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

BAND_MODES = ("L", "LA", "RGB", "RGBA")
"""Mode (pixel format) in Pillow of black images with 1, 2, 3 and 4 bands (colour channels)."""

LEAVE_OUT = "leave the topic out by naming the others with --topics"
"""Advice in the error messages about topics that cannot be exported."""

Shape = tuple[int, int, int]
"""Height and width of an image in pixels, and its number of bands (colour channels)."""


class ImageStream:
    """The images on one topic of a bag, read in the order of recording.

    If the bag does not have the topic, every frame (time step of the data set) gets a black image.
    """

    def __init__(self, bag: Bag, topic: str, shape: Shape) -> None:
        """Read the first image.

        Args:
            bag: Open bag.
            topic: Topic of the images.
            shape: Height, width and number of bands that every image must have.
        """
        self._where = f"{bag.path}: {topic}"
        self._shape = shape
        self._unread = bag.read_decoded({topic})
        self._next: RawImage | CompressedImage | None = self._read()
        height, width, bands = shape
        black = Image.new(BAND_MODES[bands - 1], (width, height))
        self._latest = _as_png(black)

    def at(self, ends_ns: Iterable[int]) -> list[bytes]:
        """Return the file of the newest image that is stamped before the end of each frame.

        For frames that end before the first image, it is the file of a black image.

        Args:
            ends_ns: Ends of frames, in ns since the Unix epoch; no call may go back in time.

        Raises:
            BagError: An image cannot be read, or has another shape than the first one.
        """
        files = []
        for end_ns in ends_ns:
            message = None
            while self._next is not None and stamp_ns(self._next) < end_ns:
                message = self._next
                self._next = self._read()
            # Only the last image before the end of the frame is encoded, because encoding is slow.
            if message is not None:
                self._latest, shape = encode(message, self._where)
                if shape != self._shape:
                    raise BagError(
                        f"{self._where}: an image of {shape} after ones of {self._shape}; "
                        f"{LEAVE_OUT}"
                    )
            files.append(self._latest)
        return files

    def _read(self) -> object:
        """Return the next message; None at the end of the bag."""
        _, message = next(self._unread, (0, None))
        return message


def encode(message: RawImage | CompressedImage, where: str) -> tuple[bytes, Shape]:
    """Convert an Image or CompressedImage message to an image file, such as PNG or JPEG.

    Args:
        message: The message.
        where: Bag and topic, for errors.

    Returns:
        Content of the file, and the height, width and number of bands of the image.

    Raises:
        BagError: The image is damaged, or its format is not known.
    """
    try:
        # Only uncompressed images state an encoding; compressed ones are image files already.
        is_raw = hasattr(message, "encoding")
        file = _encode_raw(message) if is_raw else bytes(message.data)
        # Opening an image reads only the header of its file, and decodes no pixels.
        with Image.open(io.BytesIO(file)) as image:
            return file, (image.height, image.width, len(image.getbands()))
    except (OSError, ValueError) as error:
        raise BagError(f"{where}: {error}; {LEAVE_OUT}") from None


def decode(file: bytes) -> Single:
    """Decode an image file and return its pixels (height, width, bands), scaled to 0 to 1."""
    with Image.open(io.BytesIO(file)) as image:
        pixels = np.asarray(image, np.float32)
    return np.atleast_3d(pixels / np.float32(255))


def _encode_raw(message: RawImage) -> bytes:
    """Encode uncompressed pixels as PNG.

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
    pixels = np.asarray(message.data).tobytes()
    step = int(message.step)
    return _as_png(
        Image.frombuffer(
            mode,
            size,
            pixels,
            "raw",
            order,
            step,
            1,
        )
    )


def _as_png(image: Image.Image) -> bytes:
    """Encode an image of the library Pillow as a PNG file in memory."""
    file = io.BytesIO()
    # Compression level 1 takes a fifth of the default's time and makes files a fifth larger.
    image.save(file, "PNG", compress_level=1)
    return file.getvalue()
