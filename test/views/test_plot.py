# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures leave matplotlib's global settings alone and need no display."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="needs pyarrow: pip install pyarrow")
pytest.importorskip("rosbags", reason="needs rosbags: pip install rosbags")

from conftest import ROOT
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.views.figures.time_series import TimeSeries, draw_series

PROGRAM = """
import importlib, pathlib, pkgutil, sys
import matplotlib
before = matplotlib.rcParams.copy()
from cube_tensor_design import figures as design
from cube_tensor_driver.views import figures
for package in (figures, design):
    for module in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{package.__name__}.{module.name}")
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.views.figures.calibration import draw_layout
from cube_tensor_driver.views.figures.style import save
save(draw_layout(LAYOUTS["cube"]), pathlib.Path(sys.argv[1]))
assert "matplotlib.pyplot" not in sys.modules
assert matplotlib.rcParams.copy() == before
"""


def test_drawing_changes_no_global_setting_and_opens_no_window(tmp_path):
    picture = tmp_path / "cube.png"
    command = [sys.executable, "-c", PROGRAM, str(picture)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert picture.stat().st_size > 10_000


def test_no_line_bridges_a_gap():
    seconds = np.delete(np.arange(100) / 100, slice(40, 60))
    n = len(seconds)
    series = TimeSeries(
        name="c0",
        pads=["a", "b"],
        seconds=seconds,
        frequency=np.full((n, 2), 1e5),
        rest=np.full(2, 1e5),
        rows=StressRows.from_values(
            np.zeros(n, np.uint16), np.zeros((n, 6)), np.zeros((n, 9)), residual=1.0
        ),
    )
    lines = [line for axes in draw_series(series, "bag").axes for line in axes.lines]
    assert len(lines) == 2 + 15 + 1
    for line in lines:
        x, y = (np.asarray(values, float) for values in line.get_data())
        drawn = np.isfinite(x) & np.isfinite(y)
        assert drawn.sum() == n
        joined = drawn[1:] & drawn[:-1]
        assert np.diff(x)[joined].max() < 0.02
