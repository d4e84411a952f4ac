"""What both nodes share: parameters with descriptions, qualities of service, how a node is started,
spun and ended."""

from __future__ import annotations

import contextlib
import gc
import math
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import ROSClock
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from ..core.errors import ConfigError, CubeError

PAUSE_S = 2.0
"""The longest pause of a reader that no message is lost in: queue depths are rate times this."""
QUEUE_BYTES = 64_000_000
"""What a queue may hold of the largest skins, so that no process grows beyond 200 MB: there the
pause is shorter."""
ROW_BYTES = 78
UNKNOWN_RATE = 1000.0
BUFFERS_KEPT = 4
"""Shapes of messages whose bytes are kept to be filled again."""
SPIN_S = 0.2
SWITCH_S = 1e-3
"""A reader gives up Python's lock at each read; while the main thread computes it would wait 5 ms
each time."""
COLLECT = 20_000, 20, 20
"""When Python looks for garbage. A scan leaves none, but at 700 objects it looked every scan or
two."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def queue(rate: float | None, reliability: str = "reliable", rows: int = 1) -> QoSProfile:
    """Quality of service of the batch topics at `rate` messages of so many rows per second, None:
    not known.

    ConfigError: no such reliability.
    """
    depth = max(
        10, math.ceil(min((rate or UNKNOWN_RATE) * PAUSE_S, QUEUE_BYTES / (rows * ROW_BYTES)))
    )
    policies = {
        "reliable": ReliabilityPolicy.RELIABLE,
        "best_effort": ReliabilityPolicy.BEST_EFFORT,
    }
    if reliability not in policies:
        raise ConfigError(
            f"parameter qos_reliability is {reliability!r}, allowed: {', '.join(policies)}"
        )
    return QoSProfile(
        depth=depth, history=HistoryPolicy.KEEP_LAST, reliability=policies[reliability]
    )


def scans_per_message(publish_period: float, rate: float | None) -> int:
    """How many samples of each cube a message holds; at `rate` samples per second, None: not
    known."""
    return max(1, round(publish_period * (rate or UNKNOWN_RATE)))


class CubeNode(LifecycleNode):
    """A lifecycle node whose errors are one line in the log and a transition that fails, never a
    traceback."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.configured = False
        self._choices: dict[str, str] = {}
        self._live: set[str] = set()
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)

    def declare(
        self,
        name: str,
        default: Any,
        description: str,
        span: tuple[float, float] | None = None,
        choices: str = "",
        live: bool = False,
    ) -> None:
        """Declare a parameter; span bounds a number, choices (words separated by commas) a text.

        live: it may change while the node is configured, see `changed`; others are refused then.
        """
        self._choices[name] = choices
        if live:
            self._live.add(name)
        descriptor = ParameterDescriptor(
            description=description, additional_constraints=choices and f"one of: {choices}"
        )
        descriptor.read_only = False
        if span is not None:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=span[0], to_value=span[1], step=0.0)
            ]
        self.declare_parameter(name, default, descriptor)

    def declare_autostart(self) -> None:
        """Declare the parameter that says whether `run` brings the node up."""
        text = "Configure and activate at once; false waits for lifecycle transitions."
        self.declare("autostart", True, text)

    def declare_reliability(self) -> None:
        """Declare the reliability that `queue` takes."""
        text = "Reliability of the batch topics."
        self.declare("qos_reliability", "reliable", text, choices="reliable, best_effort")

    def config(self) -> Path:
        """The skin file of parameter config. ConfigError: not given."""
        if not self.value("config"):
            raise ConfigError("parameter config is empty: name a skin file, -p config:=skin.yaml")
        return Path(self.value("config")).expanduser()

    def value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def changed(self, name: str) -> None:
        """A live parameter has a new value."""

    def _check_parameters(self, parameters: list[Any]) -> SetParametersResult:
        for parameter in parameters:
            name, choices = parameter.name, self._choices.get(parameter.name, "")
            if choices and parameter.value not in choices.split(", "):
                reason = f"parameter {name} is {parameter.value!r}, allowed: {choices}"
                return SetParametersResult(successful=False, reason=reason)
            if isinstance(parameter.value, float) and not math.isfinite(parameter.value):
                reason = f"parameter {name} is {parameter.value}, allowed: a finite number"
                return SetParametersResult(successful=False, reason=reason)
            if self.configured and name in self._choices and name not in self._live:
                reason = f"parameter {name} cannot change while the node is configured: clean it up first (lifecycle)"
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _take_parameters(self, parameters: list[Any]) -> None:
        for parameter in parameters:
            if self.configured and parameter.name in self._live:
                self.changed(parameter.name)

    def attempt(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        """Do the work of a transition; a CubeError becomes a line in the log and a failure."""
        try:
            work()
        except CubeError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    @property
    def failure(self) -> Exception | None:
        """What makes it useless to go on: the process ends with an error."""
        return None

    def configure(self) -> None:
        """Make all that does not touch the outside yet. CubeError: why it cannot be."""

    def activate(self) -> None:
        """Begin. CubeError: why it cannot be."""

    def deactivate(self) -> None:
        """End what `activate` began; safe to call twice."""

    def cleanup(self) -> None:
        """End what `configure` made; safe to call twice."""

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        result = self.attempt(self.configure)
        self.configured = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_activate(self, state: Any) -> TransitionCallbackReturn:
        result: TransitionCallbackReturn = super().on_activate(state)
        return result if result != TransitionCallbackReturn.SUCCESS else self.attempt(self.activate)

    def on_deactivate(self, state: Any) -> TransitionCallbackReturn:
        self.deactivate()
        result: TransitionCallbackReturn = super().on_deactivate(state)
        return result

    def on_cleanup(self, state: Any) -> TransitionCallbackReturn:
        self.cleanup()
        self.configured = False
        gc.collect()  # what was configured leaves garbage, unlike a scan
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: Any) -> TransitionCallbackReturn:
        self.deactivate()
        self.cleanup()
        self.configured = False
        return TransitionCallbackReturn.SUCCESS


class NodeClock:
    """The clock of a node, read quickly.

    Without simulated time that is the system's clock, which is read directly in a tenth of the
    time.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.update()

    def update(self) -> None:
        """See whether time is simulated; to be called now and then."""
        clock = self._node.get_clock()
        self._is_simulated = isinstance(clock, ROSClock) and clock.ros_time_is_active

    def now_ns(self) -> int:
        if self._is_simulated:
            return int(self._node.get_clock().now().nanoseconds)
        return time.time_ns()


def run(make: Callable[[], Sequence[CubeNode]]) -> None:
    """Run nodes, started in order, until SIGINT or SIGTERM, then end them in reverse; exit code 1:
    one cannot start."""
    stopping = False

    def stop(*_: object) -> None:
        nonlocal stopping
        stopping = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    sys.setswitchinterval(SWITCH_S)
    code = 0
    # rclpy's own handlers would end the context under a thread that publishes.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        nodes = make()
        executor = make_executor()
        for node in nodes:
            executor.add_node(node)
            for transition in (
                (node.trigger_configure, node.trigger_activate) if node.value("autostart") else ()
            ):
                if not stopping and transition() != TransitionCallbackReturn.SUCCESS:
                    stopping, code = True, 1
        # What is there by now stays: no collection has to look at it, which would take 20 ms.
        gc.collect()
        gc.freeze()
        gc.set_threshold(*COLLECT)
        while not stopping:
            # EventsExecutor.spin() can burn a core and does not return on a signal; spin_once in
            # the main thread does.
            with contextlib.suppress(ExternalShutdownException):
                executor.spin_once(timeout_sec=SPIN_S)
            for node in nodes:
                if node.failure is not None:
                    node.get_logger().fatal(f"cannot go on: {node.failure!r}: please report it")
                    stopping, code = True, 1
        for node in reversed(nodes):
            node.deactivate()
            node.cleanup()
            executor.remove_node(node)
            node.destroy_node()
    except (ParameterException, CubeError) as error:
        print(f"cube_tensor_driver: {error}", file=sys.stderr)
        code = 1
    finally:
        rclpy.try_shutdown()
    raise SystemExit(code)


def make_executor() -> Any:
    """The executor that costs a third of the default one, where this rclpy has it."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()
