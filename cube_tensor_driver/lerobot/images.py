# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Conversion of a bag's images for a data set: compressed ones are kept, raw ones become PNG."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

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


def make_black_image(shape: Shape) -> bytes:
    """Return the content of a PNG file with a black image."""
    height, width, bands = shape
    return _as_png(Image.new(BAND_MODES[bands - 1], (width, height)))


def _encode_raw(message: RawImage) -> bytes:
    """Encode uncompressed pixels as PNG.

    Raises:
        ValueError: The encoding is not in `PILLOW_MODES`, or the message has no pixels or too few
            bytes.
    """
    if message.encoding not in PILLOW_MODES:
        raise ValueError(f"encoding {message.encoding}; known: {', '.join(PILLOW_MODES)}")
    mode, order = PILLOW_MODES[message.encoding]
    size = message.width, message.height
    if not all(size):
        raise ValueError(f"an image of {size[0]} x {size[1]} pixels")
    # `message.step` is the length of a line of the image in bytes, which may be more than its
    # pixels need. Pillow raises a ValueError if the message has too few bytes.
    return _as_png(Image.frombuffer(mode, size, message.data, "raw", order, message.step, 1))


def _as_png(image: Image.Image) -> bytes:
    """Encode an image of the library Pillow as a PNG file in memory."""
    file = io.BytesIO()
    # Compression level 1 takes a fifth of the default's time and makes files a fifth larger.
    image.save(file, "PNG", compress_level=1)
    return file.getvalue()
