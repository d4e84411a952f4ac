# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The nodes run where rclpy lacks what older releases of ROS 2 lack."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs rclpy: run this with ./cube test")

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy_without import FEATURES

from conftest import ROOT, decoded
from cube_tensor_driver.config.grid import describe_grid
from cube_tensor_driver.config.yaml import write_yaml
from cube_tensor_driver.msg import SkinFrequencies, SkinStress
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import SimulatedHubs, list_skin_processes


def test_nodes_run_where_rclpy_lacks_what_humble_lacks(ros, tmp_path, monkeypatch):
    """In one process, where frequencies are published only if somebody subscribes. A parameter that
    is set takes effect, and the log says once that the executor is the slow one."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "test"), prepend=":")
    skin = tmp_path / "skin.yaml"
    write_yaml(skin, describe_grid(nx=2, ny=1, pitch=0.01, links=1, rate=100.0))
    stress = ros.listen(SkinStress, "stress")
    frequencies = ros.listen(SkinFrequencies, "frequencies")
    hubs = SimulatedHubs(tmp_path / "ports")
    with Children(tmp_path) as children:
        for process in list_skin_processes(skin, composed=True, simulated=hubs):
            if process.node:
                arguments = ",".join(FEATURES), process.module
                process = replace(process, module="rclpy_without", arguments=arguments)
                executable = process.executable
            children.start(process)
        ros.wait(lambda: len(stress) > 10 and len(frequencies) > 10)
        rate = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=20.0)
        request = SetParameters.Request(parameters=[Parameter(name="rate", value=rate)])
        answer = ros.call(SetParameters, "/driver/set_parameters", request)
        assert answer.results[0].successful, answer.results[0].reason
        ros.wait(lambda: period_s(stress[-5:]) > 0.04)  # 0.05 s, where it was 0.01 s
        children.check()
        assert children.log(executable).count("this rclpy has no EventsExecutor") == 1


def period_s(messages):
    """The shortest time between two messages."""
    stamps = [int(decoded(message).rows.stamp_ns[0]) for message in messages]
    return 1e-9 * np.diff(stamps).min()
