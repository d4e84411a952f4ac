# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""./cube fit: compute a calibration from known loads and the frequencies measured under them."""

from __future__ import annotations

import argparse
import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING

from .parser import Parser, positive, uid

if TYPE_CHECKING:
    from ..calibrate.fit import Fit
    from ..calibrate.load_table import Loads
    from ..core.arrays import Array
    from ..core.calibration import Calibration
    from ..core.layout import Layout


FIGURES = (
    *("coefficients", "deviations", "gain", "gain_deviation", "scale", "chi2", "dof"),
    *("held_out", "undetermined", "advice"),
)
"""Names of the attributes of a `Fit` that are written to the file of the option --json."""


def add_arguments(parser: Parser) -> None:
    """Add the options of the command."""
    parser.add_value(
        "loads",
        "LOADS",
        "CSV with columns of pads (Hz) and of modes (Pa) or fx fy fz (N); or a bag",
        Path,
        nargs="?",
    )
    parser.add_value(
        "--reference",
        "TOPIC",
        "topic of the bag to fit to: WrenchStamped (with --area) or stress",
    )
    parser.add_value(
        "--cube",
        "NAME",
        "cube of the bag, if there are several in it",
    )
    parser.add_value("--layout", "NAME", "quad, planar, cube, or a YAML file")
    parser.add_value(
        "--weight",
        "BAG",
        "instead of a table, fit the response to weight and inertia to a bag in which an "
        "unloaded arm is turned through a few poses",
        Path,
    )
    parser.add_value(
        "--creep",
        "BAG",
        "instead of a table, fit the creep of the foam to a bag with one press that is held",
        Path,
    )
    parser.add_value(
        "--rest",
        "BAG",
        "instead of a table, fit the pads' drift and thermal stress over temperature to bags "
        "in which the unloaded skin warms or cools; several cubes become -o FILE_CUBE.yaml",
        Path,
        nargs="+",
    )
    parser.add_value(
        "--symmetry",
        "G",
        "full, slab, mirrors or none (default: %(default)s)",
        default="full",
    )
    parser.add_output(
        "-o",
        "--output",
        kind="yaml",
        required=True,
        help="calibration file to write",
    )
    parser.add_value(
        "--base",
        "FILE",
        "calibration that gives beta, modulus and half side (default: the shipped one)",
    )
    parser.add_value(
        "--area",
        "M2",
        "area that fx fy fz act on, square metres",
        positive,
    )
    parser.add_value(
        "--uid",
        "UID",
        "uid of the only cube that the calibration is for",
        uid,
    )
    parser.add_output(
        "--figure",
        kind="picture",
        default=lambda options: options.output.with_suffix(".png"),
        help="picture of measured against fitted, or before and after (default: next to -o, .png)",
    )
    parser.add_json()


def run(options: argparse.Namespace) -> int:
    """Calibrate from a table of known loads and measured frequencies, or from bags."""
    if options.weight is not None:
        run_weight(options)
    elif options.creep is not None:
        run_creep(options)
    elif options.rest is not None:
        run_rest(options)
    else:
        run_table(options)
    return 0


def write_result(path: Path, calibration: Calibration, words: str) -> None:
    """Write a calibration file and print its path.

    Args:
        path: The file.
        calibration: The result of a fit.
        words: Arguments of ./cube fit, which the header of the file contains.
    """
    from ..config.calibration import write_calibration

    write_calibration(path, calibration, f"./cube fit {words}")
    print(f"wrote {path}: calibration {calibration.id}")


def run_table(options: argparse.Namespace) -> None:
    """Fit the response to a table of loads or to a bag with a reference sensor."""
    import datetime
    from dataclasses import replace

    import numpy as np

    from ..calibrate.fit import compute_measured_stress, fit
    from ..config.calibration import find_named_layout
    from ..config.output_files import write_json
    from ..core.errors import ConfigError
    from ..core.symmetry import find_structure
    from ..views.figures.calibration import draw_fit
    from ..views.figures.style import save

    if options.loads is None or options.layout is None:
        raise ConfigError(
            "./cube fit needs a table of loads and --layout, or --weight BAG, --creep BAG or "
            "--rest BAG"
        )
    layout = find_named_layout(options.layout)
    loads, base, rest, rest_source = read_inputs(options, layout)
    # A calibration with a uid (unique id of a cube) can only be used for that cube.
    base = replace(base, rest_frequency=rest, uid=options.uid)

    # Rows without load are left out of the fit, because they contain no information about the
    # response of the pads. Their average has given the rest frequencies.
    loaded = loads.amplitudes.any(axis=1)
    temperature = None if loads.temperature is None else loads.temperature[loaded]
    measured = compute_measured_stress(
        base,
        loads.frequency[loaded],
        temperature,
    )
    structure = find_structure(layout, options.symmetry)
    result = fit(
        structure,
        loads.amplitudes[loaded],
        measured,
        base.noise,
    )

    show_fit(result, f"rest frequencies {rest_source}")
    if options.json is not None:
        figures = {name: getattr(result, name) for name in FIGURES}
        # Each outlier is a pair: index of the row among the rows with load, index of the pad.
        write_json(options.json, figures | {"outliers": np.argwhere(result.outliers)})
    # The calibration file contains time and source, so that its origin can be found later.
    created = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    table = options.loads.name
    calibration = result.make_calibration(
        base,
        created,
        f"fit of {table}, {len(measured)} loads",
    )
    words = f"{table} --layout {options.layout} --symmetry {options.symmetry}"
    save(draw_fit(result, measured), options.figure)
    write_result(options.output, calibration, words)


def run_rest(options: argparse.Namespace) -> None:
    """Fit the effect of temperature to bags, print and draw it, and write the calibrations."""
    from ..calibrate.thermal import fit_thermal, read_warming
    from ..views.figures.calibration import draw_thermal_fit
    from ..views.figures.style import save
    from ..views.terminal.output import print_table

    warming = read_warming(options.rest, options.cube)
    fits = {name: fit_thermal(data) for name, (_, data) in warming.items()}
    bags = " ".join(path.name for path in options.rest)
    columns = ("longest lag, s", "degree", "before, Pa", "after, Pa", "deviation, Pa/K")
    rows = []
    for name, result in fits.items():
        lag = f"{result.model.lag.max():.0f}"
        degree = str(result.model.coefficient.shape[1])
        rows.append((name, lag, degree, *(f"{size:.2f}" for size in result.compute_sizes())))
    print_table(("cube",), columns, rows)
    for name, result in fits.items():
        base, _ = warming[name]
        calibration = result.make_calibration(base, f"{base.source}; temperature fitted to {bags}")
        path, picture = options.output, options.figure
        if len(fits) > 1:
            path, picture = (one.with_stem(f"{one.stem}_{name}") for one in (path, picture))
        save(draw_thermal_fit(result), picture)
        write_result(path, calibration, f"--rest {bags}")


def run_weight(options: argparse.Namespace) -> None:
    """Fit the response to weight and inertia to a bag, print it and write the calibration."""
    from ..calibrate.weight import fit_weight
    from ..views.figures.calibration import draw_correction
    from ..views.figures.style import save
    from ..views.terminal.output import print_table

    calibration, *shown = fit_weight(options.weight, options.cube)
    model = calibration.weight
    if model is not None and model.deviation is not None:
        cells = [
            [f"{value:+.3f} ± {sd:.2g}" for value, sd in zip(*of_pad, strict=True)]
            for of_pad in zip(model.response, model.deviation, strict=True)
        ]
        pads = calibration.layout.pads
        rows = [(pad, *values) for pad, values in zip(pads, cells, strict=True)]
        print_table(
            ("pad",),
            [f"{axis}, Pa per m/s²" for axis in "xyz"],
            rows,
        )
    title = f"stress of the {len(calibration.gain)} pads under weight alone"
    save(draw_correction(title, *shown), options.figure)
    write_result(
        options.output,
        calibration,
        f"--weight {options.weight.name}",
    )


def run_creep(options: argparse.Namespace) -> None:
    """Fit the creep of the pads' foam to a bag, print and draw it, and write the calibration.

    In the bag, the cube is pressed once, and the load is held for some time.
    """
    from ..calibrate.creep import compute_step_reading, fit_recorded_creep
    from ..views.figures.calibration import draw_correction
    from ..views.figures.style import save
    from ..views.terminal.output import print_table, say

    result, calibration = fit_recorded_creep(options.creep, options.cube)
    at_once, *later = (compute_step_reading(result.model, time) for time in (1.0, 600.0, 3600.0))
    growth = [[f"{percent:.2f}" for percent in 100 * (one / at_once - 1)] for one in later]
    loads = [f"{load:.0f}" for load in result.load]
    pads = itertools.compress(calibration.layout.pads, ~calibration.layout.is_dummy)
    print_table(
        ("pad",),
        ("load, Pa", "creep from 1 s to 10 min, %", "to 1 h, %"),
        list(zip(pads, loads, *growth, strict=True)),
    )
    say(
        f"{len(result.model.time)} relaxation times explain a hold of {result.hold_s:.0f} s to "
        f"{100 * result.misfit:.2g} % of the load"
    )
    title = f"change of the {len(result.load)} pads' readings under a constant load, and after it"
    picture = draw_correction(
        title,
        result.seconds,
        result.before,
        result.after,
    )
    save(picture, options.figure)
    write_result(options.output, calibration, f"--creep {options.creep.name}")


def read_inputs(
    options: argparse.Namespace,
    layout: Layout,
) -> tuple[Loads, Calibration, Array, str]:
    """Read the loads, and the base calibration with the quantities that are not fitted.

    These quantities are the pad law (relation between the stress on a pad and its relative change
    of frequency, with the parameters beta and foam modulus), half the cube's side, and the noise.

    Args:
        options: The options of the command.
        layout: Layout of the cube's pads.

    Returns:
        Loads; base calibration; rest frequencies (pads,) in Hz; origin of the rest frequencies, in
        words.

    Raises:
        CubeError: The table or bag cannot be used, or there is no base calibration.
    """
    from ..bags.read import is_bag
    from ..calibrate.load_table import read_loads
    from ..calibrate.recorded_loads import read_recorded_loads
    from ..config.calibration import find_calibration, find_shipped_calibration, read_calibration
    from ..core.errors import ConfigError

    base = find_shipped_calibration(layout)
    rest: Array | None
    if options.reference is not None:
        loads, base = read_recorded_loads(
            options.loads,
            options.cube,
            options.reference,
            layout,
            options.area,
        )
        # Unloaded rows cannot be found in a bag, because a reference sensor never measures exactly
        # 0. Therefore the rest frequencies are those of the last tare during the recording.
        rest, rest_source = base.rest_frequency, "of the bag, after tare"
    # A bag contains frequencies but no table of loads. Loads can be read from a bag only with
    # --reference, which names the recorded topic of a reference sensor.
    elif is_bag(options.loads):
        raise ConfigError(
            f"{options.loads} is a bag: name the topic to fit to with --reference; "
            f"./cube bag info {options.loads} lists them"
        )
    else:
        loads = read_loads(options.loads, layout, options.area)
        rest, rest_source = loads.average_unloaded_frequency(), "of the rows without load"

    if options.base is not None:
        base = read_calibration(find_calibration(options.base, Path()))
        base.check(layout, options.uid)
    # The package contains calibrations only for the built-in layouts.
    if base is None:
        raise ConfigError(
            f"layout {layout.name!r} is not a built-in one: name a calibration for it with --base"
        )
    if rest is None:
        rest = base.rest_frequency
        rest_source = "of the base calibration: the table has no row without load"
    return loads, base, rest, rest_source


def show_fit(result: Fit, remark: str) -> None:
    """Print coefficients and gains of a fit, its quality, and which loads would improve it.

    Args:
        result: Result of the fit.
        remark: Origin of the rest frequencies, in words.
    """
    from ..views.terminal.output import print_table, say

    say(f"coefficients, {result.structure.symmetry} symmetry, Pa per Pa; {remark}")
    coefficients = []
    for name, value in result.coefficients.items():
        # A coefficient that the loads do not determine is NaN.
        cells = ("open", "not determined")
        if math.isfinite(value):
            cells = (f"{value:+.5f}", f"{result.deviations[name]:.2g}")
        coefficients.append((name, *cells))
    print_table(
        ("coefficient",),
        ("value", "standard deviation"),
        coefficients,
    )

    say("gains (average 1 over pads that the symmetry carries onto each other)")
    pads = result.structure.layout.pads
    gains = [
        (pad, f"{gain:.5f}", f"{deviation:.2g}")
        for pad, gain, deviation in zip(
            pads,
            result.gain,
            result.gain_deviation,
            strict=True,
        )
    ]
    print_table(("pad",), ("gain", "standard deviation"), gains)

    say(
        f"scatter {result.scale:.3g} × the stated noise; "
        f"chi-square {result.chi2:.4g} for {result.dof} degrees of freedom; "
        f"held-out error {100 * result.held_out:.3g} % of the readings; "
        f"{int(result.outliers.sum())} outliers"
    )
    for sentence in result.advice:
        say(sentence, "red")
