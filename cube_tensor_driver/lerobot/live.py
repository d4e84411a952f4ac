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
from collections import deque
from pathlib import Path

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

NUMBER_NS = 1_000_000
"""Unit, in ns, of the time that is the number of a frame."""

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

WRITING_DELAY_MS = 2000
"""Time, in ms, from the reading of a frame to the writing of its window (the samples of stress
since the frame before). Samples that arrive later get into the oldest window not yet written.

The delay leaves time for samples that a busy computer holds up. A longer one would not help,
because a live source drops samples that have waited longer than this (`QUEUE_S`).
"""

UNKNOWN_GREY = 90
"""Brightness (0 to 255) of the cubes whose stress along z is unknown."""

NO_ROWS = StressRows.from_values(
    np.empty(0, np.uint16),
    np.empty((0, 6)),
    np.empty((0, 9)),
)
"""A table without rows. The list of the parts of each window begins with it, because `concatenate`
requires at least one table."""


class LiveWindows:
    """Writes the stress of a live skin to a file, one window for each frame.

    The window of a frame consists of the samples with stamps up to its frame number (a time) that
    are in no earlier window. It is written `WRITING_DELAY_MS` later, so that samples that are still
    on their way when the frame is read get into it. A thread collects samples as they arrive,
    whatever the recorder does meanwhile. Windows may differ in length, so a pause of the recorder
    makes only one window longer. The file is FOLDER/NUMBER.arrow, with the number of the first
    frame. It is an Arrow stream, which stays readable if the program is killed.
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
        self._cube_at = find_nearest_cubes(source.skin, width, height)
        self._writer: pyarrow.ipc.RecordBatchStreamWriter | None = None
        self._failure: CubeError | None = None
        self._level = np.full(len(source.skin.cubes), np.nan)
        self._arrived: deque[StressRows] = deque()
        self._has_arrived = threading.Event()
        self._number = 0
        # Numbers of the frames whose windows have not been written, and the parts of these windows.
        # The last list of parts has the samples that are newer than all frames.
        self._unwritten: list[int] = []
        self._parts = [[NO_ROWS]]
        self._thread = threading.Thread(target=self._collect, daemon=True)
        self._thread.start()

    def take_next_picture(self, timeout_s: float) -> AnyArray:
        """Begin a frame and return its picture.

        Args:
            timeout_s: Longest time, in s, to wait for a sample if none has arrived since the frame
                before.

        Returns:
            Picture (height, width, 3) of 8 bits: the newest pressure of each cube in red, tension
            in blue, and the frame number at the top.

        Raises:
            TimeoutError: No sample arrived.
            CubeError: The thread that reads the links has failed.
        """
        if not self._has_arrived.wait(timeout_s):
            raise self._failure or TimeoutError(
                f"skin {self._source.skin.name}: no sample in {timeout_s:g} s; check that the hubs "
                "are connected and that no other program reads them"
            )
        self._has_arrived.clear()
        now = time.time_ns() // NUMBER_NS
        # Once the clock of the computer has been set back, stamps do not tell the frame of a
        # sample. Then all older windows are completed, so that the frame gets what has arrived.
        is_rising = now > self._number
        self._write_windows(now - WRITING_DELAY_MS if is_rising else self._number)
        self._number = now if is_rising else self._number + 1
        self._unwritten.append(self._number)
        self._parts.append([NO_ROWS])
        self._sort_arrived()
        return self._make_picture()

    def close(self) -> None:
        """Close the links and complete the file. Samples after the last frame are left out."""
        self._source.close()
        self._thread.join()
        self._sort_arrived()
        self._write_windows(self._number)
        if self._writer is not None:
            self._writer.close()
            # `close` has ended the stream. The file is closed when the writer is deleted.
            self._writer = None

    def _collect(self) -> None:
        """Reconstruct the stress of all samples as they arrive; runs in a thread of its own."""
        reconstruct = Reconstructor(self._source.skin)
        try:
            for frequencies in self._source:
                rows = reconstruct(frequencies)
                # Where a cube occurs repeatedly, numpy keeps the last value, which is the newest.
                self._level[rows.cube] = -rows.stress[:, 2] / self._full_scale
                self._arrived.append(rows)
                self._has_arrived.set()
        except CubeError as error:
            self._failure = error

    def _sort_arrived(self) -> None:
        """Put the samples that have arrived into the windows of their stamps."""
        ends_ns = NUMBER_NS * np.array(self._unwritten)
        while self._arrived:
            rows = self._arrived.popleft()
            window = np.searchsorted(ends_ns, rows.stamp_ns)
            for index in np.unique(window):
                self._parts[index].append(rows.select(window == index))

    def _write_windows(self, last: int) -> None:
        """Write the windows of the frames up to the number `last` to the Arrow stream."""
        while self._unwritten and self._unwritten[0] <= last:
            number, rows = self._unwritten.pop(0), concatenate(self._parts.pop(0))
            # A window has at least one place for samples, even if it has no sample.
            depth = int(np.bincount(rows.cube, minlength=1).max(initial=1))
            first_frame = np.zeros(len(rows), np.intp)
            columns = arrange_windows(
                first_frame,
                rows,
                (1, depth, len(self._level)),
            )
            columns[NUMBER_COLUMN] = np.array([number])
            batch = pyarrow.record_batch({name: as_column(one) for name, one in columns.items()})
            if self._writer is None:
                path = self._folder / f"{number}.arrow"
                self._writer = pyarrow.ipc.new_stream(str(path), batch.schema)
            self._writer.write_batch(batch)

    def _make_picture(self) -> AnyArray:
        """Return the picture of the newest pressures, with the frame number at the top."""
        red_and_blue = np.outer(self._level, [1, 0, -1])
        colours = np.nan_to_num(255 * np.clip(red_and_blue, 0, 1), nan=UNKNOWN_GREY)
        picture: AnyArray = colours.astype(np.uint8)[self._cube_at]

        number_bytes = self._number.to_bytes(NUMBER_BYTES, "big")
        bits = np.unpackbits(np.frombuffer(number_bytes, np.uint8)).reshape(NUMBER_GRID)
        side = picture.shape[1] // NUMBER_GRID[1]
        squares = np.kron(bits, np.full((MIN_SQUARE, side), 255, np.uint8))
        rows, columns = squares.shape
        picture[:rows, :columns] = squares[..., np.newaxis]
        return picture


class RecordedWindows:
    """Reads windows (the samples of one frame each) from a folder that `LiveWindows` wrote.

    A window is found by its frame number, which the picture of the frame shows as black and white
    squares.

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

    def find(self, picture: AnyArray) -> dict[str, AnyArray]:
        """Return the window (samples of one frame) whose number the squares in a picture show.

        Args:
            picture: Picture of the skin in a frame of the data set, (height, width, 3) or
                (3, height, width) as LeRobot returns it.

        Returns:
            Features by the names that `./cube export lerobot` gives them, (samples, cubes, …) each.

        Raises:
            BagError: The folder has no window with this number.
        """
        return self.find_frame(read_frame_number(picture))

    def find_frame(self, number: int) -> dict[str, AnyArray]:
        """Return the window that was stored under a frame number; result and errors: see `find`."""
        if number not in self._frames:
            raise BagError(f"no window has the number {number}; name the folder of this data set")
        batch = self._frames[number]
        names = batch.schema.names
        return {name: as_array(batch[name])[0] for name in names if name != NUMBER_COLUMN}


def read_frame_number(picture: AnyArray) -> int:
    """Read the frame number that black and white squares in a picture show.

    The number is the time at which the picture was read from the camera, in ms since the Unix
    epoch.

    Args:
        picture: Picture of a skin, (height, width, 3) or (3, height, width).
    """
    pixels = np.asarray(picture, float)
    grey = pixels.mean(axis=0 if len(pixels) == 3 else 2)
    rows, columns = NUMBER_GRID
    side = grey.shape[1] // columns
    centre_rows = slice(MIN_SQUARE // 2, rows * MIN_SQUARE, MIN_SQUARE)
    centre_columns = slice(side // 2, columns * side, side)
    squares = grey[centre_rows, centre_columns]
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
    x = pixel * (np.arange(width) - width / 2)
    distance_x = np.subtract.outer(x, across)
    nearest = np.zeros((height, width), np.intp)
    for row in range(top, height):
        distance_y = pixel * (top + free / 2 - row) - up
        nearest[row] = (distance_x**2 + distance_y**2).argmin(axis=1)
    return nearest
