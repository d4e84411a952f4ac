# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Recording of live touch beside a LeRobot data set, whose pictures contain the numbers to find it.

`lerobot-record` 0.4.4 takes from a camera only a picture of 8 bits per colour, and from a robot
only 32-bit numbers that it joins to one vector (function `build_dataset_frame` in the file
lerobot/datasets/utils.py). Windows of stress (all samples since the last frame) fit into neither.
They are written to a file of their own, and the picture of each frame contains the number under
which its window is stored.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path
from queue import Empty, SimpleQueue

import numpy as np
import pyarrow
import pyarrow.ipc

from ..bags.tables import as_array, as_column
from ..config.skin import Skin
from ..core.arrays import AnyArray, Index
from ..core.errors import BagError, ConfigError, CubeError
from ..core.reconstructor import Reconstructor
from ..core.rows import StressRows, concatenate
from ..device.live import LinkSource
from .windows import arrange_windows

NUMBER_COLUMN = "frame_number"
"""Name of the column with the number of a frame.

The number is the time at which the frame was read, in ms since the Unix epoch, so that the frames
of all recordings have different numbers.
"""

NUMBER_BYTES = 6
"""Size, in bytes, of a frame number (time in ms since the Unix epoch). Its 48 bits suffice beyond
the year 10000."""

NUMBER_GRID = (2, 24)
"""Rows and columns of black and white squares at the top of a picture, which show the 48 bits of
the frame number, the highest bit first."""

MIN_SQUARE = 8
"""Smallest side, in pixels, of the squares that show a frame number, so that people see them. The
data set must keep its pictures as PNG: compressed video can change single bits."""

MIN_WIDTH = MIN_SQUARE * NUMBER_GRID[1]
"""Smallest width of a picture, in pixels, that has room for the frame number."""

MIN_HEIGHT = 4 * MIN_SQUARE
"""Smallest height of a picture, in pixels, so that the frame number, which is two rows of squares
(`NUMBER_GRID`), covers at most half of it."""

MAX_AGE_NS = 5_000_000
"""Maximum age, in ns, of the newest sample when a frame is made. `take_next_picture` waits for a
newer one, but at most for `CATCH_UP_S`.

If the sampling period is longer, the period is the maximum age, because no newer sample need exist.
"""

CATCH_UP_S = 0.02
"""Longest time, in s, for which `take_next_picture` waits until no unread sample is older than
`MAX_AGE_NS`.

A sample passes through two threads, and Python runs only one thread at a time. While the recorder
or its writers of images compute, each of the two waits up to 5 ms for its turn
(`sys.getswitchinterval`), and on a busy computer longer. At 30 frames per second, the limit leaves
13 of the 33 ms of a frame to the recorder.
"""

UNKNOWN_GREY = 90
"""Brightness (0 to 255) of the cubes whose stress along z is unknown."""


class LiveWindows:
    """Writes the stress of a live skin to a file, one window for each frame.

    The window of a frame consists of all samples since the frame before. A thread collects samples
    as they arrive, whatever the recorder does meanwhile. Windows may differ in length, so a pause
    of the recorder makes only one window longer. The file is FOLDER/NUMBER.arrow, with the number
    of the first frame. It is an Arrow stream, which stays readable if the program is killed.
    """

    def __init__(
        self,
        source: LinkSource,
        folder: Path,
        *,
        width: int,
        height: int,
        full_scale: float,
    ) -> None:
        """Begin to collect samples.

        Args:
            source: Live links of the skin. `close` closes them.
            folder: Folder of the recordings; it is made if it does not exist.
            width: Width of the pictures, in pixels.
            height: Height of the pictures, in pixels.
            full_scale: Pressure (compressive stress along z of the cube), in Pa, with the brightest
                colour.

        Raises:
            ConfigError: The picture is too small for the frame number, or `full_scale` is not
                above 0.
        """
        if width < MIN_WIDTH or height < MIN_HEIGHT:
            raise ConfigError(
                f"the picture has {width} x {height} pixels; at least {MIN_WIDTH} x {MIN_HEIGHT} "
                "are needed to show the frame number"
            )
        if not full_scale > 0:
            raise ConfigError(f"full_scale is {full_scale} Pa; it must be above 0")
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._source = source
        self._full_scale = full_scale
        self._cube_at = find_nearest_cubes(
            source.skin,
            width,
            height,
        )
        self._level = np.full(len(source.skin.cubes), np.nan)
        self._number = 0
        self._writer: pyarrow.ipc.RecordBatchStreamWriter | None = None
        rate = source.skin.rate
        self._max_age_ns = max(MAX_AGE_NS, round(1e9 / rate) if rate else 0)
        self._arrived: SimpleQueue[StressRows | CubeError] = SimpleQueue()
        self._thread = threading.Thread(target=self._collect, daemon=True)
        self._thread.start()

    def take_next_picture(self, timeout_s: float) -> AnyArray:
        """Write all samples since the last call as one window and return the frame's picture.

        Args:
            timeout_s: Longest time, in s, to wait for a sample if there is none.

        Returns:
            Picture (height, width, 3) of 8 bits: the newest pressure of each cube in red, tension
            in blue, and the frame number at the top.

        Raises:
            TimeoutError: No sample arrived.
            CubeError: The thread that reads the links has failed.
        """
        wanted_ns = time.time_ns() - self._max_age_ns
        end_s = time.monotonic() + min(CATCH_UP_S, timeout_s)
        parts: list[StressRows] = []
        newest_ns = 0
        while newest_ns < wanted_ns or not self._arrived.empty():
            wait_s = max(0.0, end_s - time.monotonic()) if parts else timeout_s
            try:
                part = self._arrived.get(timeout=wait_s)
            except Empty:
                break
            if isinstance(part, CubeError):
                # The error is put back, so that later calls raise it, too.
                self._arrived.put(part)
                if parts:
                    break
                raise part
            parts.append(part)
            newest_ns = int(part.stamp_ns.max(initial=0))
        if not parts:
            raise TimeoutError(
                f"skin {self._source.skin.name}: no sample in {timeout_s:g} s; check that the hubs "
                "are connected and that no other program reads them"
            )
        rows = concatenate(parts)
        # Frame numbers must rise, although the clock of the computer may be set back.
        self._number = max(self._number + 1, time.time_ns() // 1_000_000)
        self._write(rows)
        # In an assignment with repeated indices numpy keeps the last value, which is the newest.
        self._level[rows.cube] = -rows.stress[:, 2] / self._full_scale
        return self._make_picture()

    def close(self) -> None:
        """Close the links and complete the file. Samples after the last frame are left out."""
        self._source.close()
        self._thread.join()
        if self._writer is not None:
            self._writer.close()
            # `close` has ended the stream. The file is closed when the writer is deleted.
            self._writer = None

    def _collect(self) -> None:
        """Reconstruct the stress of all samples as they arrive; runs in a thread of its own."""
        reconstruct = Reconstructor(self._source.skin)
        try:
            for rows in self._source:
                self._arrived.put(reconstruct(rows))
        except CubeError as error:
            self._arrived.put(error)

    def _write(self, rows: StressRows) -> None:
        """Write the rows (samples of cubes) of one frame as one batch of the Arrow stream."""
        n_cubes = len(self._level)
        depth = int(np.bincount(rows.cube, minlength=1).max())
        first_frame = np.zeros(len(rows), np.intp)
        columns = arrange_windows(
            first_frame,
            rows,
            (1, depth, n_cubes),
        )
        arrays = {name: as_column(values) for name, values in columns.items()}
        arrays[NUMBER_COLUMN] = pyarrow.array([self._number])
        batch = pyarrow.record_batch(arrays)
        if self._writer is None:
            path = self._folder / f"{self._number}.arrow"
            self._writer = pyarrow.ipc.new_stream(str(path), batch.schema)
        self._writer.write_batch(batch)

    def _make_picture(self) -> AnyArray:
        """Return the picture of the newest pressures, with the frame number at the top."""
        red = np.clip(self._level, 0.0, 1.0)
        blue = np.clip(-self._level, 0.0, 1.0)
        colours = 255 * np.column_stack(
            [
                red,
                np.zeros_like(red),
                blue,
            ]
        )
        colours[np.isnan(red)] = UNKNOWN_GREY
        picture = colours.astype(np.uint8)[self._cube_at]

        number_bytes = self._number.to_bytes(NUMBER_BYTES, "big")
        bits = np.unpackbits(np.frombuffer(number_bytes, np.uint8))
        side = picture.shape[1] // NUMBER_GRID[1]
        square = np.full(
            (MIN_SQUARE, side),
            255,
            np.uint8,
        )
        squares = np.kron(bits.reshape(NUMBER_GRID), square)
        rows, columns = squares.shape
        picture[:rows, :columns] = squares[..., np.newaxis]
        return picture


class RecordedWindows:
    """Reads windows (the samples of one frame each) from a folder that `LiveWindows` wrote.

    A window is found by the frame number in the picture of its frame.

    Args:
        folder: Folder of the recordings.

    Raises:
        BagError: The folder has no recordings.
    """

    def __init__(self, folder: Path | str) -> None:
        self._frames: dict[int, pyarrow.RecordBatch] = {}
        paths = sorted(Path(folder).glob("*.arrow"))
        if not paths:
            raise BagError(f"{folder}: no recordings (NUMBER.arrow); name the camera's folder")
        for path in paths:
            file = pyarrow.memory_map(str(path))
            for batch in pyarrow.ipc.open_stream(file):
                self._frames[batch[NUMBER_COLUMN][0].as_py()] = batch

    def __len__(self) -> int:
        """Return the number of frames that were read, including those that no data set kept."""
        return len(self._frames)

    def of(self, picture: AnyArray) -> dict[str, AnyArray]:
        """Return the window that was recorded with a picture.

        Args:
            picture: Picture of the skin in a frame of the data set, (height, width, 3) or
                (3, height, width) as LeRobot returns it.

        Returns:
            Features by the names that `./cube export lerobot` gives them, (samples, cubes, …) each.

        Raises:
            BagError: The folder has no window with the number in the picture.
        """
        return self.at(read_frame_number(picture))

    def at(self, number: int) -> dict[str, AnyArray]:
        """Return the window that was stored under a frame number; result and errors as in `of`."""
        if number not in self._frames:
            raise BagError(f"no window has the number {number}; name the folder of this data set")
        batch = self._frames[number]
        names = batch.schema.names
        return {name: as_array(batch[name])[0] for name in names if name != NUMBER_COLUMN}


def read_frame_number(picture: AnyArray) -> int:
    """Read the frame number (time of reading, in ms since the Unix epoch) from a picture.

    Args:
        picture: Picture of a skin, (height, width, 3) or (3, height, width).
    """
    pixels = np.asarray(picture, float)
    grey = pixels.mean(axis=0 if len(pixels) == 3 else 2)
    rows, columns = NUMBER_GRID
    side = grey.shape[1] // columns
    strip = grey[: rows * MIN_SQUARE, : columns * side]
    by_square = strip.reshape(
        rows,
        MIN_SQUARE,
        columns,
        side,
    )
    squares = by_square.mean(axis=(1, 3))
    # Pixels may be scaled to 0 to 1 or 0 to 255. Every frame number has black and white squares, so
    # the threshold is half way between the darkest and the brightest one.
    threshold = 0.5 * (squares.min() + squares.max())
    number = np.packbits(squares > threshold)
    return int.from_bytes(number.tobytes(), "big")


def find_nearest_cubes(skin: Skin, width: int, height: int) -> Index:
    """Return the number of the cube that each pixel of a picture shows, (height, width).

    The skin is seen along its thinnest direction, and each pixel shows the nearest cube.

    Args:
        skin: The skin.
        width: Width of the picture, in pixels.
        height: Height of the picture, in pixels.
    """
    position = skin.poses.position
    thickness = np.ptp(position, axis=0)
    # The two widest directions are sorted, so that a flat skin appears as in its skin file, with x
    # to the right and y up.
    widest = np.sort(np.argsort(-thickness, kind="stable")[:2])
    across, up = (position - position.mean(axis=0))[:, widest].T
    top = NUMBER_GRID[0] * MIN_SQUARE
    free = height - top
    # The centres of the cubes fill 1/1.2 of the picture. With this margin, the cubes at the edges
    # appear about as large as the others.
    pixel = 1.2 * max(np.ptp(across) / width, np.ptp(up) / free) or 1.0
    distance_x = np.subtract.outer(pixel * (np.arange(width) - width / 2), across)
    nearest = np.zeros((height, width), np.intp)
    for row in range(top, height):
        distance_y = pixel * (top + free / 2 - row) - up
        nearest[row] = (distance_x**2 + distance_y**2).argmin(axis=1)
    return nearest
