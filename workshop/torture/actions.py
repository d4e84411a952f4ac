"""What a torture does to the nodes: as their users would, or as a crash would."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_srvs.srv import Trigger

from cube_tensor_driver.config.skin import Skin
from cube_tensor_driver.core.errors import CubeError
from cube_tensor_driver.core.rows import StressRows
from cube_tensor_driver.demo.running import Observer
from cube_tensor_driver.processes.children import Children
from cube_tensor_driver.processes.skin_processes import Process
from cube_tensor_driver.srv import Tare

from ..checks.record import Deed
from .message_log import Tape
from .mix import CUBES_PER_HUB, HELD_HUB

START_S, ANSWER_S = 40.0, 10.0
"""s: until a node has started; until it answers, at most."""
ANSWER_TRIES = 4
TARE_S, TARE_EVERY_S = 3.0, 0.3
"""A tare is refused while data have a gap; the load stays long enough to ask again."""
TARED_S = 1.0
"""How long a tare is in force at least, also where this process is late: else nobody could see
it."""
LATE_NS = 500_000_000
"""Where the newest row of stress is older the host is too busy for a tare, and may refuse it."""
LATE_S = 0.5
"""A tare that is asked for later than this may come when the load does not stay any more."""
SUBSCRIBER = "markers"
TRANSITIONS = "driver/transition_event"
"""A topic that the driver has as soon as it can be configured."""
FLUSH_S = 0.3
"""Until what a process sent just before its death has come."""


class Deeds:
    """done: what was done so far; refused: why tares were refused that the host is too busy for."""

    def __init__(
        self,
        observer: Observer,
        children: Children,
        processes: Mapping[str, Process],
        skin: Skin,
        stress: Tape[StressRows],
        new_driver: Callable[[], None],
    ) -> None:
        """new_driver: called when the driver is dead and what it sent has come."""
        self.done: list[Deed] = []
        self.refused: list[str] = []
        self._observer, self._children, self._processes = observer, children, processes
        self._skin, self._stress, self._new_driver = skin, stress, new_driver
        node = observer.node
        self._states = {
            name: node.create_client(ChangeState, f"{name}/change_state")
            for name in ("driver", "reconstruction")
        }
        self._tare = node.create_client(Tare, "reconstruction/tare")
        self._clear = node.create_client(Trigger, "reconstruction/clear_tare")
        self._parameters = node.create_client(SetParameters, "driver/set_parameters")

    def start_driver(self, pipe: Path) -> None:
        """Activate the driver when both ends of every topic know each other, so that the first
        sample is received too. CubeError: it did not become active."""
        self._observer.spin(START_S, self._states["driver"].service_is_ready)
        if not self._activate_driver(set(), pipe.exists):
            log = self._children.log("driver")[-1500:]
            raise CubeError(f"the driver did not become active:\n{log}")

    def _activate_driver(self, old: set[bytes], ready: Callable[[], bool]) -> bool:
        """old: publishers of `frequencies` that are dead, as far as DDS has not noticed it."""
        observer, node = self._observer, self._observer.node
        # Whether this one succeeded shows at the next: a request that is sent again is refused.
        self._change("driver", Transition.TRANSITION_CONFIGURE)
        observer.spin(
            START_S,
            lambda: (
                node.count_publishers("stress") > 0
                and node.count_subscribers("stress") > 1
                and node.count_subscribers("frequencies") > 1
                and bool(self._publishers("frequencies") - old)
                and ready()
            ),
        )
        observer.spin(1.0)
        return self._change("driver", Transition.TRANSITION_ACTIVATE)

    def _publishers(self, topic: str) -> set[bytes]:
        """Of a topic, each by its id in DDS."""
        found = self._observer.node.get_publishers_info_by_topic(topic)
        return {bytes(publisher.endpoint_gid) for publisher in found}

    def stop_driver(self) -> None:
        self._change("driver", Transition.TRANSITION_DEACTIVATE)

    def do(self, event: Mapping[str, Any], late_s: float) -> None:
        """Do what an event of the mix says, so many s after it should have been done."""
        kind = event["deed"]
        deeds: dict[str, Callable[[], tuple[bool, str]]] = {
            "stall reconstruction": lambda: self._pause("reconstruction", event["seconds"]),
            "stall subscriber": lambda: self._pause(SUBSCRIBER, event["seconds"]),
            "rate": lambda: self._set_rate(event["value"]),
            "tare": lambda: self._take_tare(late_s > LATE_S),
            "clear": lambda: self._call(self._clear, Trigger.Request()),
            "restart reconstruction": self._restart,
            "reconfigure reconstruction": self._reconfigure,
            "cycle driver": self._cycle_driver,
            "restart driver": self._restart_driver,
        }
        self._begin_ns = time.time_ns()
        done, answer = deeds[kind]()
        cubes = tuple(self._held_cubes) if kind == "tare" else ()
        self.done.append(
            Deed(
                kind,
                self._begin_ns,
                time.time_ns(),
                done,
                answer,
                cubes,
            )
        )
        if kind == "tare":
            self._observer.spin(TARED_S)

    @property
    def _held_cubes(self) -> range:
        return range(HELD_HUB * CUBES_PER_HUB, (HELD_HUB + 1) * CUBES_PER_HUB)

    def _pause(self, name: str, seconds: float) -> tuple[bool, str]:
        self._children.pause(name)
        self._observer.spin(seconds)
        self._children.resume(name)
        return True, ""

    def _set_rate(self, rate: float) -> tuple[bool, str]:
        value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float(rate))
        request = SetParameters.Request(parameters=[Parameter(name="rate", value=value)])
        answer = self._ask(self._parameters, request)
        return answer is not None and answer.results[0].successful, str(rate)

    def _take_tare(self, late: bool) -> tuple[bool, str]:
        names = [self._skin.names[cube] for cube in self._held_cubes]
        request = Tare.Request(cubes=names, duration=1.0)
        until = time.monotonic() + TARE_S
        while True:
            self._begin_ns = time.time_ns()
            late |= self._begin_ns - self._stress.newest_ns() > LATE_NS
            done, answer = self._call(self._tare, request)
            if done or time.monotonic() > until:
                break
            self._observer.spin(TARE_EVERY_S)
        if late and not done:
            self.refused.append(answer)
        return done, answer

    def _restart(self) -> tuple[bool, str]:
        self._children.kill("reconstruction")
        self._stress.new_writer()
        self._children.start(self._processes["reconstruction"])
        return self._wait_for_stress()

    def _reconfigure(self) -> tuple[bool, str]:
        down = (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP)
        up = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
        done = all(self._change("reconstruction", transition) for transition in down)
        self._stress.new_writer()
        done &= all(self._change("reconstruction", transition) for transition in up)
        comes, answer = self._wait_for_stress()
        return done and comes, answer

    def _cycle_driver(self) -> tuple[bool, str]:
        both = (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE)
        return all(self._change("driver", transition) for transition in both), ""

    def _restart_driver(self) -> tuple[bool, str]:
        old = self._publishers("frequencies")
        changes = self._publishers(TRANSITIONS)
        self._children.kill("driver")
        self._observer.spin(FLUSH_S)
        self._new_driver()
        self._children.start(self._processes["driver"])
        self._observer.spin(START_S, lambda: bool(self._publishers(TRANSITIONS) - changes))
        if not self._activate_driver(old, lambda: True):
            return False, self._children.log("driver")[-500:]
        return self._wait_for_stress()

    def _wait_for_stress(self) -> tuple[bool, str]:
        count = self._stress.count
        self._observer.spin(START_S, lambda: self._stress.count > count)
        return self._stress.count > count, ""

    def _change(self, node: str, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        answer = self._ask(self._states[node], request)
        return answer is not None and bool(answer.success)

    def _call(self, client: Any, request: Any) -> tuple[bool, str]:
        answer = self._ask(client, request)
        return (False, "no answer") if answer is None else (answer.success, answer.message)

    def _ask(self, client: Any, request: Any) -> Any:
        """The answer; None if there is none. An answer is lost if the node has not met our client
        yet: then it is asked again."""
        self._observer.spin(START_S, client.service_is_ready)
        for _ in range(ANSWER_TRIES):
            future = client.call_async(request)
            self._observer.spin(ANSWER_S, future.done)
            if future.done():
                return future.result()
        return None
