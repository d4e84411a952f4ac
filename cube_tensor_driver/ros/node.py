"""What all nodes share: parameters with descriptions, qualities of service, and how nodes are
started, spun and ended."""

from __future__ import annotations

import contextlib
import gc
import math
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import rclpy
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import ROSClock
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from ..config.parameters import Parameter
from ..core.errors import ConfigError, CubeError
from .compat import after_parameters_are_set, make_executor
from .guard import CallbackGuard, refuse_errors
from .session import start_ros

PAUSE_S = 2.0
"""No message is lost while a subscriber pauses for so long: a queue is as deep as the rate times
this."""
QUEUE_BYTES = 64_000_000
"""A queue holds at most so many bytes, so that no process grows beyond 200 MB. Of the largest skins
it holds less than PAUSE_S."""
ROW_BYTES = 78
"""Of a row of `stress` in a message."""
UNKNOWN_RATE = 1000.0
"""Messages per second to expect where the rate is not known."""
BUFFERS_KEPT = 4
"""How many shapes of messages have memory that is filled again and again."""
SPIN_S = 0.2
"""How long one turn of the executor waits, and so how late a signal may be noticed."""
SWITCH_S = 1e-3
"""How long a thread may keep Python's lock while others wait for it. The reader's thread gives it
up at each read; with Python's own 5 ms it would wait so long whenever the main thread computes."""
COLLECT = 20_000, 20, 20
"""Thresholds of Python's garbage collector. A scan leaves no garbage, but with Python's own 700
objects the collector would run every scan or two."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SERVICES = QoSProfile(depth=1000)
"""Calls that wait for an answer. ROS's own depth is 10: of more calls at once DDS drops the oldest
without a word. Parameter services have 1000 by themselves."""


def queue(rate: float | None, reliability: str = "reliable", rows: int = 1) -> QoSProfile:
    """Quality of service of the batch topics.

    rate: messages per second; None: not known. rows: of each message.
    ConfigError: no such reliability.
    """
    wanted = (rate or UNKNOWN_RATE) * PAUSE_S
    affordable = QUEUE_BYTES / (rows * ROW_BYTES)
    depth = max(10, math.ceil(min(wanted, affordable)))
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
    """How many samples of each cube a message holds that covers publish_period seconds.

    rate: samples per second; None: not known.
    """
    return max(1, round(publish_period * (rate or UNKNOWN_RATE)))


def batch_queue(node: CubeNode, rate: float | None, n_cubes: int) -> QoSProfile:
    """Quality of service of the batch topics of a node with parameters publish_period and
    qos_reliability; rate: samples per second of each of so many cubes, None: not known."""
    scans = scans_per_message(node.value("publish_period"), rate)
    messages = None if rate is None else rate / scans
    return queue(messages, node.value("qos_reliability"), scans * n_cubes)


class CubeNode(LifecycleNode):
    """A lifecycle node. An error in a transition is one line in the log, and the transition
    fails.

    Subclasses write `configure`, `activate`, `deactivate` and `cleanup`.
    """

    def __init__(self, name: str, parameters: Sequence[Parameter]) -> None:
        self.guard = CallbackGuard(self)
        super().__init__(name)
        self._guard_lifecycle_services()
        self.configured = False
        self._parameters_by_name = {parameter.name: parameter for parameter in parameters}
        after_parameters_are_set(self, self._apply_parameters)
        self.add_on_set_parameters_callback(self._check_parameters)
        for parameter in parameters:
            self._declare(parameter)

    def create_subscription(self, *arguments: Any, **options: Any) -> Any:
        message_type, topic, callback, *others = arguments
        guarded = self.guard.wrap(callback)
        return super().create_subscription(message_type, topic, guarded, *others, **options)

    def create_timer(self, *arguments: Any, **options: Any) -> Any:
        period, callback, *others = arguments
        return super().create_timer(period, self.guard.wrap(callback), *others, **options)

    def create_service(self, *arguments: Any, **options: Any) -> Any:
        service_type, name, callback, *others = arguments
        guarded = self.guard.wrap_service(callback)
        options.setdefault("qos_profile", SERVICES)
        return super().create_service(service_type, name, guarded, *others, **options)

    def _guard_lifecycle_services(self) -> None:
        """rclpy makes these without `create_service`, and raises RCLError, a RuntimeError, when a
        peer asks for a transition that is not possible now."""
        for service in self.services:
            if service.srv_type is ChangeState:
                service.callback = refuse_errors(service.callback, RuntimeError)
            service.callback = self.guard.wrap_service(service.callback)

    def _declare(self, parameter: Parameter) -> None:
        choices = parameter.choices
        descriptor = ParameterDescriptor(
            description=parameter.description,
            additional_constraints=choices and f"one of: {choices}",
        )
        if parameter.span is not None:
            low, high = parameter.span
            bounds = FloatingPointRange(from_value=low, to_value=high, step=0.0)
            descriptor.floating_point_range = [bounds]
        self.declare_parameter(parameter.name, parameter.default, descriptor)

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
            reason = self._refusal(parameter.name, parameter.value)
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _refusal(self, name: str, value: Any) -> str:
        """Why a parameter cannot have a value now; empty if it can."""
        known = self._parameters_by_name.get(name)
        if known is not None and known.choices and value not in known.choices.split(", "):
            return f"parameter {name} is {value!r}, allowed: {known.choices}"
        if isinstance(value, float) and not math.isfinite(value):
            return f"parameter {name} is {value}, allowed: a finite number"
        if known is not None and known.minimum is not None and 0 < value < known.minimum:
            return f"parameter {name} is {value}, allowed: 0, or at least {known.minimum:g}"
        if known is not None and known.problem is not None and value:
            problem = known.problem(value)
            if problem:
                return f"parameter {name}: {problem}"
        if self.configured and known is not None and not known.live:
            return (
                f"parameter {name} cannot change while the node is configured: "
                "clean it up first (lifecycle)"
            )
        return ""

    def _apply_parameters(self, parameters: list[Any]) -> None:
        for parameter in parameters:
            known = self._parameters_by_name.get(parameter.name)
            if self.configured and known is not None and known.live:
                self.changed(parameter.name)

    def attempt(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        """Do the work of a transition. An error becomes a line in the log and a failure."""
        try:
            work()
        except CubeError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001  (rclpy would swallow it without a word)
            self.get_logger().error(f"{error!r}: please report it\n{traceback.format_exc()}")
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    @property
    def failure(self) -> Exception | None:
        """An error after which the node is of no use: the process ends."""
        return None

    def configure(self) -> None:
        """Make all that the node needs, without opening a device. CubeError: it cannot be made."""

    def activate(self) -> None:
        """Begin to work. CubeError: it cannot begin."""

    def deactivate(self) -> None:
        """End what `activate` began. Safe to call twice, and without `activate`."""

    def cleanup(self) -> None:
        """End what `configure` made. Safe to call twice, and without `configure`."""

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        result = self.attempt(self.configure)
        self.configured = result == TransitionCallbackReturn.SUCCESS
        if not self.configured:
            self.cleanup()  # of what was made before the error
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
        gc.collect()  # now, because `run` lets it come rarely by itself
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
        self.is_simulated = isinstance(clock, ROSClock) and clock.ros_time_is_active

    def now_ns(self) -> int:
        if self.is_simulated:
            return int(self._node.get_clock().now().nanoseconds)
        return time.time_ns()


def run(make: Callable[[], Sequence[CubeNode]]) -> None:
    """Run nodes until SIGINT or SIGTERM. They start in order, and end in reverse.

    The exit code is 1 if a node cannot start, or fails later.
    """
    stopping = False

    def stop(*_: object) -> None:
        nonlocal stopping
        stopping = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    sys.setswitchinterval(SWITCH_S)
    code = 0
    try:
        start_ros()
        nodes = make()
        executor = make_executor()
        for node in nodes:
            executor.add_node(node)
            if not stopping and node.value("autostart") and not _start(node):
                stopping, code = True, 1
        # All objects made until now will stay. Looking at them would take a collection 20 ms.
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


def _start(node: CubeNode) -> bool:
    """Configure and activate a node; whether it can."""
    return all(
        transition() == TransitionCallbackReturn.SUCCESS
        for transition in (node.trigger_configure, node.trigger_activate)
    )
