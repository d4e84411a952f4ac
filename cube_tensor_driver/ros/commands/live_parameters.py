"""Parameters of running nodes, listed, read and set through their services: `./cube param`."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import get_parameter_value, parameter_value_to_python

from ...core.errors import ConfigError
from ..session import node_session
from .asking import ask, domain_text, find_services

LIST = "/list_parameters"
NEEDED = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
"""What a user has to write for a parameter of this type."""


def list_nodes() -> list[str]:
    """Full names of the nodes that have parameters. ConfigError: none runs."""
    with node_session("parameters") as (node, executor):
        return _nodes(node, executor)


def read_parameters(name: str, parameter: str | None) -> dict[str, Any]:
    """Parameters of a node and their values: one of them, or all.

    ConfigError: no such node or parameter.
    """
    with node_session("parameters") as (node, executor):
        full = _find(node, executor, name)
        known = _names(node, executor, full)
        if parameter is not None:
            _check(full, parameter, known)
        names = known if parameter is None else [parameter]
        return _values(node, executor, full, names)


def set_parameter(name: str, parameter: str, text: str) -> Any:
    """Set a parameter to what the text says as YAML; returns its value from now on. A whole number
    will do for a real one.

    ConfigError: no such node or parameter, or the node refuses the value.
    """
    with node_session("parameters") as (node, executor):
        full = _find(node, executor, name)
        _check(full, parameter, _names(node, executor, full))
        value = get_parameter_value(text)
        kind = type(_values(node, executor, full, [parameter])[parameter])
        if kind is float and value.type == ParameterType.PARAMETER_INTEGER:
            value = ParameterValue(
                type=ParameterType.PARAMETER_DOUBLE, double_value=float(value.integer_value)
            )
        if kind in NEEDED and not isinstance(parameter_value_to_python(value), kind):
            raise ConfigError(f"{full}: {parameter} is not set to {text}: needed is {NEEDED[kind]}")
        request = SetParameters.Request(parameters=[Parameter(name=parameter, value=value)])
        answer = ask(node, executor, SetParameters, f"{full}/set_parameters", request)
        result = answer.results[0]
        if not result.successful:
            raise ConfigError(f"{full}: {parameter} is not set to {text}: {result.reason}")
        return _values(node, executor, full, [parameter])[parameter]


def _nodes(node: Node, executor: Any, wanted: str = "") -> list[str]:
    services = find_services(node, executor, "rcl_interfaces/srv/ListParameters", wanted)
    nodes = [service.removesuffix(LIST) for service in services]
    if not nodes:
        raise ConfigError(f"no node runs in {domain_text()}; start ./cube demo or a skin")
    return nodes


def _find(node: Node, executor: Any, name: str) -> str:
    full = f"/{name.removeprefix('/')}"
    nodes = _nodes(node, executor, f"{full}{LIST}")
    if full not in nodes:
        raise ConfigError(f"no node {full} in {domain_text()}; its nodes: {', '.join(nodes)}")
    return full


def _names(node: Node, executor: Any, full: str) -> list[str]:
    request = ListParameters.Request()
    answer = ask(node, executor, ListParameters, f"{full}{LIST}", request)
    return sorted(answer.result.names)


def _check(full: str, parameter: str, known: list[str]) -> None:
    if parameter not in known:
        raise ConfigError(f"{full} has no parameter {parameter}; it has: {', '.join(known)}")


def _values(node: Node, executor: Any, full: str, names: list[str]) -> dict[str, Any]:
    request = GetParameters.Request(names=names)
    answer = ask(node, executor, GetParameters, f"{full}/get_parameters", request)
    values = [parameter_value_to_python(value) for value in answer.values]
    return dict(zip(names, values, strict=True))
