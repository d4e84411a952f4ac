"""What all nodes share: parameters, lifecycle and clean-up, and how nodes are started and ended."""

from __future__ import annotations

import contextlib
import gc
import math
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import rclpy
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import (
    FloatingPointRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.clock import ROSClock
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import (
    LifecycleNode,
    LifecyclePublisher,
    TransitionCallbackReturn,
)
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from ..config.parameters import Parameter
from ..core.errors import ConfigError, CubeError
from ..processes.stop_signals import stop_event
from .callbacks import CallbackErrors, refuse_on_error
from .compat import after_parameters_are_set, make_executor
from .qos import SERVICES, batch_profile, scans_per_message
from .session import spin_until, start_ros

MAX_BUFFERS = 4
"""Number of message sizes for which a publisher keeps a buffer, to fill it again."""

STEP_S = 0.2
"""Maximum time, in seconds, that the executor of nodes waits, and so how late it sees a signal."""

THREAD_SWITCH_S = 1e-3
"""Time, in seconds, for which a thread may keep Python's lock while others wait for it.

The reader's thread gives the lock up at each read. With Python's own 5 ms it would wait that long
whenever the main thread computes.
"""

GC_THRESHOLDS = (20_000, 20, 20)
"""Thresholds of Python's garbage collector.

A scan leaves no garbage, but with Python's own 700 objects the collector would run every scan or
two.
"""

Entity = TypeVar("Entity", Publisher, Subscription, Timer, Service)


class CubeNode(LifecycleNode):
    """A lifecycle node whose errors end neither a callback nor the process.

    Subclasses write `configure`, and `activate` and `deactivate` where they need them. What
    `configure` makes is handed to `own` or `call_at_cleanup`, so that the base class ends it. An
    error in a transition is one line in the log, and the transition fails.

    Attributes:
        callback_errors: Catches and counts errors of callbacks.
        is_configured: Whether the state is inactive or active.
        is_active: Whether the state is active.
    """

    def __init__(self, name: str, parameters: Sequence[Parameter]) -> None:
        self.callback_errors = CallbackErrors(self)
        super().__init__(name)
        self.is_configured = False
        self.is_active = False
        self._resources = contextlib.ExitStack()
        self._parameters_by_name = {parameter.name: parameter for parameter in parameters}
        self._protect_lifecycle_services()
        after_parameters_are_set(self, self._apply_parameters)
        self.add_on_set_parameters_callback(self._check_parameters)
        for parameter in parameters:
            self._declare(parameter)

    # What subclasses write.

    def configure(self) -> None:
        """Make all that the node needs, without opening a device. CubeError: it cannot be made."""

    def activate(self) -> None:
        """Begin to work. CubeError: it cannot begin."""

    def deactivate(self) -> None:
        """End what `activate` began. Safe to call without `activate`."""

    def on_parameter_change(self, name: str) -> None:
        """Take over the new value of a live parameter. Called only while configured."""

    @property
    def failure(self) -> Exception | None:
        """Error after which the node cannot go on and the process ends; None: there is none."""
        return None

    # What subclasses use.

    def own(self, entity: Entity) -> Entity:
        """Have a publisher, subscription, timer or service destroyed at clean-up, and return it."""
        destroyers: tuple[tuple[type, Callable[[Any], object]], ...] = (
            # A publisher of the first kind is also one of the second.
            (LifecyclePublisher, self.destroy_lifecycle_publisher),
            (Publisher, self.destroy_publisher),
            (Subscription, self.destroy_subscription),
            (Timer, self.destroy_timer),
            (Service, self.destroy_service),
        )
        for kind, destroy in destroyers:
            if isinstance(entity, kind):
                self._resources.callback(destroy, entity)
                break
        return entity

    def call_at_cleanup(self, function: Callable[[], object]) -> None:
        """Call a function at clean-up, in the reverse order of these calls and those of `own`."""
        self._resources.callback(function)

    def value(self, name: str) -> Any:
        """Return the value of a parameter."""
        return self.get_parameter(name).value

    def config(self) -> Path:
        """Return the path in the parameter `config`. ConfigError: it is not given."""
        if not self.value("config"):
            raise ConfigError("parameter config is empty: name a skin file, -p config:=skin.yaml")
        return Path(self.value("config")).expanduser()

    def batch_profile(self, rate_hz: float | None, n_cubes: int) -> QoSProfile:
        """Return the profile of the batch topics, as parameters of the node demand it.

        Args:
            rate_hz: Samples per second of each cube; None: not known.
            n_cubes: Number of cubes.
        """
        scans = scans_per_message(self.value("publish_period"), rate_hz)
        message_rate = None if rate_hz is None else rate_hz / scans
        return batch_profile(message_rate, self.value("qos_reliability"), scans * n_cubes)

    # Callbacks, whose errors are caught.

    def create_subscription(self, *arguments: Any, **options: Any) -> Any:
        message_type, topic, callback, *others = arguments
        callback = self.callback_errors.catch(callback)
        return super().create_subscription(
            message_type,
            topic,
            callback,
            *others,
            **options,
        )

    def create_timer(self, *arguments: Any, **options: Any) -> Any:
        period, callback, *others = arguments
        callback = self.callback_errors.catch(callback)
        return super().create_timer(
            period,
            callback,
            *others,
            **options,
        )

    def create_service(self, *arguments: Any, **options: Any) -> Any:
        service_type, name, callback, *others = arguments
        callback = self.callback_errors.catch_in_service(callback)
        options.setdefault("qos_profile", SERVICES)
        return super().create_service(
            service_type,
            name,
            callback,
            *others,
            **options,
        )

    def _protect_lifecycle_services(self) -> None:
        """Catch errors of the lifecycle services, which rclpy makes without `create_service`.

        rclpy raises RCLError, a RuntimeError, when a transition is asked for that is not possible
        now.
        """
        for service in self.services:
            if service.srv_type is ChangeState:
                service.callback = refuse_on_error(service.callback, RuntimeError)
            service.callback = self.callback_errors.catch_in_service(service.callback)

    # Parameters.

    def _declare(self, parameter: Parameter) -> None:
        choices = parameter.choices
        descriptor = ParameterDescriptor(
            description=parameter.description,
            additional_constraints=choices and f"one of: {choices}",
        )
        if parameter.span is not None:
            low, high = parameter.span
            bounds = FloatingPointRange(
                from_value=low,
                to_value=high,
                step=0.0,
            )
            descriptor.floating_point_range = [bounds]
        self.declare_parameter(parameter.name, parameter.default, descriptor)

    def _check_parameters(self, parameters: list[Any]) -> SetParametersResult:
        for parameter in parameters:
            reason = self._refusal(parameter.name, parameter.value)
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _refusal(self, name: str, value: Any) -> str:
        """Return why a parameter cannot have a value now, or an empty text if it can."""
        # rclpy also asks about parameters of its own, such as use_sim_time.
        known = self._parameters_by_name.get(
            name,
            Parameter(
                name,
                None,
                "",
                live=True,
            ),
        )
        if known.choices and value not in known.choices.split(", "):
            return f"parameter {name} is {value!r}, allowed: {known.choices}"
        if isinstance(value, float) and not math.isfinite(value):
            return f"parameter {name} is {value}, allowed: a finite number"
        if known.minimum is not None and 0 < value < known.minimum:
            return f"parameter {name} is {value}, allowed: 0, or at least {known.minimum:g}"
        problem = known.problem(value) if known.problem is not None and value else ""
        if problem:
            return f"parameter {name}: {problem}"
        if self.is_configured and not known.live:
            return (
                f"parameter {name} cannot change while the node is configured: "
                "clean it up first (lifecycle)"
            )
        return ""

    def _apply_parameters(self, parameters: list[Any]) -> None:
        for parameter in parameters:
            known = self._parameters_by_name.get(parameter.name)
            if self.is_configured and known is not None and known.live:
                self.on_parameter_change(parameter.name)

    # Transitions of the lifecycle.

    def on_configure(self, state: Any) -> TransitionCallbackReturn:
        result = self._attempt(self.configure)
        self.is_configured = result == TransitionCallbackReturn.SUCCESS
        if not self.is_configured:
            self._resources.close()  # what was made before the error
        return result

    def on_activate(self, state: Any) -> TransitionCallbackReturn:
        result: TransitionCallbackReturn = super().on_activate(state)
        if result == TransitionCallbackReturn.SUCCESS:
            result = self._attempt(self.activate)
        self.is_active = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_deactivate(self, state: Any) -> TransitionCallbackReturn:
        self.is_active = False
        self.deactivate()
        result: TransitionCallbackReturn = super().on_deactivate(state)
        return result

    def on_cleanup(self, state: Any) -> TransitionCallbackReturn:
        self.end()
        gc.collect()  # now, because `run` lets the collector run rarely
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: Any) -> TransitionCallbackReturn:
        self.end()
        return TransitionCallbackReturn.SUCCESS

    def end(self) -> None:
        """End all that the node has begun and made, whatever its state."""
        self.is_active = False
        if self.is_configured:
            self.deactivate()
        self.is_configured = False
        self._resources.close()

    def _attempt(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        """Do the work of a transition. An error becomes a line in the log and a failure."""
        try:
            work()
        except CubeError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001  (rclpy would swallow it silently)
            self.get_logger().error(f"{error!r}: please report it\n{traceback.format_exc()}")
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS


class NodeClock:
    """The clock of a node, read quickly.

    Without simulated time that is the system's clock, which is read directly in a tenth of the
    time.

    Attributes:
        is_simulated: Whether time was simulated at the last `update`.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.update()

    def update(self) -> None:
        """Look whether time is simulated. Call this from time to time."""
        clock = self._node.get_clock()
        self.is_simulated = isinstance(clock, ROSClock) and clock.ros_time_is_active

    def now_ns(self) -> int:
        """Return the time of the node's clock, in ns."""
        if self.is_simulated:
            return int(self._node.get_clock().now().nanoseconds)
        return time.time_ns()


def run(make: Callable[[], Sequence[CubeNode]]) -> None:
    """Run nodes until a signal asks the process to end, and exit.

    They start in order and end in reverse. The exit code is 1 if a node cannot start, or fails
    later.

    Args:
        make: Makes the nodes, once rclpy has started.
    """
    stopping = stop_event()
    sys.setswitchinterval(THREAD_SWITCH_S)
    try:
        start_ros()
        is_good = _run_nodes(make(), stopping)
    except (ParameterException, CubeError) as error:
        print(f"cube_tensor_driver: {error}", file=sys.stderr)
        is_good = False
    finally:
        rclpy.try_shutdown()
    raise SystemExit(0 if is_good else 1)


def _run_nodes(nodes: Sequence[CubeNode], stopping: threading.Event) -> bool:
    """Start nodes, spin them until `stopping` is set, end them; return whether all went well."""
    executor = make_executor()
    is_good = True
    for node in nodes:
        executor.add_node(node)
        if not stopping.is_set() and node.value("autostart"):
            is_good = _start(node)
            if not is_good:
                stopping.set()

    # All objects made until now will stay. Looking at them would take a collection 20 ms.
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GC_THRESHOLDS)

    def check_failures() -> None:
        nonlocal is_good
        for node in nodes:
            if node.failure is not None:
                node.get_logger().fatal(f"cannot go on: {node.failure!r}: please report it")
                is_good = False
                stopping.set()

    with contextlib.suppress(ExternalShutdownException):
        spin_until(
            executor,
            stopping.is_set,
            step_s=STEP_S,
            on_step=check_failures,
        )
    for node in reversed(nodes):
        node.end()
        executor.remove_node(node)
        node.destroy_node()
    return is_good


def _start(node: CubeNode) -> bool:
    """Configure and activate a node, and return whether it could."""
    return all(
        transition() == TransitionCallbackReturn.SUCCESS
        for transition in (node.trigger_configure, node.trigger_activate)
    )
