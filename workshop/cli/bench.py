"""./cube bench: speed, beside the bare minimum that does the same."""

from __future__ import annotations

import argparse
from pathlib import Path

from cube_tensor_driver.cli.parser import Parser, count, not_negative, positive, sample_rate


def arguments(parser: Parser) -> None:
    pipeline = parser.add_subcommand(
        "pipeline", "the core against the same equations and matrix product in bare numpy"
    )
    _add_cubes(pipeline, 1260)
    pipeline.add_json()

    decode = parser.add_subcommand(
        "decode", "the decoder on clean frames and all kinds of noise, GB/s"
    )
    decode.add_json()

    links = parser.add_subcommand(
        "links", "from the bytes of hubs in C to arrays, without DDS and reconstruction"
    )
    _add_cubes(links, 1280)
    _add_time(links)
    links.add_json()

    echo = parser.add_subcommand(
        "echo", "bare rclpy: publish, echo and receive messages of a skin's sizes"
    )
    _add_cubes(echo, 64)
    _add_time(echo)
    echo.add_json()

    skin = parser.add_subcommand(
        "skin", "from simulated hubs to received tensors, against the echo"
    )
    _add_cubes(skin, 64)
    _add_time(skin)
    skin.add_argument(
        "--composed", action="store_true", help="run driver and reconstruction in one process"
    )
    skin.add_argument(
        "--publish-period",
        type=not_negative,
        default=0.0,
        metavar="S",
        help="time that one message covers, s; 0: one message per scan (default: %(default)g)",
    )
    skin.add_json()

    scale = parser.add_subcommand("scale", "skin for growing numbers of cubes, with a picture")
    scale.add_argument(
        "--counts",
        type=count,
        nargs="+",
        default=[1, 4, 16, 64, 256, 1024, 4096],
        metavar="N",
        help="numbers of cubes (default: 1 4 16 64 256 1024 4096)",
    )
    _add_time(scale)
    scale.add_json()
    scale.add_output(
        "--figure",
        kind="picture",
        default=Path("scale.png"),
        help="picture to write (default: %(default)s)",
    )


def _add_cubes(parser: Parser, default: int) -> None:
    parser.add_argument(
        "--cubes",
        type=count,
        default=default,
        metavar="N",
        help="number of cubes (default: %(default)s)",
    )


def _add_time(parser: Parser) -> None:
    parser.add_argument(
        "--rate",
        type=sample_rate,
        default=1000.0,
        metavar="HZ",
        help="scans per second (default: %(default)g)",
    )
    parser.add_argument(
        "--duration",
        type=positive,
        default=10.0,
        metavar="S",
        help="how long to measure, s (default: %(default)g)",
    )


def run(options: argparse.Namespace) -> int:
    if options.what == "decode":
        from ..bench.decode import bench_decode

        return bench_decode(json_path=options.json)
    if options.what == "links":
        from ..bench.links import bench_links

        return bench_links(
            cubes=options.cubes,
            rate=options.rate,
            duration=options.duration,
            json_path=options.json,
        )
    from ..bench import skin as bench

    if options.what == "pipeline":
        return bench.bench_pipeline(cubes=options.cubes, json_path=options.json)
    if options.what == "echo":
        return bench.bench_echo(
            cubes=options.cubes,
            rate=options.rate,
            duration=options.duration,
            json_path=options.json,
        )
    if options.what == "scale":
        return bench.bench_scale(
            counts=options.counts,
            rate=options.rate,
            duration=options.duration,
            json_path=options.json,
            figure=options.figure,
        )
    return bench.bench_skin(
        cubes=options.cubes,
        rate=options.rate,
        duration=options.duration,
        publish_period=options.publish_period,
        composed=options.composed,
        json_path=options.json,
    )
