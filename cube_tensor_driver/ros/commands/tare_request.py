"""Asks the reconstructions that run here for a tare: `./cube tare`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from std_srvs.srv import Trigger

from ...core.errors import TareError
from ...srv import Tare
from ..session import node_session
from .asking import ask, domain_text, find_services


@dataclass(frozen=True)
class TareAnswer:
    """What one reconstruction answers. node: its full name."""

    node: str
    success: bool
    message: str


def request_tare(cubes: Sequence[str], clear: bool) -> list[TareAnswer]:
    """Tare cubes, all if none is named, or clear the tare of all cubes.

    Every reconstruction in the DDS domain is asked. CubeError: none runs, or one does not answer.
    """
    with node_session("tare_request") as (node, executor):
        services = find_services(node, executor, "cube_tensor_driver/srv/Tare")
        if not services:
            raise TareError(
                f"no reconstruction runs in {domain_text()}; start ./cube demo or the launch file"
            )
        answers = []
        for service in services:
            name = service.rpartition("/")[0]
            if clear:
                answer = ask(node, executor, Trigger, f"{name}/clear_tare", Trigger.Request())
            else:
                answer = ask(node, executor, Tare, service, Tare.Request(cubes=list(cubes)))
            answers.append(TareAnswer(name, bool(answer.success), answer.message))
        return answers
