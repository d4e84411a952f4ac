# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What the hubs sent in each sample, as the tortured simulator has stored it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cube_tensor_driver.core.arrays import Array, Index, Integers, Mask, PadMasks, Records, Single
from cube_tensor_driver.core.matching import NO_MATCH
from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.device.wire.protocol import TEMPERATURE_UNKNOWN
from cube_tensor_driver.simulation.sample_log import SampleLog

from .record import LATEST_NS, Samples, Span

MIN_EQUAL_SHARE = 0.5
"""Smallest share of the pads of a row (one cube at one sampling time) that must have the sent
reading. With fewer, the row counts as one of another sample with the same number."""

CHUNK = 100_000
"""Maximum number of rows (one cube at one sampling time) that are compared at a time, so that the
memory for intermediate results does not grow with the duration of a run."""

HERTZ_PER_MILLIHERTZ = 1e-3
"""Factor from the unit of frequencies on the wire (mHz) to that of messages (Hz)."""


def make_reading_type(n_cubes: int, n_pads: int) -> np.dtype[np.void]:
    """Return the format of the readings of a hub in one sample.

    The fields are frequencies in mHz (0: none), temperature in 0.01 °C, and one bit for each pad
    that the hub reports as broken.
    """
    return np.dtype(
        [
            ("millihertz", "<u4", (n_cubes, n_pads)),
            ("centi_celsius", "<i2"),
            ("pad_fault", "<u4", (n_cubes,)),
        ]
    )


def read_readings(
    folder: Path,
    log: SampleLog,
    n_pads: int,
) -> Records:
    """Read the readings of all S samples, in the order of the log's table.

    Args:
        folder: Folder with one file for each link.
        log: The sample log.
        n_pads: Number of pads of each cube.
    """
    parts = [
        np.fromfile(folder / link.name, make_reading_type(len(link.cubes), n_pads))
        for link in log.links
    ]
    return np.concatenate(parts)


@dataclass(frozen=True)
class Readings:
    """Values that N rows (one cube at one sampling time each) of frequencies should have.

    Attributes:
        frequency: Frequency of each pad (N, P), in Hz; NaN where nothing is measured.
        temperature: Temperature (N,), in °C; NaN where it is unknown.
        pad_fault: Bits (N,), of which bit p is set if the hub reports that pad p is broken.
    """

    frequency: Single
    temperature: Single
    pad_fault: PadMasks


class SentReadings:
    """Finds what the hubs sent for any cube in any sample."""

    def __init__(self, samples: Samples, readings: Records) -> None:
        """Store the readings (S,), see `read_readings`, of all samples of the hubs."""
        self._samples, self._readings = samples, readings
        members = [link.cubes for link in samples.log.links]
        # Index of each cube of the skin on its hub.
        self._index_on_hub = np.zeros(1 + max(map(max, members)), int)
        for cubes in members:
            self._index_on_hub[list(cubes)] = np.arange(len(cubes))

    def select(self, cube: Integers, sample: Index) -> Readings:
        """Return the readings of cubes (N,) in samples (N,)."""
        readings = self._readings[sample]
        row, on_hub = np.arange(len(sample)), self._index_on_hub[cube]
        millihertz = readings["millihertz"][row, on_hub]
        frequency = (millihertz * HERTZ_PER_MILLIHERTZ).astype(np.float32)
        # A hub sends 0 for a pad whose oscillator has stopped.
        frequency[millihertz == 0] = np.nan
        hundredths = readings["centi_celsius"]
        # The decoder computes the same float32 product, so that the results must have equal bits.
        temperature = hundredths.astype(np.float32) * np.float32(0.01)
        temperature[hundredths == TEMPERATURE_UNKNOWN] = np.nan
        return Readings(
            frequency,
            temperature,
            readings["pad_fault"][row, on_hub],
        )

    def find_held(self, cubes: list[int], span: Span) -> Array | None:
        """Return the constant readings of cubes of one link in a span of time.

        Returns:
            Readings (cubes, P), in Hz; None if they changed in the span, or if nothing was sampled.
        """
        samples = self._samples
        is_of_link = samples.link == samples.table.link_of_cube[cubes[0]]
        mine = np.flatnonzero(is_of_link & span.contains(samples.time_ns))
        readings = self._readings["millihertz"][mine][:, self._index_on_hub[cubes]]
        if not len(mine) or (readings != readings[0]).any():
            return None
        return np.asarray(readings[0] * HERTZ_PER_MILLIHERTZ)

    def find_samples(self, rows: FrequencyRows) -> Index:
        """Find the sample of each row (N,); `NO_MATCH` if no hub took such a sample.

        A hub that restarts uses the same sample numbers again, and after a long cut the stamp of a
        row may be nearer to the wrong sample with its number. If the readings of that sample differ
        from the row, a sample with this number and the right readings is taken instead.
        """
        table, boot = self._samples.table, self._samples.boot
        sample = table.match(rows)
        known = np.flatnonzero(sample != NO_MATCH)
        is_alike = self._resembles(rows.select(known), sample[known])
        unlike = known[~is_alike]
        others = rows.select(unlike)

        best_ns = np.full(len(unlike), LATEST_NS)
        for number in np.unique(boot):
            # Within one life of a hub, each number occurs once.
            candidate = table.match(others, np.flatnonzero(boot == number))
            found = np.flatnonzero(candidate != NO_MATCH)
            is_alike = self._resembles(others.select(found), candidate[found])
            found = found[is_alike]
            taken_ns = table.time_ns[candidate[found]]
            distance_ns = np.abs(taken_ns - others.stamp_ns[found])
            is_nearer = distance_ns < best_ns[found]
            nearer = found[is_nearer]
            best_ns[nearer] = distance_ns[is_nearer]
            sample[unlike[nearer]] = candidate[nearer]
        return sample

    def _resembles(self, rows: FrequencyRows, sample: Index) -> Mask:
        """Return whether rows (N,) mostly have the readings of samples (N,)."""
        resembles = np.zeros(len(rows), bool)
        for part in split_in_chunks(np.arange(len(rows))):
            sent = self.select(rows.cube[part], sample[part]).frequency
            # Pads that measure nothing do not tell samples apart.
            is_equal = sent == rows.frequency[part]
            is_equal |= np.isnan(sent)
            resembles[part] = is_equal.mean(axis=1) >= MIN_EQUAL_SHARE
        return resembles


def split_in_chunks(index: Index) -> list[Index]:
    """Split indices (N,) into parts of at most `CHUNK`."""
    return np.array_split(index, 1 + len(index) // CHUNK)
