"""./cube fem: a response matrix computed, as tables, files and pictures."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from ..config.atomic_write import check_outputs
from ..config.calibration import write_calibration
from ..core.errors import ElasticError, LayoutError
from ..core.layout import Layout
from ..core.symmetry import default_modes, find_structure
from ..elastic.body import Body, strip_layout
from ..elastic.fem import Response, calibration_from_fem, compute_response
from ..plot.deformation import draw_loads
from ..plot.response import draw_convergence, draw_response
from ..plot.style import save
from ..research.paper import mode_deformations
from ..terminal.output import make_folder, progress_bar, write_json
from .layout import coefficient_counts, named_layout

_COLUMNS = 7  # modes in one table, so that it fits a terminal
_ROWS = 40  # coefficients shown; more are in the JSON file
_EXPLAINED = 1e-3  # of the response may be left out of a calibration by its coefficients


@dataclass(frozen=True)
class Options:
    """As on the command line; lengths in mm, young in Pa. None: not given."""

    space: bool = False
    layout: str | None = None
    symmetry: str | None = None
    plane: str | None = None
    width: float = 60.0
    height: float = 11.0
    side: float = 4.0
    young: float = 0.3e6
    poisson: float = 0.48
    rigid: bool = False
    pad: str | None = None
    pad_centre: float | None = None
    neglect: tuple[str, ...] = ()
    meshes: int = 3
    json: Path | None = None
    figures: Path | None = None
    output: Path | None = None


def run_fem(options: Options) -> int:
    """Compute a response matrix, show it, write what is asked for. CubeError: what is wrong, before
    any work."""
    layout = _layout(options)
    symmetry = options.symmetry or next(
        name for name, count in coefficient_counts(layout).items() if count
    )
    find_structure(layout, symmetry)
    default_modes(layout).index(options.neglect)
    body = _body(options, layout)
    check_outputs({"--json": options.json, "-o": options.output})
    make_folder("--figures", options.figures)
    console = Console()
    console.print(
        f"{_describe(body, layout)}; {layout.n_pads} pads, symmetry {symmetry}",
        highlight=False,
        soft_wrap=True,
    )
    with progress_bar() as report:
        result = compute_response(body, layout, symmetry, options.meshes, report)
    _show(console, result)
    if options.json is not None:
        write_json(options.json, result.to_dict())
    if options.figures is not None:
        save(draw_convergence(result), options.figures / "convergence.png")
        save(draw_response(result), options.figures / "response.png")
        if layout.planar:
            loads = draw_loads(layout, mode_deformations(body, layout))
            save(loads, options.figures / "loads.png")
        console.print(f"pictures in {options.figures}", highlight=False)
    if options.output is not None:
        _write_calibration(console, options, result)
    return 0


def _layout(options: Options) -> Layout:
    name = options.layout or ("cube" if options.space else "planar")
    layout = named_layout(name)
    if options.space and layout.planar:
        raise ElasticError(
            f"layout {layout.name!r} lies in a plane; leave out --3d, or take --layout cube"
        )
    d0 = options.side / 2
    width, centre = layout.pad_size, None if options.pad_centre is None else options.pad_centre / d0
    if options.pad == "half":
        if centre not in (None, 0.5):
            raise ElasticError(
                f"--pad half sets the pads' centres; leave out --pad-centre {options.pad_centre:g}"
            )
        width, centre = 1.0, 0.5
    elif options.pad is not None:
        width, centre = _millimetres(options.pad) / d0, 1.0 / d0 if centre is None else centre
    if centre is None:
        return layout
    try:
        return strip_layout(layout, width, centre)
    except LayoutError as error:
        where = f"pads {width * d0:g} mm wide, {centre * d0:g} mm from the middle of their faces"
        reach = (centre + width / 2) * d0
        why = (
            f"they reach to {reach:g} mm and the faces end at {d0:g} mm"
            if reach > d0
            else str(error)
        )
        raise ElasticError(f"{where}: {why}; change --pad or --pad-centre") from None


def _millimetres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not 0 < value < np.inf:
        raise ElasticError(f"--pad is {text!r}; it must be half, or a width in mm above 0")
    return value


def _body(options: Options, layout: Layout) -> Body:
    if options.plane is not None and not layout.planar:
        raise ElasticError(
            f"--plane {options.plane} is for layouts in a plane; {layout.name!r} is computed in space"
        )
    return Body(
        width=options.width * 1e-3,
        depth=options.width * 1e-3,
        height=options.height * 1e-3,
        side=options.side * 1e-3,
        young=options.young,
        poisson=options.poisson,
        cube_young=np.inf if options.rigid else Body.cube_young,
        plane=options.plane or "strain",
    )


def _describe(body: Body, layout: Layout) -> str:
    lengths = (body.width, body.height) if layout.planar else (body.width, body.depth, body.height)
    size = " x ".join(f"{1e3 * length:g}" for length in lengths)
    plane = f", plane {body.plane}" if layout.planar else ""
    cube = "rigid" if np.isinf(body.cube_young) else "steel"
    law = f"E {body.young / 1e6:g} MPa, nu {body.poisson:g}{plane}"
    return f"{cube} cube of {1e3 * body.side:g} mm in a body of {size} mm ({law})"


def _show(console: Console, result: Response) -> None:
    names = result.modes
    for start in range(0, len(names), _COLUMNS):
        title = "response, Pa per Pa; below, what the symmetry does not explain"
        table = Table(
            title=None if start else title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False
        )
        table.add_column("pad")
        modes = range(start, min(start + _COLUMNS, len(names)))
        for mode in modes:
            table.add_column(names[mode], justify="right")
        for number, (pad, row) in enumerate(zip(result.layout.pads, result.matrix, strict=True), 1):
            table.add_row(
                f"V{number} {pad}" if result.layout.planar else pad,
                *(f"{row[mode] + 0.0:.4f}" for mode in modes),
            )
        table.add_section()
        table.add_row(
            "left, %", *(f"{100 * result.mode_residual[names[mode]]:.2f}" for mode in modes)
        )
        console.print(table)
    rows = result.convergence
    table = Table(
        title="coefficients on meshes of so many unknowns",
        title_justify="left",
        box=SIMPLE_HEAD,
        pad_edge=False,
    )
    table.add_column("unknowns")
    for row in rows:
        table.add_column(str(row["unknowns"]), justify="right")
    table.add_column("last step", justify="right")
    for name in list(result.coefficients)[:_ROWS]:
        values = [row["coefficients"][name] for row in rows]
        step = (
            f"{100 * abs(values[-1] / values[-2] - 1):.2g} %"
            if len(rows) > 1 and values[-2]
            else ""
        )
        table.add_row(name, *(f"{value:.5f}" for value in values), step)
    table.add_section()
    changes = ("" if row["change"] is None else f"{100 * row['change']:.2g} %" for row in rows)
    table.add_row("change to the next", *changes)
    table.add_row("seconds", *(f"{row['seconds']:.1f}" for row in rows))
    console.print(table)
    if len(result.coefficients) > _ROWS:
        console.print(
            f"and {len(result.coefficients) - _ROWS} coefficients more, in the --json file"
        )
    console.print(
        f"symmetry {result.symmetry} leaves {100 * result.structure_residual:.3g} % of the response unexplained; "
        f"rank {result.rank} of {len(names)}; unobservable: {', '.join(result.unobservable) or 'nothing'}; "
        f"{result.seconds:.1f} s",
        highlight=False,
        soft_wrap=True,
    )


def _command(options: Options) -> str:
    """The command line that computes this, without the files that it writes."""
    flags = {"space": "3d", "pad_centre": "pad-centre"}
    words = ["./cube", "fem"]
    for item in fields(options):
        value = getattr(options, item.name)
        if value == item.default or item.name in ("json", "figures", "output"):
            continue
        words.append(f"--{flags.get(item.name, item.name)}")
        if value is not True:
            words += (
                map(str, value)
                if isinstance(value, tuple)
                else [f"{value:g}" if item.type == "float" else str(value)]
            )
    return shlex.join(words)


def _write_calibration(console: Console, options: Options, result: Response) -> None:
    whole = result.structure_residual > _EXPLAINED
    calibration = calibration_from_fem(
        result,
        whole_matrix=whole,
        neglect=options.neglect,
        source=f"computed by {_command(options)}",
    )
    strongest = float(np.abs(result.matrix[:, result.modes.index("zz")]).max())
    crushing = f"{calibration.modulus.max() / strongest / 1e3:.3g}"
    lines = [
        f"Made by: {_command(options)} -o {options.output}",
        f"The response is computed: {_describe(result.body, result.layout)}.",
        "Rest frequencies, beta and modulus are not: they are placeholders until the cube is tared and fitted.",
        f"With this modulus a uniform sigma_zz of -{crushing} kPa crushes a pad, which is where its law ends.",
    ]
    if options.neglect:
        lines.append(
            "The modes under neglect must be small: too few pads to tell them from the others."
        )
    write_calibration(options.output or Path(), calibration, "\n".join(lines))
    what = f"calibration {calibration.id}"
    if whole:
        what += f", with the whole matrix: symmetry {result.symmetry} does not explain it"
    console.print(f"wrote {options.output}: {what}", highlight=False, soft_wrap=True)
