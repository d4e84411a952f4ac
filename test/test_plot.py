"""Pictures leave matplotlib's global settings alone and need no display."""

from __future__ import annotations

import subprocess
import sys

from conftest import ROOT

PROGRAM = """
import importlib, pathlib, pkgutil, sys
import matplotlib
before = matplotlib.rcParams.copy()
from cube_tensor_driver import plot
for module in pkgutil.iter_modules(plot.__path__):
    importlib.import_module(f"{plot.__name__}.{module.name}")
from cube_tensor_driver.core.layout import LAYOUTS
from cube_tensor_driver.plot.calibration import draw_layout
from cube_tensor_driver.plot.style import save
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
