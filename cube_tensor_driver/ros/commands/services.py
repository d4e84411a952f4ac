# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Calls services of running nodes for commands: reads and sets parameters, and requests tares."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import (
    GetParameters,
    ListParameters,
    SetParameters,
)
from rclpy.client import Client
from rclpy.executors import Executor
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from std_srvs.srv import Trigger

from ...core.errors import ConfigError, CubeError, TareError
from ...srv import Tare
from ..session import NodeSession, describe_domain, run_node_session, spin_until

MAX_DISCOVERY_S = 5.0
"""Maximum time, in seconds, to search for topics and services of other nodes."""

ANNOUNCE_S = 3.5
"""Time, in seconds, after which all nodes in a DDS domain are found, even on a busy machine: Fast
DDS repeats its announcements every 3 s, and the first ones can be lost."""

SETTLE_S = 0.3
"""Time, in seconds, after which a search for topics or services ends if it has found nothing new.

It is also the time between finding a service and calling it: rmw_fastrtps drops the response to a
client that the server has discovered less than 0.1 s before.
"""

MAX_ANSWER_S = 10.0
"""Maximum time, in seconds, from the first request to a service to its response. Meanwhile, the
request is repeated every `REPEAT_S`, because DDS may lose it."""

REPEAT_S = 3.0
"""Time, in seconds, after which a request without a response is sent again."""

LIST_SERVICE = "/list_parameters"
"""Last part of the name of a service that every node with parameters offers. The names of nodes are
found by searching for these services."""

VALUE_DESCRIPTIONS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
}
"""Python type of the value of a ROS parameter -> description of its values, for error messages."""


@dataclass(frozen=True)
class TareAnswer:
    """The response of one reconstruction node to a request for a tare (zeroing of its cubes).

    Attributes:
        node: Full name of the reconstruction node.
        success: Whether the tare was measured, or cleared if that was requested.
        message: Text of the node about the result, or about the reason of the failure.
    """

    node: str
    success: bool
    message: str


def request_tare(cubes: Sequence[str], clear: bool) -> list[TareAnswer]:
    """Request a tare from every reconstruction node in the DDS domain.

    In a tare, a node takes the present load of cubes as zero load.

    Args:
        cubes: Names of the cubes; an empty sequence: all cubes.
        clear: Whether to clear the tares of all cubes instead.

    Raises:
        CubeError: No reconstruction node runs, or one has not responded within `MAX_ANSWER_S`.
    """
    with run_node_session("tare_request") as session:
        services = find_services(session, "cube_tensor_driver/srv/Tare")
        if not services:
            raise TareError(
                f"no reconstruction runs in {describe_domain()}; start ./cube demo or the launch "
                "file"
            )
        answers = []
        for service in services:
            # The name of the service begins with that of its node, as in /reconstruction/tare.
            name = service.rpartition("/")[0]
            if clear:
                answer = call_service(
                    session,
                    Trigger,
                    f"{name}/clear_tare",
                    Trigger.Request(),
                )
            else:
                request = Tare.Request(cubes=list(cubes))
                answer = call_service(session, Tare, service, request)
            answers.append(TareAnswer(name, bool(answer.success), answer.message))
        return answers


def list_nodes() -> list[str]:
    """Return the full names of all nodes in the DDS domain that have parameters.

    Raises:
        ConfigError: No such node was found within `MAX_DISCOVERY_S`.
    """
    with run_node_session("parameters") as session:
        spin_until(session.executor, lambda: False, ANNOUNCE_S)
        return _find_nodes(session)


def read_parameters(name: str, parameter: str | None) -> dict[str, Any]:
    """Return parameters of a node.

    Args:
        name: Name of the node.
        parameter: Name of a parameter; None: all parameters.

    Returns:
        Name of each parameter -> its value.

    Raises:
        ConfigError: There is no such node or parameter.
    """
    with run_node_session("parameters") as session:
        parameters = _NodeParameters(session, name)
        names = parameters.list_names()
        if parameter is not None:
            parameters.check_name(parameter)
            names = [parameter]
        return parameters.read_values(names)


def set_parameter(name: str, parameter: str, text: str) -> Any:
    """Set a parameter of a node.

    Args:
        name: Name of the node.
        parameter: Name of the parameter.
        text: The value in YAML. A parameter that is a real number may be given as an integer.

    Returns:
        The value that the parameter has afterwards.

    Raises:
        ConfigError: There is no such node or parameter, or the node refuses the value.
    """
    with run_node_session("parameters") as session:
        parameters = _NodeParameters(session, name)
        parameters.check_name(parameter)
        parameters.set(parameter, text)
        return parameters.read_values([parameter])[parameter]


class _NodeParameters:
    """Reads and sets the parameters of another node through the services of that node."""

    def __init__(self, session: NodeSession, name: str) -> None:
        """Find the node whose parameters are read and set.

        Args:
            session: The node of this process, which calls the services.
            name: Name of the other node.

        Raises:
            ConfigError: No node of this name was found within `MAX_DISCOVERY_S`.
        """
        self._session = session
        self._name = f"/{name.removeprefix('/')}"
        nodes = _find_nodes(session, f"{self._name}{LIST_SERVICE}")
        if self._name not in nodes:
            others = ", ".join(nodes)
            raise ConfigError(f"no node {self._name} in {describe_domain()}; its nodes: {others}")

    def list_names(self) -> list[str]:
        """Return the sorted names of all parameters of the node."""
        answer = self._call(
            ListParameters,
            "list_parameters",
            ListParameters.Request(),
        )
        return sorted(answer.result.names)

    def check_name(self, parameter: str) -> None:
        """Check that the node has a parameter.

        Args:
            parameter: Name of the parameter.

        Raises:
            ConfigError: The node has no parameter of this name.
        """
        names = self.list_names()
        if parameter not in names:
            raise ConfigError(
                f"{self._name} has no parameter {parameter}; it has: {', '.join(names)}"
            )

    def read_values(self, names: list[str]) -> dict[str, Any]:
        """Return the values of the parameters with these names."""
        request = GetParameters.Request(names=names)
        answer = self._call(GetParameters, "get_parameters", request)
        values = [parameter_value_to_python(value) for value in answer.values]
        return dict(zip(names, values, strict=True))

    def set(self, parameter: str, text: str) -> None:
        """Set a parameter.

        Args:
            parameter: Name of the parameter.
            text: The value in YAML.

        Raises:
            ConfigError: The value has the wrong type, or the node refuses it.
        """
        value = get_parameter_value(text)
        kind = type(self.read_values([parameter])[parameter])
        # rclpy refuses an integer for a parameter of type double, but users write 2 for 2.0.
        if kind is float and value.type == ParameterType.PARAMETER_INTEGER:
            value = ParameterValue(
                type=ParameterType.PARAMETER_DOUBLE,
                double_value=float(value.integer_value),
            )
        refusal = f"{self._name}: {parameter} is not set to {text}"
        is_known = kind in VALUE_DESCRIPTIONS
        if is_known and not isinstance(parameter_value_to_python(value), kind):
            raise ConfigError(f"{refusal}: needed is {VALUE_DESCRIPTIONS[kind]}")
        change = Parameter(name=parameter, value=value)
        request = SetParameters.Request(parameters=[change])
        result = self._call(SetParameters, "set_parameters", request).results[0]
        if not result.successful:
            raise ConfigError(f"{refusal}: {result.reason}")

    def _call(
        self,
        service_type: type,
        service: str,
        request: object,
    ) -> Any:
        return call_service(
            self._session,
            service_type,
            f"{self._name}/{service}",
            request,
        )


def _find_nodes(session: NodeSession, wanted_service: str = "") -> list[str]:
    """Return the full names of the nodes in the DDS domain that have parameters.

    Args:
        session: The node that searches. Its own name is not returned.
        wanted_service: Full name of a service; the search ends when it is found. If it is empty,
            the search ends when no further node appears.

    Raises:
        ConfigError: No node was found within `MAX_DISCOVERY_S`.
    """
    kind = "rcl_interfaces/srv/ListParameters"
    services = find_services(session, kind, wanted_service)
    nodes = [service.removesuffix(LIST_SERVICE) for service in services]
    if not nodes:
        raise ConfigError(f"no node runs in {describe_domain()}; start ./cube demo or a skin")
    return nodes


def find_services(
    session: NodeSession,
    kind: str,
    wanted: str = "",
) -> list[str]:
    """Return the full names of all services of one type, sorted; the list may be empty.

    Args:
        session: The node that searches. Its own services are left out.
        kind: Type of the services, as in std_srvs/srv/Trigger.
        wanted: Full name of a service; the search ends when it is found. If it is empty, the search
            ends when no further service has appeared for `SETTLE_S`. In both cases it ends at the
            latest after `MAX_DISCOVERY_S`.
    """
    own = f"{session.node.get_fully_qualified_name()}/"

    def find() -> list[str]:
        services = session.node.get_service_names_and_types()
        return sorted(
            name for name, kinds in services if kind in kinds and not name.startswith(own)
        )

    # If one service is wanted, the search ends when it is found. Otherwise it ends when the list of
    # services does not change any more.
    discover(session.executor, (lambda: wanted in find()) if wanted else find)
    return find()


def call_service(
    session: NodeSession,
    service_type: type,
    name: str,
    request: object,
) -> Any:
    """Call a service and return its response.

    The request is sent again every `REPEAT_S`, so it must be one that may be executed twice.

    Args:
        session: The node that calls.
        service_type: Type of the service.
        name: Full name of the service.
        request: The request.

    Raises:
        CubeError: The service was not found within `MAX_DISCOVERY_S`, or no response has come
            within `MAX_ANSWER_S`.
    """
    client: Client = session.node.create_client(service_type, name)
    try:
        if not discover(session.executor, client.service_is_ready):
            raise CubeError(f"{name}: nobody offers this service in {describe_domain()}")
        futures: list[Any] = []

        def has_answer() -> bool:
            return any(future.done() for future in futures)

        until = time.monotonic() + MAX_ANSWER_S
        while time.monotonic() < until:
            # DDS may lose a request, so the request is repeated until a response comes.
            futures.append(client.call_async(request))
            spin_until(session.executor, has_answer, REPEAT_S)
            for future in futures:
                if future.done():
                    return future.result()
        raise CubeError(
            f"{name}: no answer within {MAX_ANSWER_S:g} s; is its node stopped, or very busy?"
        )
    finally:
        session.node.destroy_client(client)


def discover(executor: Executor, find: Callable[[], object]) -> bool:
    """Spin until the result of `find` is true and has not changed for `SETTLE_S`.

    Args:
        executor: The executor to spin.
        find: Returns what was found so far, such as a list of names; called repeatedly.

    Returns:
        Whether anything was found within `MAX_DISCOVERY_S`.
    """
    until = time.monotonic() + MAX_DISCOVERY_S
    if not spin_until(executor, find, MAX_DISCOVERY_S):
        return False
    # DDS discovers nodes one after the other, so the search goes on until nothing new was found for
    # SETTLE_S.
    before = None
    while before != (now := find()) and time.monotonic() < until:
        before = now
        spin_until(executor, lambda: False, SETTLE_S)
    return True
