"""What commands ask of running nodes through services: their parameters, and a tare."""

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
from rclpy.node import Node
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from std_srvs.srv import Trigger

from ...core.errors import ConfigError, CubeError, TareError
from ...srv import Tare
from ..session import domain_text, node_session, spin_until

MAX_DISCOVERY_S = 5.0
"""Maximum time, in seconds, for the discovery of nodes."""

SETTLE_S = 0.3
"""Time, in seconds, to wait for further nodes after the last one was found.

It also lets a server meet our client: rmw_fastrtps drops the answer to a client that the server met
less than 0.1 s before.
"""

MAX_ANSWER_S = 10.0
"""Maximum time, in seconds, for the answer of a service."""

REPEAT_S = 3.0
"""Time, in seconds, after which a request without an answer is sent again."""

LIST_SERVICE = "/list_parameters"

EXPECTED = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
}
"""Type of a parameter -> what a user has to write for it."""


@dataclass(frozen=True)
class TareAnswer:
    """The answer of one reconstruction to a request for a tare.

    Attributes:
        node: Full name of the reconstruction.
        success: Whether it has done what was asked.
        message: What it has done, or why not.
    """

    node: str
    success: bool
    message: str


def request_tare(cubes: Sequence[str], clear: bool) -> list[TareAnswer]:
    """Ask every reconstruction in the DDS domain for a tare.

    Args:
        cubes: Names of the cubes; none: all cubes.
        clear: Whether to clear the tare of all cubes instead.

    Raises:
        CubeError: No reconstruction runs, or one does not answer.
    """
    with node_session("tare_request") as (node, executor):
        services = find_services(node, executor, "cube_tensor_driver/srv/Tare")
        if not services:
            raise TareError(
                f"no reconstruction runs in {domain_text()}; start ./cube demo or the launch file"
            )
        answers = []
        for service in services:
            # The service is that of a node: /reconstruction/tare.
            name = service.rpartition("/")[0]
            if clear:
                request = Trigger.Request()
                answer = call_service(
                    node,
                    executor,
                    Trigger,
                    f"{name}/clear_tare",
                    request,
                )
            else:
                request = Tare.Request(cubes=list(cubes))
                answer = call_service(
                    node,
                    executor,
                    Tare,
                    service,
                    request,
                )
            answers.append(TareAnswer(name, bool(answer.success), answer.message))
        return answers


def list_nodes() -> list[str]:
    """Return the full names of the nodes that have parameters. ConfigError: none runs."""
    with node_session("parameters") as (node, executor):
        return _find_nodes(node, executor)


def read_parameters(name: str, parameter: str | None) -> dict[str, Any]:
    """Return parameters of a node and their values: one of them, or all.

    Raises:
        ConfigError: There is no such node or parameter.
    """
    with node_session("parameters") as (node, executor):
        parameters = _NodeParameters(node, executor, name)
        names = parameters.names()
        if parameter is not None:
            parameters.check_name(parameter)
            names = [parameter]
        return parameters.values(names)


def set_parameter(name: str, parameter: str, text: str) -> Any:
    """Set a parameter of a node.

    Args:
        name: Name of the node.
        parameter: Name of the parameter.
        text: The value, written as in YAML. A whole number will do for a real one.

    Returns:
        The value of the parameter from now on.

    Raises:
        ConfigError: There is no such node or parameter, or the node refuses the value.
    """
    with node_session("parameters") as (node, executor):
        parameters = _NodeParameters(node, executor, name)
        parameters.check_name(parameter)
        parameters.set(parameter, text)
        return parameters.values([parameter])[parameter]


class _NodeParameters:
    """The parameters of one node, reached through its services."""

    def __init__(self, node: Node, executor: Any, name: str) -> None:
        """Find the node with this name. ConfigError: there is none."""
        self._node, self._executor = node, executor
        self._name = f"/{name.removeprefix('/')}"
        nodes = _find_nodes(node, executor, f"{self._name}{LIST_SERVICE}")
        if self._name not in nodes:
            others = ", ".join(nodes)
            raise ConfigError(f"no node {self._name} in {domain_text()}; its nodes: {others}")

    def names(self) -> list[str]:
        answer = self._call(ListParameters, "list_parameters", ListParameters.Request())
        return sorted(answer.result.names)

    def check_name(self, parameter: str) -> None:
        """Raise ConfigError if the node has no such parameter."""
        names = self.names()
        if parameter not in names:
            raise ConfigError(
                f"{self._name} has no parameter {parameter}; it has: {', '.join(names)}"
            )

    def values(self, names: list[str]) -> dict[str, Any]:
        request = GetParameters.Request(names=names)
        answer = self._call(GetParameters, "get_parameters", request)
        values = [parameter_value_to_python(value) for value in answer.values]
        return dict(zip(names, values, strict=True))

    def set(self, parameter: str, text: str) -> None:
        """Set a parameter to a text. ConfigError: the node refuses it."""
        value = get_parameter_value(text)
        kind = type(self.values([parameter])[parameter])
        # A person writes 2 for 2.0, which rclpy would refuse.
        if kind is float and value.type == ParameterType.PARAMETER_INTEGER:
            value = ParameterValue(
                type=ParameterType.PARAMETER_DOUBLE, double_value=float(value.integer_value)
            )
        refusal = f"{self._name}: {parameter} is not set to {text}"
        if kind in EXPECTED and not isinstance(parameter_value_to_python(value), kind):
            raise ConfigError(f"{refusal}: needed is {EXPECTED[kind]}")
        request = SetParameters.Request(parameters=[Parameter(name=parameter, value=value)])
        result = self._call(SetParameters, "set_parameters", request).results[0]
        if not result.successful:
            raise ConfigError(f"{refusal}: {result.reason}")

    def _call(
        self,
        service_type: type,
        service: str,
        request: Any,
    ) -> Any:
        name = f"{self._name}/{service}"
        return call_service(
            self._node,
            self._executor,
            service_type,
            name,
            request,
        )


def _find_nodes(
    node: Node,
    executor: Any,
    wanted_service: str = "",
) -> list[str]:
    """Return the full names of nodes with parameters. ConfigError: there is none."""
    kind = "rcl_interfaces/srv/ListParameters"
    services = find_services(node, executor, kind, wanted_service)
    nodes = [service.removesuffix(LIST_SERVICE) for service in services]
    if not nodes:
        raise ConfigError(f"no node runs in {domain_text()}; start ./cube demo or a skin")
    return nodes


def find_services(
    node: Node,
    executor: Any,
    kind: str,
    wanted: str = "",
) -> list[str]:
    """Return the full names of services of other nodes, sorted; there may be none.

    Args:
        node: Our node.
        executor: The executor of our node.
        kind: Type of the services, as in std_srvs/srv/Trigger.
        wanted: A service to wait for. Without it, the search ends when no further service appears.
    """
    own = f"{node.get_fully_qualified_name()}/"

    def find() -> list[str]:
        services = node.get_service_names_and_types()
        return sorted(
            name for name, kinds in services if kind in kinds and not name.startswith(own)
        )

    if wanted:
        # One that is named may be found first: there is no need to wait for others.
        discover(executor, lambda: wanted in find())
    else:
        discover_all(executor, find)
    return find()


def call_service(
    node: Node,
    executor: Any,
    service_type: type,
    name: str,
    request: Any,
) -> Any:
    """Return the answer of a service. The request must do no harm if it comes twice.

    Raises:
        CubeError: Nobody offers the service, or no answer comes.
    """
    client = node.create_client(service_type, name)
    try:
        if not discover(executor, client.service_is_ready):
            raise CubeError(f"{name}: nobody offers this service in {domain_text()}")
        futures: list[Any] = []
        until = time.monotonic() + MAX_ANSWER_S
        while time.monotonic() < until:
            # A request that the server has lost is never answered, so another one is sent.
            futures.append(client.call_async(request))
            spin_until(executor, lambda: any(future.done() for future in futures), REPEAT_S)
            for future in futures:
                if future.done():
                    return future.result()
        raise CubeError(
            f"{name}: no answer within {MAX_ANSWER_S:g} s; is its node stopped, or very busy?"
        )
    finally:
        node.destroy_client(client)


def discover(executor: Any, find: Callable[[], object]) -> bool:
    """Spin until `find` returns something and a moment longer, and return whether it has."""
    if not spin_until(executor, find, MAX_DISCOVERY_S):
        return False
    spin_until(executor, lambda: False, SETTLE_S)
    return True


def discover_all(executor: Any, find: Callable[[], object]) -> bool:
    """Spin until `find` returns something and no more of it a moment later.

    Returns:
        Whether it has found anything.
    """
    until = time.monotonic() + MAX_DISCOVERY_S
    if not spin_until(executor, find, MAX_DISCOVERY_S):
        return False
    # Nodes are discovered one after the other, so it is looked again until nothing is new.
    before = None
    while before != (now := find()) and time.monotonic() < until:
        before = now
        spin_until(executor, lambda: False, SETTLE_S)
    return True
