# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The public functions in Python: arguments that cannot be used are an error of the package, which
names the value and the fix; a path stands for the skin that it leads to."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import cube_tensor_driver as ctd
from cube_tensor_driver.config.package_data import find_package_data
from cube_tensor_driver.touch.surface import Contact
from cube_tensor_driver.touch.touch_detection import NO_TOUCHES
from cube_tensor_driver.touch.tracker.contact_tracker import ContactTracker, TrackedContact

FILE = find_package_data() / "config" / "skin_demo.yaml"
SKIN = ctd.read_skin(FILE)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: ctd.Reconstructor(SKIN).tare(["c05"]), "no cube 'c05'; cubes are numbers from 0"),
        (lambda: ctd.Reconstructor(SKIN).tare([99]), "no cube 99; cubes are numbers from 0 to 15"),
        (lambda: ctd.Reconstructor(SKIN).clear_tare([-1]), "no cube -1; cubes are numbers from 0"),
        (lambda: ctd.Reconstructor(str(FILE)), "is no skin; read_skin"),
        (lambda: ctd.Forces(FILE), "is no skin; read_skin"),
        (lambda: ctd.Forces(SKIN.poses), "is no skin; read_skin"),
        (lambda: ctd.Forces(SKIN, side=-1), "side is -1, allowed: a number above 0, in m"),
        (lambda: ctd.Forces(SKIN, side="a"), "side is 'a', allowed: a number above 0, in m"),
        (lambda: ctd.simulate(SKIN, noise="a"), "noise is 'a', allowed: a number of at least 0"),
        (lambda: ctd.simulate(SKIN, noise=-1.0), "noise is -1.0, allowed: a number of at least 0"),
        (lambda: ctd.simulate(SKIN, drift=None), "drift is None, allowed: a finite number"),
        (lambda: ctd.simulate(SKIN, rate="a"), "rate is 'a', allowed: 0.1 to 10000"),
        (lambda: ctd.simulate(SKIN, duration="a"), "duration is 'a', allowed: a time"),
        (lambda: ctd.open_links(SKIN, rate="a"), "rate is 'a', allowed: 0.1 to 10000"),
    ],
)
def test_an_argument_that_cannot_be_used_is_named_with_the_fix(call, words):
    with pytest.raises(ctd.CubeError) as refused:
        call()
    assert words in str(refused.value) and len(str(refused.value)) < 200


CONTACT = Contact(np.array([1e-3, -2e-3, 4e-3]), np.eye(3)[2], np.zeros(3), 2.5, 0.5, 3e-5, 0, 0)
TRACKED = TrackedContact(7, *CONTACT[:5], 0.0, 3e-5, *[0.0] * 5, True)
STRESS = np.where(np.arange(15) == 2, -1e3, 0.0) * np.ones((16, 1))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: ctd.simulate(SKIN, duration=8.0), "'skin': 16 cubes, 100 Hz, 8 s, 0 scans given)"),
        (lambda: ctd.Forces(SKIN, side=0.01), "(16 cubes, on squares of 10 mm)"),
        (lambda: SKIN.poses, "(16 cubes, pitch 12 mm)"),
        (lambda: ctd.SurfaceInverse(SKIN), "pitch 12 mm), 64 points 6 mm apart, depth 4 mm)"),
        (lambda: ctd.SurfaceInverse(SKIN).field(STRESS), "(64 points, pressure up to"),
        (lambda: ContactTracker(ctd.SurfaceInverse(SKIN), 300.0), "0 contacts in the newest scan)"),
        (lambda: CONTACT, "(2.5 N normal, 0.5 N shear, at [1.0 -2.0 4.0] mm, 30 mm²)"),
        (lambda: TRACKED, "(7: 2.5 N normal, 0.5 N shear, at [1.0 -2.0 4.0] mm, 30 mm²)"),
        (lambda: ctd.Touch(SKIN), "(16 cubes, 0 of them touched)"),
        (lambda: NO_TOUCHES, "(0 touches, pressure up to 0 kPa)"),
    ],
)
def test_what_a_notebook_shows_of_an_object_is_one_short_line(make, text):
    shown = make()
    assert repr(shown).startswith(type(shown).__name__) and text in repr(shown)
    assert len(repr(shown)) < 100


def test_a_path_is_accepted_where_a_skin_is():
    assert next(iter(ctd.simulate(str(FILE)))).cube.tolist() == list(range(16))
    assert ctd.SurfaceInverse(FILE).points.shape == ctd.SurfaceInverse(SKIN).points.shape
    assert ctd.Touch(FILE).limit == ctd.Touch(SKIN).limit
    with ctd.open_links(FILE, port_directory="/nowhere") as source:
        assert source.skin.names == SKIN.names
        assert repr(source) == "LinkSource('skin': 16 cubes on 2 links, open, 0 rows given)"


def test_bags_without_their_libraries_name_what_installs_them():
    program = """
import sys
sys.modules["rosbags"] = None
import cube_tensor_driver as ctd
try:
    ctd.open_bag("bag")
except ctd.CubeError as error:
    print(error)
"""
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "open_bag needs the Python package rosbags" in done.stdout
    assert "pip install 'cube_tensor_driver[bags]'" in done.stdout
