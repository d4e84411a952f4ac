"""What ./cube export lerobot says at the end."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from ...lerobot.export import Exported


def say_exported(folder: Path, exported: Exported) -> None:
    """What the data set holds, and each kind of data that it does not hold."""
    console = Console(highlight=False)

    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, markup=False, soft_wrap=True)

    others = ", ".join(exported.features) or "no other topics"
    say(
        f"{folder}: {exported.episodes} episodes, {exported.frames} frames, {exported.rows} "
        f"samples, {exported.depth} in a window; {others}"
    )
    if exported.depth > 2 * exported.usual:
        say(
            f"usual are {exported.usual} samples in a window, but one frame holds "
            f"{exported.depth}: hubs paused, or stamps are in doubt; --marks can leave that out",
            "yellow",
        )
    left_out = {
        "samples outside of the marks": exported.outside,
        "samples of cubes that the skin does not have": exported.unknown,
        "marks without a sample": exported.empty,
    }
    for what, number in left_out.items():
        if number:
            say(f"left out: {number} {what}", "yellow")
