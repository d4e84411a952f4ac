"""Prepared frames are the frames: the same bytes as `encode`, whatever the numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cube_tensor_driver.device.wire.protocol import Sample, encode
from cube_tensor_driver.simulation.prepared_frames import PreparedFrame

LOWEST = {"with zeros": 0, "without a zero byte": 0x01010101}
"""Of frequencies, faults and temperatures: COBS codes long runs without a zero another way."""


@pytest.mark.parametrize("lowest", LOWEST.values(), ids=LOWEST.keys())
@settings(max_examples=60, deadline=None)
@given(
    n_cubes=st.integers(0, 20),
    n_pads=st.integers(1, 24),
    seed=st.integers(0, 2**32 - 1),
    numbers=st.lists(
        st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1)), min_size=1, max_size=5
    ),
)
def test_the_same_bytes_as_encode(lowest, n_cubes, n_pads, seed, numbers):
    random = np.random.default_rng(seed)

    def some(shape, kind):
        values = random.integers(0, 2**32, shape, np.uint32)
        whole = np.maximum(values.view("u1"), np.uint8(lowest & 1)).view("<u4").reshape(shape)
        return whole if kind == "<u4" else whole.astype("<u2").view(kind)

    sample = Sample(
        7, 3, 11, some((n_cubes, n_pads), "<u4"), some(n_cubes, "<u4"), some(n_cubes, "<i2")
    )
    prepared = PreparedFrame(sample)
    for sequence, device_us in numbers:
        again = Sample(
            sequence, 3, device_us, sample.frequency, sample.pad_fault, sample.temperature
        )
        assert prepared.encode(sequence, device_us) == encode(again)
