# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the whole chain: it must count right; how fast it is, is for whoever runs it."""

from __future__ import annotations

import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from cube_tensor_hub.firmware import find_missing
from workshop.bench import skin as bench

KEYS = {
    "cubes",
    "rate_hz",
    "duration_s",
    "samples_expected",
    "samples_sent",
    "tensors_received",
    "lost",
    "skipped",
    "latency_p50_ms",
    "cpu_hubs_percent",
    "cpu_driver_percent",
    "cpu_reconstruction_percent",
    "latency_p99_ms",
    "echo_cpu_percent",
    "ratio_to_echo",
    "rss_mb",
    "first_tensor_s",
}


@pytest.mark.alone
@pytest.mark.skipif(bool(find_missing("make", "cc")), reason=find_missing("make", "cc"))
def test_skin_counts_what_was_sent(domain, tmp_path):
    """In batches of two: the first row of each waits a period, 10 ms, for the second."""
    path = tmp_path / "figures.json"
    # Pauses and a second floor are for figures only.
    code = f"""
import functools, json, os, pathlib, sys
from workshop.bench import skin as bench
bench.SETTLE_S = bench.DRAIN_S = 0.2
bench._measure_echo = functools.cache(bench._measure_echo)
os.environ["ROS_DOMAIN_ID"] = "77"
domains, profile = set(), bench.make_batch_profile
bench.make_batch_profile = lambda rate: domains.add(os.environ["ROS_DOMAIN_ID"]) or profile(rate)
figures = bench.bench_skin(3, bench.Bench(rate=100.0, duration=0.6, publish_period=0.02))
pathlib.Path({str(path)!r}).write_text(json.dumps(figures))
if domains & {{"77"}} or not domains or os.environ["ROS_DOMAIN_ID"] != "77":
    sys.exit("the skins mix with those of domain 77")
"""
    command = [sys.executable, "-c", code]
    process = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert process.returncode == 0, process.stderr
    figures = json.loads(path.read_text())
    assert figures.keys() == KEYS
    # The measured time ends where a loop of the receiver does.
    assert 3 * 50 <= figures["samples_sent"] <= 3 * 150 and figures["samples_sent"] % 3 == 0
    assert figures["lost"] == figures["samples_sent"] - figures["tensors_received"] == 0
    assert figures["latency_p99_ms"] > 9.0


def test_growth_of_memory():
    """A steady rise is found; steps up and down are no growth; the hubs do not count."""
    rng = np.random.default_rng(0)
    minutes = np.arange(1200) / 120
    line = 80 + 0.5 * minutes + rng.normal(0, 0.05, 1200)
    found = bench.summarise_memory(
        {"hubs": [999.0] * 1200, "driver": list(line), "reconstruction": [90.0] * 1200}
    )
    assert found["rss_mb"] == 90.0
    assert found["rss_mb_per_minute"] == pytest.approx(0.5, abs=0.003)
    steps = 80 + np.repeat(rng.normal(0, 0.3, 60), 20)
    found = bench.summarise_memory({"driver": list(steps)})
    assert abs(found["rss_mb_per_minute"]) < 0.02
    assert "rss_mb_per_minute" not in bench.summarise_memory({"driver": [80.0] * 20})


@pytest.mark.alone
@pytest.mark.skipif(bool(find_missing("make", "cc")), reason=find_missing("make", "cc"))
def test_links_counts_what_hubs_in_c_sent(tmp_path):
    figures = tmp_path / "figures.json"
    command = [sys.executable, "-c", LINKS, figures]
    subprocess.run(command, capture_output=True, check=True, timeout=60)
    found = json.loads(figures.read_text())
    assert found["cubes"] == 3
    # On a busy host the hubs begin late, and the measured time ends late.
    counted = found["rows"] + found["lost"]
    assert found["rows_expected"] / 2 < counted < 2 * found["rows_expected"]
    assert 0 < found["cpu_percent"] < 100


LINKS = """
import json
import sys
from types import SimpleNamespace
from pathlib import Path
from workshop.bench import links as bench_links
bench_links.SETTLE_S = 0.2
figures = bench_links.bench_links(cubes=3, rate=100.0, duration=1.0)
Path(sys.argv[1]).write_text(json.dumps(figures))
"""


@pytest.mark.parametrize("error_ns", [-300_000, 300_000])
def test_the_latency_of_touch_counts_from_its_own_sample(error_ns):
    """Although its stamp, which the clocks of the hubs give, is 0.3 ms off."""
    rng = np.random.default_rng(2)
    sampled_ns = 10**18 + np.arange(1000) * 1_000_000
    touches = np.column_stack([sampled_ns + error_ns, sampled_ns + 2_000_000])
    span = SimpleNamespace(start_ns=10**18 + 100_500_000, end_ns=10**18 + 899_500_000)
    taken = SimpleNamespace(time_ns=rng.permutation(sampled_ns))
    settings = bench.Bench(1000.0, 1.0, topic="touch")
    found = bench._summarise_found(settings, touches, taken, span)
    assert found == {
        "touch_messages": 799,
        "touch_latency_p50_ms": 2.0,
        "touch_latency_p99_ms": 2.0,
    }
