# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""What is computed once is kept: right, bounded, and made again where a file is damaged."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from cube_tensor_driver.mechanics import cache


class Counted:
    """Makes arrays, and counts how often."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.times += 1
        return {"one": np.arange(300.0), "other": np.full((2, 3), 7, np.float32)}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "cube_tensor_driver"


def test_it_is_made_once_for_each_input(folder):
    make = Counted()
    made = cache.load_or_compute("kind", [1.0, np.arange(3)], make)
    again = cache.load_or_compute("kind", [1.0, np.arange(3)], make)
    assert make.times == 1
    for name, array in make().items():
        for one in (made, again):
            np.testing.assert_array_equal(one[name], array)
            assert one[name].dtype == array.dtype
    make.times = 0
    for number, other in enumerate(([1.0, np.arange(4)], [1.1, np.arange(3)], [1.0, np.ones(3)])):
        cache.load_or_compute("kind", other, make)
        assert make.times == number + 1
    assert len(list(folder.iterdir())) == 4


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text", "method", "lost", "shape"])
def test_a_damaged_file_is_made_again(folder, damage):
    make = Counted()
    cache.load_or_compute("kind", [1.0], make)
    (path,) = folder.iterdir()
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 4
    damaged = {"cut": data[: len(data) // 2], "flipped": data, "empty": b"", "text": b"no zip"}
    # The directory at the end of a zip file has the method of compression 10 bytes after "PK12".
    method = bytearray(path.read_bytes())
    method[method.index(b"PK\1\2") + 10] = 77
    with np.load(path) as file:
        arrays = dict(file)
    path.write_bytes(damaged.get(damage, method))
    if damage == "lost":
        np.savez(path, **{name: array for name, array in arrays.items() if name != "other"})
    if damage == "shape":
        np.savez(path, **arrays | {"other": arrays["other"].T})
    found = cache.load_or_compute("kind", [1.0], make)
    np.testing.assert_array_equal(found["one"], np.arange(300.0))
    assert make.times == 2 and found["other"].shape == (2, 3)
    cache.load_or_compute("kind", [1.0], make)
    assert make.times == 2


def test_it_is_bounded_and_the_oldest_go(folder, monkeypatch):
    make = Counted()
    cache.load_or_compute("kind", [0], make)
    (first,) = folder.iterdir()
    monkeypatch.setattr(cache, "MAX_CACHE_BYTES", 3 * first.stat().st_size)
    for number in range(1, 3):
        cache.load_or_compute("kind", [number], make)
    for age, path in enumerate(sorted(folder.iterdir(), key=lambda one: one != first)):
        os.utime(path, (1e9 + age, 1e9 + age))
    cache.load_or_compute("kind", [0], make)  # used again: it stays
    cache.load_or_compute("kind", [3], make)
    assert len(list(folder.iterdir())) == 3 and first.exists()


def test_without_a_place_to_write_it_is_made_each_time(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    make = Counted()
    for _ in range(2):
        assert cache.load_or_compute("kind", [1.0], make)["one"][299] == 299
    assert make.times == 2
