# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube plot: draw one cube of a bag over time."""

from __future__ import annotations

import argparse
import math

from .parser import Parser, number


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_bag()
    parser.add_value("--cube", "NAME", "which cube (default: the first)")
    parser.add_value(
        "--from",
        "S",
        "begin S seconds after the start of the bag",
        number,
        default=0.0,
    )
    parser.add_value(
        "--to",
        "S",
        "end S seconds after the start of the bag",
        number,
        default=math.inf,
    )
    parser.add_output(
        "-o",
        "--output",
        kind="picture",
        required=True,
        help="picture to write",
    )


def run(options: argparse.Namespace) -> int:
    """Draw frequencies, stress, gradient and residual of one cube."""
    from ..bags.source import open_bag
    from ..views.figures.style import save
    from ..views.figures.time_series import draw_series, read_cube_series

    with open_bag(options.bag) as source:
        series = read_cube_series(
            source,
            options.cube,
            # `from` is a keyword of Python.
            getattr(options, "from"),
            options.to,
        )
    save(draw_series(series, options.bag.resolve().name), options.output)
    print(f"wrote {options.output}: cube {series.name}, {len(series.seconds)} samples")
    return 0
