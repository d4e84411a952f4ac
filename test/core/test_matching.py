# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rows of one table found in another by cube, sequence number and stamp."""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.matching import NO_MATCH, SampleKeys, match_rows


def keys(*rows: tuple[int, int, int]) -> SampleKeys:
    """Return the keys of rows that are given as (cube, sequence, stamp)."""
    cube, sequence, stamp_ns = np.array(rows, np.int64).reshape(-1, 3).T
    return SampleKeys(cube.astype(np.uint16), sequence.astype(np.uint32), stamp_ns)


def test_rows_are_found_in_any_order():
    random = np.random.default_rng(1)
    cube, number = np.meshgrid(np.arange(5), np.arange(40), indexing="ij")
    known = SampleKeys(
        cube.ravel().astype(np.uint16),
        (number.ravel() + 2**32 - 20).astype(np.uint32),  # wraps
        1000 * number.ravel(),
    )
    order = random.permutation(200)
    shuffled = SampleKeys(*(column[order] for column in known))
    np.testing.assert_array_equal(shuffled.cube[match_rows(shuffled, known)], known.cube)
    np.testing.assert_array_equal(order[match_rows(shuffled, known)], np.arange(200))


def test_what_is_not_there_has_no_match():
    known = keys((0, 7, 10), (65535, 2**32 - 1, 20))
    wanted = keys((65535, 2**32 - 1, 20), (0, 8, 10), (1, 7, 10), (0, 7, 99))
    assert match_rows(known, wanted).tolist() == [1, NO_MATCH, NO_MATCH, 0]
    assert match_rows(keys(), wanted).tolist() == [NO_MATCH] * 4
    assert match_rows(known, keys()).tolist() == []


def test_the_nearest_stamp_decides_among_numbers_that_were_given_again():
    known = keys((3, 1, 100), (3, 1, 9000), (3, 2, 120), (3, 1, 500))
    wanted = keys((3, 1, 510), (3, 1, 8000), (3, 1, -50), (3, 2, 9000))
    assert match_rows(known, wanted).tolist() == [3, 1, 0, 2]
