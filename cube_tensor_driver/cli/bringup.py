"""./cube bringup: check the pads of a new hub, find swapped ones by presses, write a skin file.

The command first watches the pads at rest, then asks a person to press beside each cube. From the
presses it computes how each cube is rotated and whether wires of its pads are swapped.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .parser import Parser, sample_rate

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from ..calibrate.pad_rest import PadsAtRest
    from ..calibrate.presses import Explanation, SteadyPress
    from ..config.skin import Skin
    from ..device.live import LinkSource

REST_S = 5.0
"""Duration, in seconds, of the measurement of noise and drift before the presses."""

AVERAGE_S = 0.25
"""Period, in seconds, at which the table of pads is drawn, and length of the averages of the
frequencies in which presses are found."""

PITCH = 0.012
"""Distance of neighbouring cubes in the written file, in metres.

A placeholder: the hub does not know where its cubes are, so the user writes the positions.
"""

PPM = 1e6
"""Parts per million in 1."""

UNKNOWN_MISFIT = 0.5
"""Misfit (0: perfect, 1: nothing is explained) below which presses that say nothing certain are
reported as ambiguous, and above which they are reported as unexplained."""


def arguments(parser: Parser) -> None:
    parser.add_argument("port", metavar="PORT", help="device path, or socket://host:port")
    parser.add_output("-o", "--output", kind="yaml", required=True, help="skin file to write")
    parser.add_argument("--name", default="skin", help="name of the skin (default: %(default)s)")
    parser.add_argument(
        "--calibration",
        metavar="FILE",
        help="calibration file or name (default: the shipped one for the number of pads)",
    )
    parser.add_argument(
        "--rate",
        type=sample_rate,
        default=100.0,
        metavar="HZ",
        help="samples per second (default: %(default)g)",
    )
    parser.epilog = (
        "Leave the skin alone for the first 5 s. Then press next to each cube where the command "
        "asks for it. End a driver that has the port open first. docs/build.md says more."
    )


def run(options: argparse.Namespace) -> int:
    """Return 1 if a pad does not work, pads are swapped, or presses are not explained; else 0."""
    import numpy as np

    from ..config.yaml import write_yaml
    from ..core.errors import ConfigError
    from ..device.live import open_links
    from ..views.terminal.output import say

    if options.output.exists():
        raise ConfigError(f"-o {options.output}: the file exists; remove it, or name another one")
    data, skin = skin_of_hub(options)
    names = [cube.name for cube in skin.cubes]
    pads = skin.cubes[0].calibration.layout.pads
    with open_links(skin) as source, PadScreen(names, pads) as screen:
        say("leave the skin alone")
        rest = watch_rest(source, screen)
        explanations = press_cubes(source, rest)

    # All findings are printed, even if no file is written in the end.
    for cube, explanation in explanations.items():
        data["cubes"][cube]["pose"]["rpy"] = rpy(explanation.rotation)
        show_explanation(names[cube], explanation, pads)
    if any(each.swapped or not each.is_clear for each in explanations.values()):
        say("no file written: swap the wires, or press again, and run this command again", "red")
        return 1
    # The header of the file says where it comes from.
    header = f"./cube bringup {options.port}. Write the positions of the cubes into xyz."
    write_yaml(options.output, data, header)
    say(f"wrote {options.output}: write the positions of the cubes into it")
    return 0 if np.all(rest.works & ~rest.noisy) else 1


def skin_of_hub(options: argparse.Namespace) -> tuple[dict[str, Any], Skin]:
    """Ask the hub at the port for its cubes and describe them as a skin.

    Returns:
        The content of a skin file, and the skin that it describes.

    Raises:
        CubeError: The hub does not answer, or there is no calibration for its number of pads.
    """
    from pathlib import Path

    from ..config.calibration import find_calibration, read_calibration
    from ..config.grid import grid
    from ..config.skin import check_skin_data
    from ..core.errors import ConfigError, CubeError
    from ..core.layout import LAYOUTS
    from ..device.links.search import Port, ask_ports

    port = Port(options.port)
    ask_ports([port])
    hello = port.hello
    if hello is None:
        raise CubeError(
            port.problem or f"{port.path}: no answer within 1 s; not a hub, or no power"
        )

    # Built-in layouts differ in their number of pads, which HELLO states.
    shipped = {layout.n_pads: name for name, layout in LAYOUTS.items()}
    name = options.calibration or shipped.get(hello.n_pads)
    if name is None:
        raise ConfigError(
            f"{port.path}: cubes of {hello.n_pads} pads, and no calibration for them is shipped: "
            "name one with --calibration"
        )
    file = find_calibration(name, Path())
    if options.calibration == str(file):
        # A relative path would be searched from the folder of the skin file.
        name = str(file.resolve())
    calibration = read_calibration(file)
    # A row of cubes: the hub does not know how they are arranged.
    data = grid(
        options.name,
        nx=hello.n_cubes,
        ny=1,
        pitch=PITCH,
        rate=options.rate,
        calibration=name,
        layout=calibration.layout.name,
        port=options.port,
    )

    # The hub knows the uids of its cubes; they stay right when cubes are connected otherwise.
    for cube, uid in zip(data["cubes"], hello.cube_uids.tolist(), strict=True):
        del cube["index"]
        cube["uid"] = f"{uid:#x}"
    skin, mistakes = check_skin_data(data, Path())
    if skin is None:
        raise ConfigError(f"{port.path}: {mistakes[0]}")
    return data, skin


def watch_rest(source: LinkSource, screen: PadScreen) -> PadsAtRest:
    """Measure the pads for `REST_S` while nothing touches them."""
    import numpy as np

    from ..calibrate.pad_rest import MIN_SAMPLES, measure_pads_at_rest
    from ..device.scans.averages import split_into_scans

    parts: list[tuple[np.ndarray, np.ndarray]] = []
    next_shown_s = 0.0
    for rows in source:
        parts.append(split_into_scans(rows, len(source.skin.cubes)))
        now_s = float(parts[-1][1][-1] - parts[0][1][0])
        # The time is that of the samples, so that a slow computer measures as long as a fast one.
        is_over = now_s >= REST_S
        has_enough = sum(len(each) for each, _ in parts) >= MIN_SAMPLES
        if not has_enough or not (is_over or now_s >= next_shown_s):
            continue
        next_shown_s = now_s + AVERAGE_S
        frequency, seconds = (np.concatenate(each) for each in zip(*parts, strict=True))
        rest = measure_pads_at_rest(frequency, seconds)
        screen.show(rest)
        if is_over:
            break
    screen.finish(rest)
    return rest


def press_cubes(source: LinkSource, rest: PadsAtRest) -> dict[int, Explanation]:
    """Ask for presses beside each cube that has working pads, and explain them, by cube."""
    import numpy as np

    from ..calibrate.presses import (
        SIDES,
        PressDetector,
        cube_rotations,
        expected_presses,
        explain_presses,
    )
    from ..core.oscillator import pad_stress
    from ..device.scans.averages import average_over_time
    from ..views.terminal.output import say

    cubes = source.skin.cubes
    calibration = cubes[0].calibration
    detector = PressDetector(rest.frequency, rest.noise, rest.works)
    means = average_over_time(source, len(cubes), AVERAGE_S)
    waiting = set(np.flatnonzero(rest.works.any(axis=1)).tolist())
    expected = expected_presses(calibration, cube_rotations())
    explanations: dict[int, Explanation] = {}

    def wait_for_press(allowed: set[int], where: str) -> SteadyPress:
        """Ask for a press until one is beside an allowed cube."""
        while True:
            say(f"press the skin next to {where}, and hold")
            press = next(each for each in map(detector.update, means) if each is not None)
            say(f"{cubes[press.cube].name} answers: let go")
            while detector.is_held:
                detector.update(next(means))
            if press.cube in allowed:
                return press

    while waiting:
        which = "a cube that was not pressed yet," if explanations else "a cube"
        first_side, *other_sides = SIDES
        # The first press chooses the cube, the others belong to it.
        presses = [wait_for_press(waiting, f"{which} on its {first_side} side")]
        cube = presses[0].cube
        for side in other_sides:
            presses.append(wait_for_press({cube}, f"{cubes[cube].name} on its {side} side"))
        # The pad law turns changes of frequency into pad stresses.
        ratio = 1 + np.array([each.change for each in presses])
        measured = pad_stress(ratio, 1.0, calibration.beta, calibration.modulus)
        explanations[cube] = explain_presses(measured, expected)
        waiting.discard(cube)
    return explanations


class PadScreen:
    """Shows a table of the pads on stdout, live where that is a terminal; a context manager."""

    def __init__(self, cubes: Sequence[str], pads: Sequence[str]) -> None:
        """Args are the names of the cubes and of the pads of each cube."""
        from rich.console import Console
        from rich.live import Live

        self._cubes, self._pads = cubes, pads
        self._console = Console(highlight=False)
        self._live = Live(console=self._console, transient=True, auto_refresh=False)

    def __enter__(self) -> PadScreen:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, rest: PadsAtRest) -> None:
        """Draw the live table."""
        if self._live.is_started:
            self._live.update(self._table(rest), refresh=True)

    def finish(self, rest: PadsAtRest) -> None:
        """End the live table and print it once more, to stay."""
        self._live.stop()
        self._console.print(self._table(rest))

    def _table(self, rest: PadsAtRest) -> Table:
        import numpy as np

        from ..views.terminal.output import make_table

        table = make_table(("cube", "pad"), ("f / Hz", "noise / ppm", "drift / (ppm/min)"))
        table.add_column("state")
        for cube, pad in np.ndindex(rest.frequency.shape):
            # A silent pad has no numbers.
            numbers = ("", "", "")
            if np.isfinite(rest.frequency[cube, pad]):
                numbers = (
                    f"{rest.frequency[cube, pad]:.1f}",
                    f"{PPM * rest.noise[cube, pad]:.1f}",
                    f"{PPM * rest.drift[cube, pad]:+.0f}",
                )
            name = self._cubes[cube] if pad == 0 else ""
            fault = pad_fault(rest, cube, pad)
            style = "red" if fault else ""
            table.add_row(name, self._pads[pad], *numbers, fault or "ok", style=style)
        return table


def pad_fault(rest: PadsAtRest, cube: int, pad: int) -> str:
    """Return what is wrong with a pad: silent, stuck or noisy; empty if nothing is."""
    faults = [name for name in ("silent", "stuck", "noisy") if getattr(rest, name)[cube, pad]]
    return faults[0] if faults else ""


def show_explanation(name: str, explanation: Explanation, pads: Sequence[str]) -> None:
    """Print what the presses tell about a cube: its rotation and its swapped pads."""
    from ..views.terminal.output import say

    if not explanation.is_clear:
        misfit = explanation.misfit
        why = f"{100 * misfit:.0f} % of what its pads measured is not explained"
        if misfit < UNKNOWN_MISFIT:
            why = "several explanations fit"
        say(f"{name}: the presses do not say how it sits ({why})", "red")
        return
    findings = []
    if explanation.is_rotated:
        findings.append(f"turned, rpy {rotation_text(explanation.rotation)}")
    if explanation.swapped:
        pairs = [
            f"{pads[wire]} is {pads[explanation.places[wire]]}" for wire in explanation.swapped
        ]
        findings.append(f"pads are swapped: {', '.join(pairs)}")
    style = "red" if explanation.swapped else "yellow" if findings else "green"
    say(f"{name}: {'; '.join(findings) or 'as it should be'}", style)


def rpy(rotation: np.ndarray) -> list[float]:
    """Return roll, pitch and yaw of a rotation matrix (3, 3), in radians, as in a skin file."""
    from ..core.tensor import quaternion_from_rotation, rpy_from_quaternion

    angles = rpy_from_quaternion(quaternion_from_rotation(rotation))
    # Adding 0.0 turns -0.0 into 0.0.
    return [round(float(angle) + 0.0, 9) for angle in angles]


def rotation_text(rotation: np.ndarray) -> str:
    """Return roll, pitch and yaw of a rotation matrix (3, 3) in degrees."""
    import math

    return " ".join(f"{math.degrees(angle):.0f}°" for angle in rpy(rotation))
