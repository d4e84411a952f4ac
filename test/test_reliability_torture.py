"""A short torture: the whole chain in real processes under a mix of faults, checked to the last
sample and bit."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from conftest import ROOT

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

KEYS = {
    "samples_sent",
    "delivered",
    "counted",
    "unaccounted",
    "wrong",
    "reconnects",
    "worst_reconnect_s",
    "stamp_error_p99_ms",
    "threads_leaked",
    "rss_growth_mb",
    "crashes",
}


@pytest.mark.alone
def test_a_tortured_skin_loses_nothing_uncounted_and_says_nothing_wrong(domain, tmp_path):
    path = tmp_path / "torture.json"
    # The last fault of this mix ends before the eight seconds do.
    code = f"""
import pathlib
from cube_tensor_driver.trials import torture
torture.SETTLE_S = 4.0
torture.run_torture(duration=8.0, seed=3, json_path=pathlib.Path({str(path)!r}))
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
    )
    try:
        output, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert path.exists(), output
    result = json.loads(path.read_text())
    assert set(result) >= KEYS
    assert result["delivered"] > 32 * 500 * 8 and result["counted"] > 0
    # One hub came back under another name, another one behind its bridge (TCP)
    assert result["reconnects"] == 2 and result["worst_reconnect_s"] < 3.0
    for name in ("unaccounted", "wrong", "wrong_tensors", "threads_leaked", "crashes"):
        assert result[name] == 0, output
