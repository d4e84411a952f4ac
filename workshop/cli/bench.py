# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube bench: speed, beside the bare minimum that does the same."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from cube_tensor_driver.cli.parser import Parser, count, not_negative, positive, sample_rate

DEFAULT_COUNTS = [1, 4, 16, 64, 256, 1024, 4096]
"""Numbers of cubes for which `./cube bench scale` measures the chain by default."""


def add_arguments(parser: Parser) -> None:
    """Add a subcommand for each benchmark."""
    _add(
        parser,
        "pipeline",
        "the core against the same equations and matrix product in bare numpy",
        cubes=1260,
    )
    _add(
        parser,
        "decode",
        "the decoder on clean frames and all kinds of noise, GB/s",
    )
    _add(
        parser,
        "links",
        "from the bytes of hubs in C to arrays, without DDS and reconstruction",
        cubes=1280,
        timed=True,
    )
    _add(
        parser,
        "echo",
        "bare rclpy: publish, echo and receive messages of a skin's sizes",
        cubes=64,
        timed=True,
    )
    skin = _add(
        parser,
        "skin",
        "from simulated hubs to received tensors, against the echo",
        cubes=64,
        timed=True,
    )
    touch = _add(
        parser,
        "touch",
        "latency from hubs to received touch, and the processor time that it adds",
        cubes=256,
        timed=True,
    )

    scale = _add(
        parser,
        "scale",
        "skin for growing numbers of cubes, with a picture",
        timed=True,
    )
    scale.add_value(
        "--counts",
        "N",
        f"numbers of cubes (default: {' '.join(map(str, DEFAULT_COUNTS))})",
        count,
        nargs="+",
        default=DEFAULT_COUNTS,
    )
    scale.add_output(
        "--figure",
        kind="picture",
        default=Path("scale.png"),
        help="picture to write (default: %(default)s)",
    )

    contacts = _add(
        parser,
        "contacts",
        "latency of contacts from hubs to a subscriber while four balls move, the processor time "
        "that they add, and their errors by the shape of the load",
        cubes=256,
        timed=True,
        rate=100.0,
    )
    for chain in (skin, touch, contacts):
        _add_chain(chain)
    contacts.add_value(
        "--loads",
        "N",
        "number of loads of each shape (default: %(default)s)",
        count,
        default=10,
    )
    contacts.add_output(
        "--figure",
        kind="picture",
        default=Path("contacts.png"),
        help="picture to write (default: %(default)s)",
    )


def _add(
    parser: Parser,
    name: str,
    text: str,
    cubes: int | None = None,
    timed: bool = False,
    rate: float = 1000.0,
) -> Parser:
    """Add the subcommand of a benchmark, and return it.

    Args:
        parser: Parser of `./cube bench`.
        name: Name of the benchmark.
        text: What it measures, for the help.
        cubes: Default number of cubes; None: it has no such option.
        timed: Whether it has options for a sampling rate and a duration.
        rate: Default sampling rate, in Hz.
    """
    benchmark = parser.add_subcommand(name, text)
    if cubes is not None:
        benchmark.add_value(
            "--cubes",
            "N",
            "number of cubes (default: %(default)s)",
            count,
            default=cubes,
        )
    if timed:
        benchmark.add_value(
            "--rate",
            "HZ",
            "scans per second (default: %(default)g)",
            sample_rate,
            default=rate,
        )
        benchmark.add_value(
            "--duration",
            "S",
            "how long to measure, s (default: %(default)g)",
            positive,
            default=10.0,
        )
    benchmark.add_json()
    return benchmark


def _add_chain(parser: Parser) -> None:
    parser.add_switch("--composed", "run driver and reconstruction in one process")
    parser.add_value(
        "--publish-period",
        "S",
        "time that one message covers, s; 0: one message per scan (default: %(default)g)",
        not_negative,
        default=0.0,
    )
    parser.add_argument(
        "--pads",
        type=int,
        choices=(8, 24),
        default=8,
        help="number of pads of each cube (default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Run a benchmark and report its figures; the modules of other benchmarks are not imported."""
    from ..report import report

    report(_measure(options), options.json)
    return 0


def _measure(options: argparse.Namespace) -> dict[str, Any]:
    if options.what == "decode":
        from ..bench.decode import bench_decode

        return bench_decode()
    if options.what == "pipeline":
        from ..bench.pipeline import bench_pipeline

        return bench_pipeline(options.cubes)
    if options.what == "links":
        from ..bench.links import bench_links

        return bench_links(options.cubes, options.rate, options.duration)

    from ..bench.skin import Bench, bench_echo, bench_found, bench_scale, bench_skin

    bench = Bench(options.rate, options.duration)
    if options.what == "echo":
        return bench_echo(options.cubes, bench)
    if options.what == "scale":
        return bench_scale(options.counts, bench, options.figure)
    chain = Bench(
        options.rate,
        options.duration,
        options.publish_period,
        options.composed,
        options.pads,
    )
    if options.what == "touch":
        return bench_found(options.cubes, replace(chain, topic="touch"))
    if options.what == "contacts":
        from cube_tensor_driver.views.figures.style import save

        from ..bench.contacts import bench_shapes, summarise
        from ..bench.contacts_figure import draw_shapes

        moving = bench_found(options.cubes, replace(chain, topic="contacts", has_load=True))
        results = bench_shapes(options.loads)
        save(draw_shapes(results), options.figure)
        return {"balls that move": moving} | summarise(results)
    return bench_skin(options.cubes, chain)
