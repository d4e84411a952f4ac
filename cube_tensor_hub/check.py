# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A conversation with a hub, checked by all rules."""

from __future__ import annotations

from dataclasses import dataclass

from cube_tensor_driver.device.wire.protocol import Hello

from . import rules
from .conversation import Conversation, Report, Wire
from .rule import RULES, SECTIONS, Outcome, Rule, RuleResult

__all__ = ["Checked", "check", "rules", "sort_rules"]


@dataclass(frozen=True)
class Checked:
    """Results of the check of one hub.

    Attributes:
        port: Port of the hub.
        hello: Last HELLO of the hub; None: none came.
        results: Number of a rule of docs/protocol.md, such as S7 -> whether the hub keeps it.
    """

    port: str
    hello: Hello | None
    results: dict[str, RuleResult]

    def count(self, outcome: Outcome) -> int:
        """Return the number of rules with an outcome: passed, failed or not tried."""
        return sum(result.outcome is outcome for result in self.results.values())

    def list_failed(self) -> list[str]:
        """Return the numbers of the rules that the hub broke."""
        return [
            number for number, result in self.results.items() if result.outcome is Outcome.FAILED
        ]

    def to_dict(self) -> dict[str, object]:
        """Return the results as plain values, for the JSON file of `./cube check --json`."""
        hello = self.hello
        return {
            "port": self.port,
            "hub_uid": None if hello is None else f"0x{hello.hub_uid:x}",
            "firmware": None if hello is None else f"0x{hello.firmware:x}",
            **{outcome.value: self.count(outcome) for outcome in Outcome},
            "rules": [
                {
                    "rule": number,
                    "section": RULES[number].section,
                    "says": RULES[number].says,
                    "outcome": result.outcome.value,
                    "text": result.text,
                }
                for number, result in self.results.items()
            ],
        }


def check(wire: Wire, report: Report = lambda done, total, what: None) -> Checked:
    """Talk to a hub and check every rule.

    Args:
        wire: The line to the hub.
        report: Shows the progress.

    Raises:
        LinkError: The line was lost.
        CubeError: The hub sends without end.
    """
    transcript = Conversation(wire, report).run()
    results = {one.number: one.check(transcript) for one in sort_rules()}
    return Checked(transcript.port, transcript.hello, results)


def sort_rules() -> list[Rule]:
    """Return all rules in the order of docs/protocol.md."""
    sections = list(SECTIONS)
    return sorted(RULES.values(), key=lambda one: (sections.index(one.number[0]), one.number))
