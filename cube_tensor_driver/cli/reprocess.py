"""./cube reprocess: bags to stress again, in parallel, here or on a Dask cluster; without ROS."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.defaults import CONTACT_METHODS
from .parser import Parser, count, number

if TYPE_CHECKING:
    from ..bags.reprocess.contacts import ContactsOverTime
    from ..bags.reprocess.job import Overrides


def arguments(parser: Parser) -> None:
    parser.add_argument(
        "bags", type=Path, nargs="+", metavar="BAG", help="folders or files of bags"
    )
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
        nargs="+",
        metavar=("METHOD", "KEY:=VALUE"),
        help="add contacts and traction, as the node contacts makes them with method:=METHOD and "
        "its other parameters: depth:=0.005 thickness:=0.011 rate:=20",
    )
    parser.add_argument(
        "--jobs", type=count, metavar="N", help="number of processes (default: one per core)"
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="scheduler of a Dask cluster to run on, as in tcp://host:8786",
    )


def add_overrides(parser: Parser) -> None:
    """Options that say what differs from the recording; `overrides_of` reads them."""
    parser.add_argument(
        "--calibration", metavar="FILE", help="calibration of all cubes (default: as recorded)"
    )
    parser.add_argument(
        "--skin",
        type=Path,
        metavar="FILE",
        help="skin file with the calibrations to use, for cubes of the same names",
    )
    parser.add_argument(
        "--tare-from",
        type=number,
        nargs=2,
        metavar=("T0", "T1"),
        help="tare between these times, s after the start of the bag, without load on any cube",
    )


def run(options: argparse.Namespace) -> int:
    """1 if a bag could not be reprocessed. CubeError: nothing was begun."""
    from ..bags.reprocess.all_bags import (
        make_jobs,
        remove_without_results,
        reprocess_all,
        useful_workers,
        workers,
        write_recipe,
    )
    from ..views.terminal.reprocessing import ReprocessingReport

    overrides, contacts = overrides_of(options), contacts_of(options)
    jobs = make_jobs(options.bags, options.output, options.format, overrides, contacts)
    write_recipe(options.output, options.format, overrides, contacts)
    waiting = [job for job in jobs if not job.output.exists()]
    report = ReprocessingReport(options.output, jobs=len(jobs), waiting=len(waiting))
    processes = useful_workers(options.jobs, len(waiting))
    try:
        with workers(processes, options.scheduler) as executor, report:
            for job, result in reprocess_all(waiting, executor):
                report.add(job.output, result)
    finally:
        remove_without_results(options.output)
    report.summary()
    return 1 if report.failed else 0


def overrides_of(options: argparse.Namespace) -> Overrides:
    """ConfigError: options that contradict each other, or files that are wrong."""
    from ..bags.reprocess.job import Overrides
    from ..config.calibration import find_calibration, read_calibration
    from ..config.skin import read_skin
    from ..core.errors import ConfigError

    if options.calibration is not None and options.skin is not None:
        raise ConfigError("found both --calibration and --skin; give one")
    calibration = skin = tare = None
    if options.tare_from is not None:
        begin, end = tare = tuple(options.tare_from)
        if not 0 <= begin < end:
            raise ConfigError(f"--tare-from {begin:g} {end:g}: needed is 0 <= T0 < T1, in s")
    if options.calibration is not None:
        calibration = read_calibration(find_calibration(options.calibration, Path()))
    if options.skin is not None:
        skin = read_skin(options.skin)
    return Overrides(calibration, skin, tare)


def contacts_of(options: argparse.Namespace) -> ContactsOverTime | None:
    """ConfigError: a method or value that the node `contacts` would not take; or a table."""
    from ..bags.reprocess.contacts import ContactsOverTime
    from ..core.errors import ConfigError
    from ..ros.parameters import CONTACTS
    from ..touch.contact_finder import ContactSettings

    if options.contacts is None:
        return None
    if options.format != "bag":
        raise ConfigError(f"--contacts with --format {options.format}: only a bag holds contacts")
    method, *others = options.contacts
    known = {one.name: one for one in CONTACTS if one.span is not None or one.name == "influence"}
    if method not in CONTACT_METHODS:
        raise ConfigError(f"--contacts {method}: the methods are {', '.join(CONTACT_METHODS)}")
    values = {name: one.default for name, one in known.items()}
    for text in others:
        name, _, value = text.partition(":=")
        if name not in known:
            raise ConfigError(f"--contacts {text}: use NAME:=VALUE with one of {', '.join(known)}")
        if name == "influence":
            values[name] = value
            continue
        low, high = known[name].span or (0.0, 0.0)
        try:
            values[name] = float(value)
        except ValueError:
            values[name] = math.nan
        if not low <= values[name] <= high:
            raise ConfigError(f"--contacts {text}: needed is a number from {low:g} to {high:g}")
    rate = values.pop("rate")
    settings = ContactSettings(method, **values)
    settings.check()
    return ContactsOverTime(settings, rate)
