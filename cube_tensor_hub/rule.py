# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""A rule of the protocol, and what a check says about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from .transcript import Transcript

ANY_FRAME = object
"""Value in `Rule.needs` (kinds of frames without which a rule cannot be checked) for a frame of any
kind."""


class Outcome(str, Enum):
    """Whether a hub keeps a rule. NOT_TRIED states that the conversation with the hub does not
    show it."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_TRIED = "not tried"


@dataclass(frozen=True)
class RuleResult:
    """The outcome of a rule, and a text that says what the hub sent, or why the rule was not
    tried."""

    outcome: Outcome
    text: str


def report_passed(text: str) -> RuleResult:
    """Return the result for a rule that the hub keeps; `text` says what was measured."""
    return RuleResult(Outcome.PASSED, text)


def report_failed(text: str) -> RuleResult:
    """Return the result for a rule that the hub breaks; `text` says what came instead."""
    return RuleResult(Outcome.FAILED, text)


def report_not_tried(text: str) -> RuleResult:
    """Return the result for a rule that could not be checked; `text` says why."""
    return RuleResult(Outcome.NOT_TRIED, text)


Checker = Callable[[Transcript], RuleResult]
"""Function that finds out from a conversation with a hub whether the hub keeps a rule."""


@dataclass(frozen=True)
class Rule:
    """A numbered rule of docs/protocol.md.

    Attributes:
        number: Number on the page, for example S7.
        says: Text of the rule on the page.
        needs: Kinds of frames; without one of each, the rule is not tried.
        find_result: Function that looks for the rule in a conversation in which they came.
    """

    number: str
    says: str
    needs: tuple[type, ...]
    find_result: Checker

    @property
    def section(self) -> str:
        """Heading of docs/protocol.md below which the rule stands."""
        return SECTIONS[self.number[0]]

    def check(self, transcript: Transcript) -> RuleResult:
        """Check the rule, if the frames that it needs came."""
        for kind in self.needs:
            if not any(isinstance(heard.frame, kind) for heard in transcript.iterate_heard()):
                name = "frame" if kind is ANY_FRAME else kind.__name__.upper()
                return report_not_tried(f"no {name} came")
        return self.find_result(transcript)


SECTIONS = {
    "L": "The line",
    "F": "Frames",
    "H": "HELLO",
    "S": "SAMPLE and STATS",
    "R": "REQUEST and ACK",
    "T": "TIME",
}
"""First letter of a rule -> heading of docs/protocol.md, in the order of the page."""

RULES: dict[str, Rule] = {}
"""Number -> rule; the modules of `rules` enter theirs when they are imported."""


def rule(
    number: str,
    says: str,
    needs: tuple[type, ...] = (ANY_FRAME,),
) -> Callable[[Checker], Checker]:
    """Decorate a function that checks a rule, and enter the rule into `RULES`.

    Args:
        number: Number of the rule on docs/protocol.md, for example S7.
        says: Text of the rule on the page.
        needs: Kinds of frames; without one of each, the rule is not tried.
    """

    def enter(function: Checker) -> Checker:
        RULES[number] = Rule(number, says, needs, function)
        return function

    return enter


def enter_untried(number: str, says: str, why: str) -> None:
    """Enter a rule into `RULES` that cannot be checked in a conversation with a hub.

    Args:
        number: Number of the rule on docs/protocol.md, for example H5.
        says: Text of the rule on the page.
        why: Why it cannot be checked, as the check prints it.
    """
    rule(number, says, needs=())(lambda transcript: report_not_tried(why))
