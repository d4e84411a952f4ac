# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube reprocess: compute the stress of bags again, in parallel.

It needs no ROS. From the same frequencies and calibrations, it computes exactly the same numbers
(bit by bit) as the reconstruction node.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.defaults import CONTACT_METHODS
from .parser import Parser, number

if TYPE_CHECKING:
    from ..bags.reprocess.contacts import ContactOptions
    from ..bags.reprocess.job import Overrides, ReprocessResult


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_bags()
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="folder for the results; those that it has already are not computed again",
    )
    add_overrides(parser)
    parser.add_argument(
        "--format",
        choices=["bag", "parquet", "csv", "zarr"],
        default="bag",
        help="format of the results (default: %(default)s)",
    )
    parser.add_argument(
        "--contacts",
        nargs="*",
        metavar=("METHOD", "KEY:=VAL"),
        help="add touch, contacts and traction, as the nodes make them, with method:=METHOD "
        "and its other parameters: least:=300 rate:=20 influence:=FILE",
    )
    parser.add_jobs()


def add_overrides(parser: Parser) -> None:
    """Add the options that replace recorded calibrations or the recorded tare (rest frequencies).

    `read_overrides` reads them.

    Args:
        parser: The parser of a command that reprocesses bags.
    """
    parser.add_value(
        "--calibration",
        "FILE",
        "calibration of all cubes (default: as recorded)",
    )
    parser.add_value(
        "--skin",
        "FILE",
        "skin file with the calibrations to use, for cubes of the same names, and the elastomer",
        Path,
    )
    parser.add_argument(
        "--tare-from",
        type=number,
        nargs=2,
        metavar=("T0", "T1"),
        help="tare between these times, s after the start of the bag, without load on any cube",
    )


def run(options: argparse.Namespace) -> int:
    """Reprocess the bags.

    Returns:
        1 if a bag could not be reprocessed, otherwise 0.

    Raises:
        CubeError: The options cannot be used. In this case no bag was reprocessed.
    """
    from rich.console import Console

    from ..bags.reprocess.all_bags import (
        make_jobs,
        remove_without_results,
        reprocess_all,
        start_workers,
        write_recipe,
    )
    from ..core.errors import CubeError
    from ..views.terminal.output import show_progress_bar

    overrides, contacts = read_overrides(options), read_contact_options(options)
    jobs = make_jobs(
        options.bags,
        options.output,
        options.format,
        overrides,
        contacts,
    )
    write_recipe(options.output, jobs[0])
    # A bag whose result exists is skipped, so that an interrupted run can be continued.
    waiting = [job for job in jobs if not job.output.exists()]
    console = Console(stderr=True, highlight=False)
    if len(waiting) < len(jobs):
        done = len(jobs) - len(waiting)
        console.print(f"{done} of {len(jobs)} bags are there already in {options.output}")

    failed = 0
    try:
        with start_workers(options.jobs, len(waiting)) as executor, show_progress_bar() as report:
            results = reprocess_all(waiting, executor)
            for done, (job, result) in enumerate(results, 1):
                report(done, len(waiting), "reprocessing")
                if isinstance(result, CubeError):
                    failed += 1
                    console.print(
                        f"cube: {result}",
                        style="red",
                        markup=False,
                    )
                else:
                    console.print(format_result(job.output, result))
    finally:
        # If no bag was completed, the folder is removed, so that the command can be given again.
        remove_without_results(options.output)
    if failed:
        console.print(f"{failed} of {len(jobs)} bags could not be reprocessed", style="red")
    return 1 if failed else 0


def format_result(output: Path, result: ReprocessResult) -> str:
    """Return a line with the numbers of messages and rows computed from a bag, and its duration.

    Args:
        output: Path of the result, which the line contains.
        result: Numbers of messages and rows (one cube at one sampling time), and the duration.
    """
    skipped = f", {result.skipped} damaged ones left out" if result.skipped else ""
    return (
        f"{output}: {result.messages} messages{skipped}, {result.rows} rows, {result.seconds:.1f} s"
    )


def read_overrides(options: argparse.Namespace) -> Overrides:
    """Return the calibrations and the tare that the options set instead of the recorded ones.

    Args:
        options: The parsed options, see `add_overrides`.

    Raises:
        ConfigError: Options contradict each other, or a file cannot be used.
    """
    from ..bags.reprocess.job import Overrides
    from ..config.calibration import find_calibration, read_calibration
    from ..config.skin import read_skin
    from ..core.errors import ConfigError

    if options.calibration is not None and options.skin is not None:
        raise ConfigError("found both --calibration and --skin; give one")
    calibration = skin = tare = None
    if options.tare_from is not None:
        # Both times are in s after the start of each bag.
        begin, end = tare = tuple(options.tare_from)
        if not 0 <= begin < end:
            raise ConfigError(f"--tare-from {begin:g} {end:g}: needed is 0 <= T0 < T1, in s")
    if options.calibration is not None:
        path = find_calibration(options.calibration, Path())
        calibration = read_calibration(path)
    if options.skin is not None:
        skin = read_skin(options.skin)
    return Overrides(calibration, skin, tare)


def read_contact_options(options: argparse.Namespace) -> ContactOptions | None:
    """Return the options with which contacts are computed; None without the option --contacts.

    Raises:
        ConfigError: The output format cannot contain contacts, or the node `contacts` would refuse
            the method or the value of a parameter.
    """
    from ..bags.reprocess.contacts import ContactOptions
    from ..config.parameters import CONTACTS
    from ..core.errors import ConfigError
    from ..touch.contact_finder import ContactSettings

    if options.contacts is None:
        return None
    if options.format != "bag":
        raise ConfigError(f"--contacts with --format {options.format}: only a bag holds contacts")
    assignments = list(options.contacts)
    has_method = bool(assignments) and ":=" not in assignments[0]
    method = assignments.pop(0) if has_method else CONTACT_METHODS[0]
    if method not in CONTACT_METHODS:
        raise ConfigError(f"--contacts {method}: the methods are {', '.join(CONTACT_METHODS)}")

    # The other parameters of the node `contacts` do not affect the computed contacts.
    known = {one.name: one for one in CONTACTS if one.name in ("least", "rate", "influence")}
    values = {name: one.default for name, one in known.items()}
    for text in assignments:
        name, _, value = text.partition(":=")
        if name not in known:
            raise ConfigError(f"--contacts {text}: use NAME:=VALUE with one of {', '.join(known)}")
        values[name] = known[name].parse(value)
        refusal = known[name].find_refusal(values[name])
        if refusal:
            raise ConfigError(f"--contacts {text}: {refusal}")
    least, influence = float(values["least"]), str(values["influence"])
    settings = ContactSettings(method, least, influence)
    return ContactOptions(settings, float(values["rate"]))
