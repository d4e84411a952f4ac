"""What a rule says of a hub."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from .transcript import Transcript

ANY_FRAME = object
"""In the needs of a rule: any frame will do."""


class Outcome(str, Enum):
    PASSED = "passed"
    FAILED = "failed"
    NOT_TRIED = "not tried"


@dataclass(frozen=True)
class Verdict:
    """text: what came, or why it was not tried."""

    outcome: Outcome
    text: str


def passed(text: str) -> Verdict:
    return Verdict(Outcome.PASSED, text)


def failed(text: str) -> Verdict:
    return Verdict(Outcome.FAILED, text)


def not_tried(text: str) -> Verdict:
    return Verdict(Outcome.NOT_TRIED, text)


@dataclass(frozen=True)
class Rule:
    """A numbered rule of docs/protocol.md.

    number: as on the page, for example S7
    says: the page's words
    needs: frames of which there must be one, or the rule is not tried
    judge: the verdict on a conversation in which they came
    """

    number: str
    says: str
    needs: tuple[type, ...]
    judge: Callable[[Transcript], Verdict]

    @property
    def section(self) -> str:
        """The heading of docs/protocol.md below which the rule stands."""
        return SECTIONS[self.number[0]]


SECTIONS = {
    "L": "The line",
    "F": "Frames",
    "H": "HELLO",
    "S": "SAMPLE and STATS",
    "R": "REQUEST and ACK",
    "T": "TIME",
}
RULES: dict[str, Rule] = {}
"""Number -> rule, filled by the modules of `rules`."""


def rule(
    number: str, says: str, needs: tuple[type, ...] = ()
) -> Callable[[Callable[[Transcript], Verdict]], Callable[[Transcript], Verdict]]:
    """Enters the function below it into RULES."""

    def enter(judge: Callable[[Transcript], Verdict]) -> Callable[[Transcript], Verdict]:
        RULES[number] = Rule(number, says, needs, judge)
        return judge

    return enter
