"""A rule of the protocol, and what a check says about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from .transcript import Transcript

ANY_FRAME = object
"""A value for `Rule.needs`: any frame will do."""


class Outcome(str, Enum):
    """Whether a hub keeps a rule. NOT_TRIED: the conversation does not show it."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_TRIED = "not tried"


@dataclass(frozen=True)
class RuleResult:
    """The outcome of a rule, and in words what came or why it was not tried."""

    outcome: Outcome
    text: str


def passed(text: str) -> RuleResult:
    """Return that the rule is kept."""
    return RuleResult(Outcome.PASSED, text)


def failed(text: str) -> RuleResult:
    """Return that the rule is broken."""
    return RuleResult(Outcome.FAILED, text)


def not_tried(text: str) -> RuleResult:
    """Return why the rule could not be checked."""
    return RuleResult(Outcome.NOT_TRIED, text)


Checker = Callable[[Transcript], RuleResult]
"""Function that looks for a rule in a conversation."""


@dataclass(frozen=True)
class Rule:
    """A numbered rule of docs/protocol.md.

    Attributes:
        number: Number on the page, for example S7.
        says: The words of the page.
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
            if not any(isinstance(heard.frame, kind) for heard in transcript.heard()):
                name = "frame" if kind is ANY_FRAME else kind.__name__.upper()
                return not_tried(f"no {name} came")
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
    """Decorate a function that checks a rule, and enter the rule into `RULES`."""

    def enter(function: Checker) -> Checker:
        RULES[number] = Rule(number, says, needs, function)
        return function

    return enter


def never_tried(number: str, says: str, why: str) -> None:
    """Enter a rule that no conversation shows into `RULES`, with the reason."""
    rule(number, says, needs=())(lambda transcript: not_tried(why))
