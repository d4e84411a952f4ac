"""All rules on one conversation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from cube_tensor_driver.device.wire.protocol import Hello

from . import rules
from .conversation import Report, Wire, converse
from .transcript import Transcript
from .verdict import ANY_FRAME, RULES, SECTIONS, Outcome, Rule, Verdict, not_tried

__all__ = ["Checked", "check", "judge", "rules"]


@dataclass(frozen=True)
class Checked:
    """What a check found. hello: of the hub, None if none came."""

    port: str
    hello: Hello | None
    verdicts: dict[str, Verdict]

    def count(self, outcome: Outcome) -> int:
        return sum(verdict.outcome is outcome for verdict in self.verdicts.values())

    def failed(self) -> list[str]:
        """The numbers of the rules that the hub broke."""
        return [
            number for number, verdict in self.verdicts.items() if verdict.outcome is Outcome.FAILED
        ]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "port": self.port,
            "hub_uid": None if self.hello is None else f"0x{self.hello.hub_uid:x}",
            "firmware": None if self.hello is None else f"0x{self.hello.firmware:x}",
            **{outcome.value: self.count(outcome) for outcome in Outcome},
            "rules": [
                {
                    "rule": number,
                    "section": RULES[number].section,
                    "says": RULES[number].says,
                    "outcome": verdict.outcome.value,
                    "text": verdict.text,
                }
                for number, verdict in self.verdicts.items()
            ],
        }


def check(wire: Wire, report: Report = lambda done, total, what: None) -> Checked:
    """Talk to a hub and judge it by every rule.

    LinkError: the line was lost. CubeError: the hub floods.
    """
    talk = converse(wire, report)
    verdicts = {one.number: judge(one, talk) for one in in_order()}
    return Checked(talk.port, talk.hello, verdicts)


def in_order() -> list[Rule]:
    """All rules, as they stand on the page."""
    sections = list(SECTIONS)
    return sorted(RULES.values(), key=lambda one: (sections.index(one.number[0]), one.number))


def judge(one: Rule, talk: Transcript) -> Verdict:
    """The verdict of a rule, where there is something to judge."""
    for kind in one.needs:
        if not any(isinstance(heard.frame, kind) for heard in talk.heard()):
            name = "frame" if kind is ANY_FRAME else kind.__name__.upper()
            return not_tried(f"no {name} came")
    return one.judge(talk)
