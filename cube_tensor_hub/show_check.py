"""What a check of a hub found, one line per rule."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from .check import Checked
from .verdict import RULES, Outcome

STYLES = {Outcome.PASSED: "green", Outcome.FAILED: "bold red", Outcome.NOT_TRIED: "dim"}


def show_check(result: Checked) -> None:
    """Print the hub, the rules and how many of each outcome there are."""
    console = Console(highlight=False, soft_wrap=True)
    if result.hello is not None:
        hello = result.hello
        console.print(
            f"{result.port}: hub 0x{hello.hub_uid:x}, {hello.n_cubes} cubes of {hello.n_pads} "
            f"pads, firmware 0x{hello.firmware:x}",
            markup=False,
        )
    for number, verdict in result.verdicts.items():
        line = Text(f"{number}  ")
        line.append(f"{verdict.outcome.value:<9}", STYLES[verdict.outcome])
        line.append(f"  {verdict.text}")
        if verdict.outcome is Outcome.FAILED:
            rule = RULES[number]
            line.append(f". The page says: {rule.says} (docs/protocol.md, {rule.section})")
        console.print(line)
    counts = [f"{result.count(outcome)} {outcome.value}" for outcome in Outcome]
    console.print(f"{len(result.verdicts)} rules: {', '.join(counts)}")
