# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""The base class of all nodes (parameters, lifecycle, clean-up), and `run`, which runs nodes."""

from __future__ import annotations

import contextlib
import gc
import os
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
    State,
    TransitionCallbackReturn,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RclpyParameter
from rclpy.qos import QoSProfile

from ..config.parameters import Parameter
from ..config.skin import Skin, read_skin
from ..core.errors import ConfigError, CubeError
from ..processes.stop_signals import stop_event
from .callbacks import Callback, CallbackErrors, guard, shorten
from .compat import make_executor
from .qos import SERVICES, count_scans_per_message, make_batch_profile
from .session import spin_until, start_ros

MAX_BUFFERS = 4
"""Number of different message sizes for each of which a publisher keeps a buffer. The buffer of a
size is used again for every message of this size."""

STEP_S = 0.2
"""Maximum duration, in seconds, of one step of the executor, which calls callbacks of a node. A
signal that asks the process to end takes effect after at most this time."""

THREAD_SWITCH_S = 1e-3
"""Time, in seconds, after which a thread must release Python's global interpreter lock (GIL) if
another thread waits for it (`sys.setswitchinterval`).

The thread that reads the links (connections to the hubs) releases the lock at each read. With
Python's default of 5 ms it would have to wait that long for the lock whenever the main thread
computes.
"""

GC_THRESHOLDS = (20_000, 20, 20)
"""Thresholds of the three generations of Python's garbage collector (`gc.set_threshold`).

Processing a scan (one sample of every cube) leaves no cyclic garbage. With the default threshold of
700 new objects the collector would run at every scan or every second scan without finding garbage.
"""

Entity = TypeVar("Entity")
"""Type of an rclpy object that a node makes and destroys."""


class CubeNode(LifecycleNode):
    """A lifecycle node in which exceptions of callbacks and transitions do not end the process.

    Subclasses implement `configure`, and `activate` and `deactivate` if they need them. They pass
    each object that `configure` makes to `own` or `call_at_cleanup`, so that this class destroys it
    at clean-up. If a transition raises an error, the error is logged and the transition fails.

    Attributes:
        callback_errors: Catches and counts the exceptions of callbacks.
        is_configured: Whether the lifecycle state is inactive or active.
        is_active: Whether the lifecycle state is active.
        is_misconfigured: Whether a transition was refused because of a parameter or a file, so that
            a restart of the process would not help.
    """

    def __init__(self, name: str, parameters: Sequence[Parameter]) -> None:
        """Make the node, and declare its parameters.

        Args:
            name: Name of the node.
            parameters: The parameters, with defaults, limits and whether they may change later.
        """
        self.callback_errors = CallbackErrors(self)
        self._parameters_by_name = {parameter.name: parameter for parameter in parameters}
        super().__init__(name)
        self.is_configured = False
        self.is_active = False
        self.is_misconfigured = False
        self._resources = contextlib.ExitStack()
        self._protect_lifecycle_services()
        self.add_on_set_parameters_callback(self._check_parameters)
        for parameter in parameters:
            self._declare(parameter)

    # The following methods are overridden by subclasses.

    def configure(self) -> None:
        """Make the publishers, subscriptions and other objects of the node; open no device.

        Raises:
            CubeError: An object cannot be made, for example because the skin file has a mistake.
        """

    def activate(self) -> None:
        """Start the work of the node, such as opening devices.

        Raises:
            CubeError: The work cannot start.
        """

    def deactivate(self) -> None:
        """End the work that `activate` started. It may also be called without `activate`."""

    def on_parameter_change(self, name: str) -> None:
        """Apply the new value of a parameter that may change while the node is configured.

        It is called only while the node is configured.

        Args:
            name: Name of the parameter; `read_value` returns its new value.
        """

    @property
    def failure(self) -> Exception | None:
        """Error after which the node cannot continue its work; `run` then ends the process. None:
        there was no such error."""
        return None

    def count_errors(self) -> int:
        """Return the number of calls of callbacks that have raised an exception so far."""
        return self.callback_errors.count

    # The following methods are called by subclasses.

    def own(self, entity: Entity) -> Entity:
        """Register an object of the node to be destroyed at clean-up.

        Args:
            entity: A publisher, subscription, timer or service.

        Returns:
            The same object.
        """
        # Each of these methods of rclpy destroys only objects of its own type.
        destroyers: tuple[Callback, ...] = (
            self.destroy_lifecycle_publisher,
            self.destroy_subscription,
            self.destroy_timer,
            self.destroy_service,
        )
        for destroy in destroyers:
            self._resources.callback(destroy, entity)
        return entity

    def call_at_cleanup(self, function: Callable[[], object]) -> None:
        """Register a function to be called at clean-up.

        Clean-up calls these functions, and destroys the objects that were passed to `own`, in the
        reverse order of their registration.
        """
        self._resources.callback(function)

    def read_value(self, name: str) -> Any:
        """Return the present value of a parameter of the node."""
        return self.get_parameter(name).value

    def read_skin(self) -> Skin:
        """Read the skin file, with the frame ids that the parameter `frame_prefix` asks for.

        Raises:
            ConfigError: The parameter `config` is empty, or the file has a mistake.
        """
        return read_skin(self.find_config(), self.read_value("frame_prefix"))

    def find_config(self) -> Path:
        """Return the path in the parameter `config`.

        Raises:
            ConfigError: The parameter is empty.
        """
        if not self.read_value("config"):
            raise ConfigError("parameter config is empty: name a skin file, -p config:=skin.yaml")
        return Path(self.read_value("config")).expanduser()

    def make_batch_profile(
        self,
        rate_hz: float | None,
        n_cubes: int,
    ) -> QoSProfile:
        """Return the quality of service of the topics `frequencies`, `stress` and `forces`.

        It depends on the parameters `publish_period` and `qos_reliability` of the node.

        Args:
            rate_hz: Sampling rate of each cube, in Hz; None: not known.
            n_cubes: Number of cubes of the skin.
        """
        scans = count_scans_per_message(self.read_value("publish_period"), rate_hz)
        message_rate = None if rate_hz is None else rate_hz / scans
        return make_batch_profile(
            message_rate,
            self.read_value("qos_reliability"),
            scans * n_cubes,
        )

    # These methods of rclpy register callbacks. They are overridden to catch exceptions in them.

    def create_subscription(
        self,
        msg_type: type,
        topic: str,
        callback: Callback,
        *others: Any,
        **options: Any,
    ) -> Any:
        callback = self.callback_errors.catch(callback)
        return super().create_subscription(
            msg_type,
            topic,
            callback,
            *others,
            **options,
        )

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Any,
        *others: Any,
        **options: Any,
    ) -> Any:
        callback = self.callback_errors.catch(callback)
        return super().create_timer(
            timer_period_sec,
            callback,
            *others,
            **options,
        )

    def create_service(
        self,
        srv_type: type,
        srv_name: str,
        callback: Callback,
        *others: Any,
        **options: Any,
    ) -> Any:
        callback = self.callback_errors.catch_in_service(callback)
        options.setdefault("qos_profile", SERVICES)
        return super().create_service(
            srv_type,
            srv_name,
            callback,
            *others,
            **options,
        )

    def _protect_lifecycle_services(self) -> None:
        """Catch exceptions in the lifecycle services, which rclpy makes without `create_service`.

        If a client requests a transition that the present state does not allow, rclpy raises
        RCLError, which derives from RuntimeError. The client gets a response without success.
        """
        for service in self.services:
            if service.srv_type is ChangeState:
                # rclpy raises RuntimeError for a transition that is impossible now. The response
                # then keeps its default, success=false.
                service.callback = guard(
                    service.callback,
                    _give_response,
                    RuntimeError,
                )
            service.callback = self.callback_errors.catch_in_service(service.callback)

    # The following methods declare, check and apply parameters.

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
        # rclpy stores the values of the command line and of parameter files here. It uses them when
        # the parameter is declared.
        given = self._parameter_overrides
        if parameter.name in given:
            given[parameter.name] = self._as_declared(given[parameter.name])
        self.declare_parameter(parameter.name, parameter.default, descriptor)

    def set_parameters_atomically(
        self,
        parameter_list: list[RclpyParameter],
    ) -> SetParametersResult:
        converted = [self._as_declared(parameter) for parameter in parameter_list]
        result = super().set_parameters_atomically(converted)
        if result.successful and self.is_configured:
            for parameter in parameter_list:
                known = self._parameters_by_name.get(parameter.name)
                if known is not None and known.live:
                    self.on_parameter_change(parameter.name)
        return result

    def _as_declared(self, parameter: RclpyParameter) -> RclpyParameter:
        """Return a parameter, converted from int to float if its declared type is double.

        rclpy would refuse `rate: 250` for a parameter of type double.

        Args:
            parameter: Name and value.
        """
        known = self._parameters_by_name.get(parameter.name)
        is_real = known is not None and isinstance(known.default, float)
        if is_real and type(parameter.value) is int:
            return RclpyParameter(parameter.name, value=float(parameter.value))
        return parameter

    def _check_parameters(self, parameters: list[RclpyParameter]) -> SetParametersResult:
        for parameter in parameters:
            # rclpy also calls this method for its own parameters, such as use_sim_time. They have
            # no entry in `_parameters_by_name` and are not checked here.
            known = self._parameters_by_name.get(parameter.name)
            if known is None:
                continue
            reason = known.find_refusal(parameter.value)
            if not reason and self.is_configured and not known.live:
                reason = (
                    f"parameter {known.name} cannot change while the node is configured: "
                    "clean it up first (lifecycle)"
                )
            if reason:
                return SetParametersResult(successful=False, reason=shorten(reason))
        return SetParametersResult(successful=True)

    # rclpy calls the following methods at the transitions of the lifecycle.

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        result = self._attempt(self.configure)
        self.is_configured = result == TransitionCallbackReturn.SUCCESS
        if not self.is_configured:
            # The objects that `configure` made before it failed must be destroyed.
            self._resources.close()
        return result

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        result: TransitionCallbackReturn = super().on_activate(state)
        if result == TransitionCallbackReturn.SUCCESS:
            result = self._attempt(self.activate)
        self.is_active = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        self.is_active = False
        self.deactivate()
        return super().on_deactivate(state)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        self.end()
        # The garbage collector rarely runs by itself because of GC_THRESHOLDS, so it is called here
        # to free the memory of the destroyed objects.
        gc.collect()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        self.end()
        return TransitionCallbackReturn.SUCCESS

    def end(self) -> None:
        """End the work of the node and destroy its objects, in any lifecycle state."""
        self.is_active = False
        if self.is_configured:
            self.deactivate()
        self.is_configured = False
        self._resources.close()

    def _attempt(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        """Call a function, and return the result of a lifecycle transition: SUCCESS, or FAILURE if
        the function raised an exception, which is logged."""
        try:
            work()
        except CubeError as error:
            self.is_misconfigured = True
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # noqa: BLE001  (rclpy would swallow it silently)
            self.get_logger().error(f"{error!r}: please report it\n{traceback.format_exc()}")
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS


class NodeClock:
    """Reads the time of a node's clock faster than rclpy.

    Unless time is simulated (`use_sim_time`), the clock of a node is the system clock. Reading the
    system clock directly takes a tenth of the time of reading the node's clock with rclpy.

    Attributes:
        is_simulated: Whether time was simulated when `update` was called last.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.update()

    def update(self) -> None:
        """Find out whether time is simulated. It should be called regularly, e.g. once a second."""
        clock = self._node.get_clock()
        self.is_simulated = isinstance(clock, ROSClock) and clock.ros_time_is_active

    def now_ns(self) -> int:
        """Return the time of the node's clock, in ns: since the Unix epoch, or simulated time."""
        if self.is_simulated:
            return int(self._node.get_clock().now().nanoseconds)
        return time.time_ns()


def run(make: Callable[[], Sequence[CubeNode]]) -> None:
    """Run nodes until a signal asks the process to end, and exit.

    The nodes start in their order and end in the reverse order. The exit code is `EX_CONFIG` (78)
    if a parameter or a file cannot be used, 1 after another error at the start or after a
    `failure`, else 0.

    Args:
        make: Returns the nodes. It is called after rclpy has started.

    Raises:
        SystemExit: Always, with the exit code.
    """
    stopping = stop_event()
    sys.setswitchinterval(THREAD_SWITCH_S)
    try:
        start_ros()
        code = _run_nodes(make(), stopping)
    except (ParameterException, CubeError) as error:
        print(f"cube_tensor_driver: {error}", file=sys.stderr)
        code = os.EX_CONFIG
    finally:
        rclpy.try_shutdown()
    raise SystemExit(code)


def _run_nodes(nodes: Sequence[CubeNode], stopping: threading.Event) -> int:
    """Start nodes, spin them until a signal asks the process to end or a node fails, and end them.

    Args:
        nodes: The nodes, in the order in which they start.
        stopping: Event that ends the spinning; the signal handler sets it, or this function after a
            failure.

    Returns:
        The exit code, see `run`.
    """
    executor = make_executor(nodes[0].get_logger().warning)
    code = 0
    for node in nodes:
        executor.add_node(node)
        must_start = not stopping.is_set() and node.read_value("autostart")
        if must_start and not _start(node):
            code = os.EX_CONFIG if node.is_misconfigured else 1
            stopping.set()

    # The objects that exist now live until the end of the process. After `freeze` the garbage
    # collector does not examine them any more, which saves 20 ms per collection.
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GC_THRESHOLDS)

    def check_failures() -> None:
        nonlocal code
        for node in nodes:
            if node.failure is not None:
                node.get_logger().fatal(f"cannot go on: {node.failure!r}: please report it")
                code = 1
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
    return code


def _start(node: CubeNode) -> bool:
    """Configure and activate a node, and return whether both lifecycle transitions succeeded."""
    return all(
        transition() == TransitionCallbackReturn.SUCCESS
        for transition in (node.trigger_configure, node.trigger_activate)
    )


def _give_response(error: Exception, request: Any, response: Any) -> Any:
    return response
