# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube bringup: check the pads of a new hub, find swapped ones by presses, write a skin file.

The command first measures the pads without load, then asks the user to press beside each cube. From
the presses it computes how each cube is rotated in the skin, and whether wires of its pads are
swapped.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from .parser import Parser

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from ..calibrate.pad_rest import PadsAtRest
    from ..calibrate.presses import Explanation, SteadyPress
    from ..config.skin import Skin, SkinContent
    from ..device.live import LinkSource

REST_S = 5.0
"""Duration, in seconds, of the measurement of the pads without load.

It precedes the presses beside each cube, and determines the rest frequency (frequency without
load), noise and drift of each pad.
"""

AVERAGE_S = 0.25
"""Time, in seconds, over which frequencies are averaged to detect presses.

The live table of the pads is drawn with the same period.
"""

PPM = 1e6
"""Number of ppm (parts per million) in 1."""

UNKNOWN_MISFIT = 0.5
"""Misfit that selects the text for the user if the presses do not determine how a cube is rotated.

Below this misfit the text is that several explanations fit; from it up, the text states which part
of the measurement is not explained. The misfit is 0 if the best rotation explains the measurement
completely and 1 if it explains nothing.
"""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value("port", "PORT", "device path, or socket://host:port")
    parser.add_output(
        "-o",
        "--output",
        kind="skin",
        required=True,
        help="skin file to write",
    )
    parser.add_value(
        "--name",
        "NAME",
        "name of the skin (default: %(default)s)",
        default="skin",
    )
    parser.add_value(
        "--calibration",
        "FILE",
        "calibration file or name (default: the shipped one for the number of pads)",
    )
    parser.add_rate()
    parser.epilog = (
        "Leave the skin alone for the first 5 s. Then press next to each cube where the command "
        "asks for it. End a driver that has the port open first. docs/build.md says more."
    )


def run(options: argparse.Namespace) -> int:
    """Check the hub, and write the skin file unless pads are swapped or a press is unexplained.

    Returns:
        1 if a pad does not work or is noisy, or if no file was written; otherwise 0.
    """
    import numpy as np

    from ..config.yaml import write_yaml
    from ..device.live import open_links
    from ..views.terminal.output import say

    data, skin = describe_skin_of_hub(options)
    names = [cube.name for cube in skin.cubes]
    pads = skin.cubes[0].calibration.layout.pads
    with open_links(skin) as source:
        say("leave the skin alone")
        rest = watch_rest(source)
        explanations = press_cubes(source, rest)

    # The results of all cubes are printed, even if one of them prevents that the file is written.
    for cube, explanation in explanations.items():
        data["cubes"][cube]["pose"]["rpy"] = compute_rpy(explanation.rotation)
        show_explanation(names[cube], explanation, pads)
    if any(each.swapped or not each.is_clear for each in explanations.values()):
        say("no file written: swap the wires, or press again, and run this command again", "red")
        return 1
    # The header of the file contains the command that wrote it.
    header = f"./cube bringup {options.port}. Write the positions of the cubes into xyz."
    write_yaml(options.output, data, header)
    say(f"wrote {options.output}: write the positions of the cubes into it")
    return 0 if np.all(rest.works & ~rest.noisy) else 1


def describe_skin_of_hub(options: argparse.Namespace) -> tuple[SkinContent, Skin]:
    """Ask the hub at the port for its cubes, and describe them as a skin.

    Args:
        options: The options of the command.

    Returns:
        Content of a skin file; the skin that it describes.

    Raises:
        CubeError: The hub does not answer, or there is no calibration for its number of pads.
    """
    from pathlib import Path

    from ..config.calibration import find_calibration, read_calibration
    from ..config.grid import describe_grid
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

    # The answer of the hub states the number of pads per cube. It determines the built-in layout,
    # because no two of these have the same number.
    shipped = {layout.n_pads: name for name, layout in LAYOUTS.items()}
    name = options.calibration or shipped.get(hello.n_pads)
    if name is None:
        raise ConfigError(
            f"{port.path}: cubes of {hello.n_pads} pads, and no calibration for them is shipped: "
            "name one with --calibration"
        )
    file = find_calibration(name, Path())
    if options.calibration == str(file):
        # A relative path in a skin file is relative to the folder of that file, so the path that
        # the user gave is made absolute.
        name = str(file.resolve())
    calibration = read_calibration(file)
    # The cubes are written as one row at the default pitch: the hub does not know how they are
    # arranged, and the user replaces the positions.
    data = describe_grid(
        options.name,
        nx=hello.n_cubes,
        ny=1,
        rate=options.rate,
        calibration=name,
        layout=calibration.layout.name,
        port=options.port,
    )

    # Cubes are identified by their unique ids (uid) instead of their index on the hub, so that the
    # file stays valid if they are connected in another order.
    for cube, uid in zip(data["cubes"], hello.cube_uids.tolist(), strict=True):
        del cube["index"]
        cube["uid"] = f"{uid:#x}"
    skin, mistakes = check_skin_data(data, Path())
    if skin is None:
        raise ConfigError(f"{port.path}: {mistakes[0]}")
    return data, skin


def watch_rest(source: LinkSource) -> PadsAtRest:
    """Measure the pads for `REST_S` while nothing touches them, and show them in a table.

    The table is updated live if stdout is a terminal.

    Args:
        source: Connection to the hub.

    Returns:
        Rest frequency, noise, drift and state of each pad.
    """
    import numpy as np
    from rich.console import Console
    from rich.live import Live

    from ..calibrate.averages import split_into_scans
    from ..calibrate.pad_rest import MIN_SAMPLES, measure_pads_at_rest

    parts: list[tuple[np.ndarray, np.ndarray]] = []
    next_shown_s = 0.0
    console = Console(highlight=False)
    with Live(
        console=console,
        transient=True,
        auto_refresh=False,
    ) as live:
        for rows in source:
            parts.append(split_into_scans(rows, len(source.skin.cubes)))
            _, first_times = parts[0]
            _, last_times = parts[-1]
            # The duration is measured by the stamps of the samples and not by the computer's clock,
            # so that a slow computer collects as many samples as a fast one.
            now_s = float(last_times[-1] - first_times[0])
            is_over = now_s >= REST_S
            is_due = is_over or now_s >= next_shown_s
            n_samples = sum(len(each) for each, _ in parts)
            if n_samples < MIN_SAMPLES or not is_due:
                continue
            next_shown_s = now_s + AVERAGE_S
            columns = zip(*parts, strict=True)
            frequency, seconds = map(np.concatenate, columns)
            rest = measure_pads_at_rest(frequency, seconds)
            table = tabulate_pads(rest, source.skin)
            live.update(table, refresh=True)
            if is_over:
                break
    # The live table is erased at its end. The printed table stays on the screen, and is also
    # written if stdout is no terminal.
    console.print(table)
    return rest


def press_cubes(source: LinkSource, rest: PadsAtRest) -> dict[int, Explanation]:
    """Ask the user to press beside each cube, and find the rotation of each cube from the presses.

    Args:
        source: Connection to the hub.
        rest: The pads without load. Cubes without any working pad are left out.

    Returns:
        Index of a cube -> rotation and swapped pads that explain the presses best.
    """
    import numpy as np

    from ..calibrate.averages import average_over_time
    from ..calibrate.presses import (
        SIDES,
        PressDetector,
        compute_expected_presses,
        explain_presses,
        list_cube_rotations,
    )
    from ..core.oscillator import compute_pad_stress
    from ..views.terminal.output import say

    cubes = source.skin.cubes
    calibration = cubes[0].calibration
    detector = PressDetector(rest.frequency, rest.noise, rest.works)
    means = average_over_time(source, len(cubes), AVERAGE_S)
    has_working_pad = rest.works.any(axis=1)
    waiting = set(np.flatnonzero(has_working_pad).tolist())
    expected = compute_expected_presses(calibration, list_cube_rotations())
    explanations: dict[int, Explanation] = {}

    def wait_for_press(allowed: set[int], where: str) -> SteadyPress:
        """Ask the user to press until a press loads an allowed cube, and return that press.

        Args:
            allowed: Indices of the cubes of which a press is accepted.
            where: Description of the cube and its side, for the text that asks the user.
        """
        while True:
            say(f"press the skin next to {where}, and hold")
            presses = map(detector.update, means)
            press = next(each for each in presses if each is not None)
            say(f"{cubes[press.cube].name} answers: let go")
            while detector.is_held:
                detector.update(next(means))
            if press.cube in allowed:
                return press

    while waiting:
        which = "a cube that was not pressed yet," if explanations else "a cube"
        first_side, *other_sides = SIDES
        # The user chooses the cube by the first press; the other presses must load the same cube.
        presses = [wait_for_press(waiting, f"{which} on its {first_side} side")]
        cube = presses[0].cube
        for side in other_sides:
            presses.append(wait_for_press({cube}, f"{cubes[cube].name} on its {side} side"))
        # The pad law (docs/physics.md) converts relative changes of frequency into pad stresses.
        ratio = 1 + np.array([each.change for each in presses])
        measured = compute_pad_stress(
            ratio,
            1.0,
            calibration.beta,
            calibration.modulus,
        )
        explanations[cube] = explain_presses(measured, expected)
        waiting.discard(cube)
    return explanations


def tabulate_pads(rest: PadsAtRest, skin: Skin) -> Table:
    """Return the table of the pads of a skin.

    Args:
        rest: The pads, as measured without load until now.
        skin: The skin, whose cubes have the same pads.
    """
    import numpy as np

    from ..views.terminal.output import make_table

    pads = skin.cubes[0].calibration.layout.pads
    table = make_table(("cube", "pad"), ("f / Hz", "noise / ppm", "drift / (ppm/min)"))
    table.add_column("state")
    for cube, pad in np.ndindex(rest.frequency.shape):
        # A silent pad (no frequency measured) has empty cells.
        numbers = ("", "", "")
        if np.isfinite(rest.frequency[cube, pad]):
            numbers = (
                f"{rest.frequency[cube, pad]:.1f}",
                f"{PPM * rest.noise[cube, pad]:.1f}",
                f"{PPM * rest.drift[cube, pad]:+.0f}",
            )
        name = skin.names[cube] if pad == 0 else ""
        fault = find_pad_fault(rest, cube, pad)
        style = "red" if fault else ""
        table.add_row(
            name,
            pads[pad],
            *numbers,
            fault or "ok",
            style=style,
        )
    return table


def find_pad_fault(rest: PadsAtRest, cube: int, pad: int) -> str:
    """Return the fault of a pad: "silent", "stuck" or "noisy"; an empty text if it has none.

    Args:
        rest: The pads as measured without load.
        cube: Index of the cube on the hub.
        pad: Index of the pad on the cube.
    """
    for name in ("silent", "stuck", "noisy"):
        if getattr(rest, name)[cube, pad]:
            return name
    return ""


def show_explanation(
    name: str,
    explanation: Explanation,
    pads: Sequence[str],
) -> None:
    """Print the rotation and the swapped pads of a cube, as found from the presses.

    Args:
        name: Name of the cube.
        explanation: Rotation and swapped pads, and how well they explain the presses.
        pads: Names of the pads.
    """
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
        findings.append(f"turned, rpy {format_rotation(explanation.rotation)}")
    if explanation.swapped:
        pairs = [
            f"{pads[wire]} is {pads[explanation.places[wire]]}" for wire in explanation.swapped
        ]
        findings.append(f"pads are swapped: {', '.join(pairs)}")
    style = "red" if explanation.swapped else "yellow" if findings else "green"
    say(f"{name}: {'; '.join(findings) or 'as it should be'}", style)


def compute_rpy(rotation: np.ndarray) -> list[float]:
    """Return roll, pitch and yaw of a rotation matrix, in radians, as in a skin file.

    Args:
        rotation: Rotation matrix (3, 3) from the frame of a cube to the parent frame of the skin.
    """
    from ..core.tensor import quaternion_from_rotation, rpy_from_quaternion

    quaternion = quaternion_from_rotation(rotation)
    angles = rpy_from_quaternion(quaternion)
    # Adding 0.0 turns -0.0 into 0.0, so that no "-0.0" is written into the file.
    return [round(float(angle) + 0.0, 9) for angle in angles]


def format_rotation(rotation: np.ndarray) -> str:
    """Return roll, pitch and yaw of a rotation as text in degrees, such as "0° 0° 90°".

    Args:
        rotation: Rotation matrix (3, 3) from the frame of a cube to the parent frame of the skin.
    """
    import math

    degrees = [math.degrees(angle) for angle in compute_rpy(rotation)]
    return " ".join(f"{angle:.0f}°" for angle in degrees)
