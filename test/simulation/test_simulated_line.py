# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated hubs on real pseudo-terminals, which take some 10 kB at a time."""

from __future__ import annotations

import os
import select
import threading
import time

from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.skin import read_skin
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.device.wire.decoder import Decoder
from cube_tensor_driver.device.wire.protocol import Command, Request, Sample, encode
from cube_tensor_driver.simulation.load import Load, read_default_script
from cube_tensor_driver.simulation.simulator import FIRST_BOOT_US, Simulator, StopRequest

PERIOD_S = 0.5
SLOW_BYTES = 512
"""Number of bytes that the host reads at a time, so that the line is full meanwhile."""

N_CUBES = 1600
"""Number of cubes of the hub. Its samples have 61 kB, which is more than the line takes at once."""


def test_a_large_sample_arrives_before_the_next_is_taken(tmp_path):
    path = tmp_path / "skin.yaml"
    write_yaml(path, describe_grid(nx=N_CUBES, ny=1, pitch=0.01, rate=1 / PERIOD_S))
    skin = read_skin(path)
    load = Load(skin, read_default_script())
    simulator = Simulator(skin, load, tmp_path / "ports", instants=1)
    stop = StopRequest()
    thread = threading.Thread(target=simulator.run, args=(stop,))
    thread.start()
    port = os.open(tmp_path / "ports" / "hub0", os.O_RDWR | os.O_NOCTTY)
    try:
        period_us = round(1e6 * PERIOD_S)
        requests = Request(Command.SET_PERIOD, period_us), Request(Command.START)
        os.write(port, b"".join(map(encode, requests)))
        decoder = Decoder()
        delays_us = []
        until_s = time.monotonic() + 20 * PERIOD_S
        while len(delays_us) < 3 and time.monotonic() < until_s:
            ready, _, _ = select.select([port], [], [], PERIOD_S)
            frames = decoder.feed(os.read(port, SLOW_BYTES)) if ready else []
            now_us = simulator.now_us() + FIRST_BOOT_US
            delays_us += [now_us - one.device_us for one in frames if isinstance(one, Sample)]
    finally:
        stop.request()
        thread.join()
        os.close(port)
        simulator.close()
    assert len(delays_us) == 3
    # Of three samples, at least one meets no pause of the machine.
    assert 0 <= min(delays_us) < period_us
