"""./cube bringup: the pads of a new hub, which of them are which, and a skin file."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from .parser import Parser, sample_rate

if TYPE_CHECKING:
    import numpy as np

    from ..calibrate.pad_order import Explanation
    from ..calibrate.pad_rest import PadsAtRest
    from ..calibrate.press import Press
    from ..config.skin import Skin
    from ..device.live import LinkSource
    from ..views.terminal.bringup import BringupScreen

REST_S = 5.0
"""How long pads rest before the presses: their noise and drift are from this time."""
SHOW_S = 0.25
"""How often the table is drawn, and the span of the averages in which presses are found."""
PITCH = 0.012
"""Distance of the cubes in the file, m, which knows nothing of where they are."""


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
    """1 if a pad does not work, pads are swapped, or presses say nothing; else 0."""
    import numpy as np

    from ..config.yaml import write_yaml
    from ..core.errors import ConfigError
    from ..device.live import open_links
    from ..views.terminal.bringup import BringupScreen

    if options.output.exists():
        raise ConfigError(f"-o {options.output}: the file is there; remove it, or name another one")
    data, skin = first_skin(options)
    names = [cube.name for cube in skin.cubes]
    with (
        open_links(skin) as source,
        BringupScreen(names, skin.cubes[0].calibration.layout.pads) as screen,
    ):
        screen.say("leave the skin alone")
        rest = watch_rest(source, screen)
        found = press_cubes(source, rest, screen)
    for cube, explanation in found.items():
        data["cubes"][cube]["pose"]["rpy"] = rpy(explanation.turn)
        screen.verdict(names[cube], explanation)
    if any(each.swapped or not each.is_clear for each in found.values()):
        screen.say(
            "no file written: swap the wires, or press again, and run this command again", "red"
        )
        return 1
    header = f"./cube bringup {options.port}. Write the positions of the cubes into xyz."
    write_yaml(options.output, data, header)
    screen.say(f"wrote {options.output}: write the positions of the cubes into it")
    return 0 if np.all(rest.works & ~rest.noisy) else 1


def first_skin(options: argparse.Namespace) -> tuple[dict[str, Any], Skin]:
    """The content of a skin file for the hub at the port, and the skin that it describes.

    CubeError: nobody answers, or there is no calibration for so many pads.
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
    shipped = {layout.n_pads: name for name, layout in LAYOUTS.items()}
    name = options.calibration or shipped.get(hello.n_pads)
    if name is None:
        raise ConfigError(
            f"{port.path}: cubes of {hello.n_pads} pads, and no calibration for them is shipped: "
            "name one with --calibration"
        )
    file = find_calibration(name, Path())
    if options.calibration == str(file):
        name = str(file.resolve())  # the skin file may be elsewhere
    calibration = read_calibration(file)
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
    for cube, uid in zip(data["cubes"], hello.cube_uids.tolist(), strict=True):
        del cube["index"]
        cube["uid"] = f"{uid:#x}"
    skin, mistakes = check_skin_data(data, Path())
    if skin is None:
        raise ConfigError(f"{port.path}: {mistakes[0]}")
    return data, skin


def watch_rest(source: LinkSource, screen: BringupScreen) -> PadsAtRest:
    """The pads while nothing touches them, for REST_S."""
    import numpy as np

    from ..calibrate.pad_rest import LEAST_SAMPLES, pads_at_rest
    from ..device.scans.averages import scans

    parts: list[tuple[np.ndarray, np.ndarray]] = []
    shown = 0.0
    for rows in source:
        parts.append(scans(rows, len(source.skin.cubes)))
        now = float(parts[-1][1][-1] - parts[0][1][0])
        is_over = now >= REST_S
        if sum(len(each) for each, _ in parts) < LEAST_SAMPLES or not (is_over or now >= shown):
            continue
        shown = now + SHOW_S
        frequency, seconds = (np.concatenate(each) for each in zip(*parts, strict=True))
        rest = pads_at_rest(frequency, seconds)
        screen.show_rest(rest)
        if is_over:
            break
    screen.end_rest(rest)
    return rest


def press_cubes(
    source: LinkSource, rest: PadsAtRest, screen: BringupScreen
) -> dict[int, Explanation]:
    """Ask for presses beside each cube that has working pads; what they say, by cube."""
    import numpy as np

    from ..calibrate.pad_order import cube_turns, explain_presses
    from ..calibrate.press import PressWatch
    from ..calibrate.side_press import SIDES, side_presses
    from ..core.oscillator import pad_stress
    from ..device.scans.averages import averages

    cubes = source.skin.cubes
    calibration = cubes[0].calibration
    watch = PressWatch(rest.frequency, rest.noise, rest.works)
    means = averages(source, len(cubes), SHOW_S)
    left = set(np.flatnonzero(rest.works.any(axis=1)).tolist())
    expected = side_presses(calibration, cube_turns())
    found: dict[int, Explanation] = {}

    def press(of: set[int], where: str) -> Press:
        """The next press beside one of these cubes."""
        while True:
            screen.say(f"press the skin next to {where}, and hold")
            read = next(each for each in map(watch.update, means) if each is not None)
            screen.say(f"{cubes[read.cube].name} answers: let go")
            while watch.is_held:
                watch.update(next(means))
            if read.cube in of:
                return read

    while left:
        presses: list[Press] = []
        for side in SIDES:
            if presses:
                one = {presses[0].cube}
                presses.append(press(one, f"{cubes[presses[0].cube].name} on its {side} side"))
            else:
                which = "a cube" if not found else "a cube that was not pressed yet,"
                presses.append(press(left, f"{which} on its {side} side"))
        ratio = 1 + np.array([each.change for each in presses])
        measured = pad_stress(ratio, 1.0, calibration.beta, calibration.modulus)
        found[presses[0].cube] = explain_presses(measured, expected)
        left.discard(presses[0].cube)
    return found


def rpy(turn: np.ndarray) -> list[float]:
    """Roll, pitch and yaw of a turn, rad, as in a skin file."""
    from ..core.tensor import quaternion_from_rotation, rpy_from_quaternion

    return [
        round(float(angle) + 0.0, 9)
        for angle in rpy_from_quaternion(quaternion_from_rotation(turn))
    ]
