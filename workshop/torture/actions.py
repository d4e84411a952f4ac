# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Actions of a torture on the nodes: what their users do, and what a crash does."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from std_srvs.srv import Trigger

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.demo.running import Observer
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import Process
from cube_tensor_driver.srv import Tare

from ..checks.record import NS_PER_S, NodeAction
from .mix import HELD_CUBES
from .recorder import TopicLog

MAX_START_S = 40.0
"""Longest time, in seconds, until a node has started."""

MAX_ANSWER_S = 10.0
"""Longest time, in seconds, for which this process waits for one answer of a node."""

ANSWER_TRIES = 4
"""Maximum number of requests to a node that does not answer. An answer is lost if the node has not
yet discovered the client in this process."""

MAX_TARE_S = 3.0
"""Time, in seconds, for which a tare (measurement of the rest frequencies) is requested again after
a refusal. A tare is refused while data have a gap; the load is held for longer than this time."""

TARE_PERIOD_S = 0.3
"""Time, in seconds, between two requests of a tare (measurement of the rest frequencies)."""

MIN_TARED_S = 1.0
"""Shortest time, in seconds, for which a tare stays in force, so that its tensors can be checked
also where this process is late."""

MIN_RATE_S = 1.1
"""Minimum time, in seconds, for which a sampling rate that was set late stays in force. The check
of a rate needs this time before the next change."""

MAX_RATE_DELAY_S = 0.05
"""Largest delay, in seconds, of a change of the sampling rate with which the rate still stays in
force long enough for its check. After a longer delay, the next action waits for `MIN_RATE_S`."""

MAX_STRESS_AGE_S = 0.5
"""Age, in seconds, of the newest stress above which the host is too busy for a tare, which may be
refused then."""

MAX_DELAY_S = 0.5
"""Largest delay, in seconds, with which a tare still comes while the load is held constant. A tare
with a longer delay may be refused."""

FLUSH_S = 0.3
"""Time, in seconds, within which messages arrive that a process sent just before its end."""

DISCOVERY_S = 1.0
"""Time, in seconds, between the discovery of all topics and the activation of the driver, so that
the first sample is received too."""

OTHER_SUBSCRIBER = "markers"
"""Name of the node that subscribes to the topic `stress` beside this process."""

TRANSITIONS = "driver/transition_event"
"""Name of a topic that the driver publishes as soon as it can be configured."""

ActionResult = tuple[bool, str]
"""Result of an action: whether the node did what was requested, and the text of its answer."""

DOWN = (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP)
"""Transitions of lifecycle that stop an active node and free what it holds."""
UP = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
"""Transitions of lifecycle that start an unconfigured node again."""


class Actions:
    """Carries actions on the nodes out, one after the other.

    Attributes:
        done: All actions so far.
        refused: Answers to tares that were refused because the host was too busy.
    """

    def __init__(
        self,
        observer: Observer,
        children: Children,
        processes: Mapping[str, Process],
        skin: Skin,
        stress: TopicLog[StressRows],
        on_driver_killed: Callable[[], None],
    ) -> None:
        """Create the clients of the nodes' services.

        Args:
            observer: Node that observes the skin.
            children: The processes of the skin.
            processes: How to start each process, by its name.
            skin: The skin.
            stress: Log of the topic `stress`.
            on_driver_killed: Called when the driver is dead and its last messages have arrived.
        """
        self.done: list[NodeAction] = []
        self.refused: list[str] = []
        self._observer, self._children, self._processes = observer, children, processes
        self._skin, self._stress = skin, stress
        self._on_driver_killed = on_driver_killed
        self._is_late = False
        self._begin_ns = 0
        make_client: Callable[..., Client] = observer.node.create_client
        self._states = {
            name: make_client(ChangeState, f"{name}/change_state")
            for name in ("driver", "reconstruction")
        }
        self._tare = make_client(Tare, "reconstruction/tare")
        self._clear = make_client(Trigger, "reconstruction/clear_tare")
        self._parameters = make_client(SetParameters, "driver/set_parameters")
        self._kinds: dict[str, Callable[..., ActionResult]] = {
            "stall reconstruction": partial(self._pause, "reconstruction"),
            "stall subscriber": partial(self._pause, OTHER_SUBSCRIBER),
            "rate": self._set_rate,
            "tare": self._take_tare,
            "clear": partial(self._call, self._clear, Trigger.Request()),
            "restart reconstruction": self._restart_reconstruction,
            "reconfigure reconstruction": self._reconfigure_reconstruction,
            "cycle driver": self._cycle_driver,
            "restart driver": self._restart_driver,
        }

    def start_driver(self, fault_pipe: Path) -> None:
        """Activate the driver when both ends of every topic have discovered each other.

        Raises:
            CubeError: It did not become active.
        """
        self._observer.spin(MAX_START_S, self._states["driver"].service_is_ready)
        # The pipe exists as soon as the simulator has opened its ports.
        if not self._activate_driver(set(), fault_pipe.exists):
            log = self._children.log("driver")[-1500:]
            raise CubeError(f"the driver did not become active:\n{log}")

    def stop_driver(self) -> None:
        """Deactivate the driver."""
        self._change("driver", Transition.TRANSITION_DEACTIVATE)

    def do(self, event: Mapping[str, Any], delay_s: float) -> None:
        """Carry out an event of the mix, `delay_s` seconds after its time."""
        options = dict(event)
        kind = options.pop("action")
        self._is_late = delay_s > MAX_DELAY_S
        self._begin_ns = time.time_ns()
        succeeded, answer = self._kinds[kind](**options)
        action = NodeAction(
            kind=kind,
            begin_ns=self._begin_ns,
            end_ns=time.time_ns(),
            succeeded=succeeded,
            answer=answer,
            cubes=HELD_CUBES if kind == "tare" else (),
        )
        self.done.append(action)
        if kind == "tare":
            self._observer.spin(MIN_TARED_S)
        if kind == "rate" and delay_s > MAX_RATE_DELAY_S:
            self._observer.spin(MIN_RATE_S)

    def _pause(self, name: str, seconds: float) -> ActionResult:
        # A stopped process behaves like one that the system gives no processor.
        self._children.pause(name)
        self._observer.spin(seconds)
        self._children.resume(name)
        return True, ""

    def _set_rate(self, value: float) -> ActionResult:
        rate = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float(value))
        request = SetParameters.Request(parameters=[Parameter(name="rate", value=rate)])
        answer = self._ask(self._parameters, request)
        return answer is not None and answer.results[0].successful, str(value)

    def _take_tare(self) -> ActionResult:
        names = [self._skin.names[cube] for cube in HELD_CUBES]
        request = Tare.Request(cubes=names, duration=1.0)
        until_s = time.monotonic() + MAX_TARE_S
        while True:
            # A tare that is refused changes nothing, so only the last request counts.
            self._begin_ns = time.time_ns()
            age_ns = self._begin_ns - int(self._stress.decode_newest_rows().stamp_ns[-1])
            self._is_late |= age_ns > NS_PER_S * MAX_STRESS_AGE_S
            succeeded, answer = self._call(self._tare, request)
            if succeeded or time.monotonic() > until_s:
                break
            self._observer.spin(TARE_PERIOD_S)
        if self._is_late and not succeeded:
            self.refused.append(answer)
        return succeeded, answer

    def _restart_reconstruction(self) -> ActionResult:
        # The messages of the next process are numbered from 1 again.
        self._children.kill("reconstruction")
        self._stress.expect_new_publisher()
        self._children.start(self._processes["reconstruction"])
        return self._wait_for_stress()

    def _reconfigure_reconstruction(self) -> ActionResult:
        succeeded = all(self._change("reconstruction", transition) for transition in DOWN)
        self._stress.expect_new_publisher()
        succeeded &= all(self._change("reconstruction", transition) for transition in UP)
        has_stress, answer = self._wait_for_stress()
        return succeeded and has_stress, answer

    def _cycle_driver(self) -> ActionResult:
        both = (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE)
        return all(self._change("driver", transition) for transition in both), ""

    def _restart_driver(self) -> ActionResult:
        # DDS lists the publishers of a killed process for some seconds. They are remembered to
        # distinguish them from those of the new process.
        dead = self._find_publishers("frequencies")
        dead_transitions = self._find_publishers(TRANSITIONS)
        self._children.kill("driver")
        # Every sample that is taken from now on can reach only the next driver.
        self._begin_ns = time.time_ns()
        self._observer.spin(FLUSH_S)
        self._on_driver_killed()
        self._children.start(self._processes["driver"])
        self._observer.spin(
            MAX_START_S,
            lambda: bool(self._find_publishers(TRANSITIONS) - dead_transitions),
        )
        if not self._activate_driver(dead, lambda: True):
            return False, self._children.log("driver")[-500:]
        return self._wait_for_stress()

    def _activate_driver(
        self,
        dead: set[bytes],
        is_ready: Callable[[], bool],
    ) -> bool:
        """Configure the driver, and activate it when all of its subscribers have discovered it.

        Args:
            dead: Publishers of `frequencies` of a driver that was killed, which do not count.
            is_ready: Further condition for the activation.

        Returns:
            Whether the driver has become active.
        """
        node = self._observer.node

        def is_connected() -> bool:
            # `stress` has two subscribers: this process and the node `markers`. `frequencies` has
            # this process and the reconstruction.
            return (
                node.count_publishers("stress") > 0
                and node.count_subscribers("stress") > 1
                and node.count_subscribers("frequencies") > 1
                and bool(self._find_publishers("frequencies") - dead)
                and is_ready()
            )

        # The result is ignored: if an answer was lost, the request is repeated, and the driver
        # refuses to be configured twice. A real failure makes the activation fail.
        self._change("driver", Transition.TRANSITION_CONFIGURE)
        self._observer.spin(MAX_START_S, is_connected)
        self._observer.spin(DISCOVERY_S)
        return self._change("driver", Transition.TRANSITION_ACTIVATE)

    def _find_publishers(self, topic: str) -> set[bytes]:
        """Return the publishers of a topic, each by its identifier in DDS."""
        found = self._observer.node.get_publishers_info_by_topic(topic)
        return {bytes(publisher.endpoint_gid) for publisher in found}

    def _wait_for_stress(self) -> ActionResult:
        count = self._stress.count
        self._observer.spin(MAX_START_S, lambda: self._stress.count > count)
        return self._stress.count > count, ""

    def _change(self, node: str, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        answer = self._ask(self._states[node], request)
        return answer is not None and bool(answer.success)

    def _call(self, client: Any, request: Any) -> ActionResult:
        answer = self._ask(client, request)
        return (False, "no answer") if answer is None else (answer.success, answer.message)

    def _ask(self, client: Any, request: Any) -> Any:
        """Return the answer of a service; None if none came after `ANSWER_TRIES` requests."""
        self._observer.spin(MAX_START_S, client.service_is_ready)
        for _ in range(ANSWER_TRIES):
            future = client.call_async(request)
            self._observer.spin(MAX_ANSWER_S, future.done)
            if future.done():
                return future.result()
        return None
