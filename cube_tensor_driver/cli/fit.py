"""./cube fit: a calibration from a table of known loads, with what the loads say about it."""

from __future__ import annotations

import dataclasses
import datetime
import math
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ..config.atomic_write import check_outputs
from ..config.calibration import find_calibration, read_calibration, write_calibration
from ..config.load_table import read_loads, unloaded
from ..core.errors import ConfigError
from ..core.fit import Fit, fit, measured_stress
from ..core.symmetry import find_structure
from ..plot.calibration import draw_fit
from ..plot.style import save
from ..terminal.output import write_json
from .layout import named_layout, shipped_calibration


@dataclasses.dataclass(frozen=True)
class Options:
    """As on the command line. area in m² for loads given as forces; base: calibration with the pad
    law's constants.

    reference: topic of a bag, which `loads` then is, of its cube `cube`.
    """

    loads: Path
    layout: str
    symmetry: str
    output: Path
    base: str | None
    area: float | None
    uid: int | None
    figure: Path | None
    json: Path | None
    reference: str | None = None
    cube: str | None = None


def run_fit(options: Options) -> int:
    """Fit, report, write. CubeError: what is wrong; nothing is written then."""
    check_outputs({"--json": options.json, "--figure": options.figure, "-o": options.output})
    layout = named_layout(options.layout)
    recorded = None
    if options.reference is not None:
        from ..bags.loads import bag_loads

        recorded, known = bag_loads(
            options.loads, options.cube, options.reference, layout, options.area
        )
    if options.base is not None:
        base = read_calibration(find_calibration(options.base, Path()))
        base.check(layout, options.uid)
    elif recorded is not None:
        base = known
    else:
        shipped = shipped_calibration(layout)
        if shipped is None:
            raise ConfigError(
                f"layout {layout.name!r} is not a built-in one: name a calibration for it with --base"
            )
        base = shipped
    loads = recorded or read_loads(options.loads, layout, options.area)
    # A reference sensor never reads exactly 0: which time was without load says the tare.
    rest = known.rest_frequency if recorded else unloaded(loads)
    rest_source = "of the bag, after tare" if recorded else "of the rows without load"
    if rest is None:
        rest, rest_source = (
            base.rest_frequency,
            "of the base calibration: the table has no row without load",
        )
    base = dataclasses.replace(base, rest_frequency=rest, uid=options.uid)
    loaded = loads.state.any(axis=1)
    temperature = None if loads.temperature is None else loads.temperature[loaded]
    measured = measured_stress(base, loads.frequency[loaded], temperature)
    structure = find_structure(layout, options.symmetry)
    result = fit(structure, loads.state[loaded], measured, base.noise)
    _show(result, f"rest frequencies {rest_source}")
    if options.json is not None:
        _write_json(options.json, result)
    if options.figure is not None:
        save(draw_fit(result, measured), options.figure)
    created = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    calibration = result.calibration(
        base, created, f"fit of {options.loads.name}, {len(measured)} loads"
    )
    write_calibration(options.output, calibration, _header(options))
    Console().print(f"wrote {options.output}: calibration {calibration.id}", highlight=False)
    return 0


def _header(options: Options) -> str:
    return (
        f"./cube fit {options.loads.name} --layout {options.layout} --symmetry {options.symmetry}"
    )


def _show(result: Fit, rest: str) -> None:
    console = Console()
    console.print(
        f"coefficients, {result.structure.symmetry} symmetry, Pa per Pa; {rest}", highlight=False
    )
    table = Table()
    for name in ("coefficient", "value", "standard deviation"):
        table.add_column(name, justify="left" if name == "coefficient" else "right")
    for name, value in result.coefficients.items():
        known = math.isfinite(value)
        table.add_row(
            name,
            f"{value:+.5f}" if known else "open",
            f"{result.deviations[name]:.5f}" if known else "not determined",
        )
    console.print(table)
    console.print(
        "gains (average 1 over pads that the symmetry carries onto each other)", highlight=False
    )
    gains = Table()
    for name in ("pad", "gain", "standard deviation"):
        gains.add_column(name, justify="left" if name == "pad" else "right")
    for pad, gain, deviation in zip(
        result.structure.layout.pads, result.gain, result.gain_deviation, strict=True
    ):
        gains.add_row(pad, f"{gain:.5f}", f"{deviation:.5f}")
    console.print(gains)
    console.print(
        f"scatter {result.scale:.3g} × the stated noise; chi-square {result.chi2:.4g} for {result.dof} degrees of "
        f"freedom; held-out error {100 * result.held_out:.3g} % of the readings; {int(result.outliers.sum())} outliers",
        highlight=False,
    )
    for sentence in result.advice:
        console.print(sentence, style="red", highlight=False)


def _write_json(path: Path, result: Fit) -> None:
    data = {
        "coefficients": result.coefficients,
        "deviations": result.deviations,
        "gain": result.gain.tolist(),
        "gain_deviation": result.gain_deviation.tolist(),
        "scale": result.scale,
        "chi2": result.chi2,
        "dof": result.dof,
        "held_out": result.held_out,
        "outliers": np.argwhere(result.outliers).tolist(),
        "undetermined": list(result.undetermined),
        "advice": list(result.advice),
    }
    write_json(path, data)
