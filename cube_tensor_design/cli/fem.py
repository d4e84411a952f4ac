"""./cube fem: what pads see by finite elements, as tables, files and pictures."""

from __future__ import annotations

import argparse
import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from cube_tensor_driver.cli.parser import Parser, number, positive
from cube_tensor_driver.core.defaults import POISSONS_RATIO, YOUNGS_MODULUS

if TYPE_CHECKING:
    from cube_tensor_driver.core.layout import Layout

    from ..fem.body import Body
    from ..fem.fem import Response

STEEL_PA = 200e9
UNEXPLAINED = 1e-3
"""Part of the response that coefficients may leave out of a calibration; beyond it the whole matrix
is written."""
WRITTEN = ("json", "figures", "output", "influence")
"""Options that change nothing in the result."""


def arguments(parser: Parser) -> None:
    parser.add_argument(
        "--3d",
        dest="space",
        action="store_true",
        help="compute in space, for 24 pads: takes minutes and up to 6 GB, with --surface 11 GB",
    )
    parser.add_argument(
        "--surface",
        action="store_true",
        help="bond the lower face to rigid ground and compute what the pads see of forces on the "
        "upper one, and what the cube says of balls there",
    )
    parser.add_argument(
        "--layout",
        metavar="NAME",
        help="quad, planar, cube, or a YAML file (default: planar; cube with --3d)",
    )
    parser.add_argument(
        "--symmetry",
        metavar="G",
        help="full, slab, mirrors or none (default: the first that the layout has)",
    )
    parser.add_argument(
        "--plane",
        choices=["strain", "stress"],
        help="plane strain or stress, of a layout in a plane (default: strain)",
    )
    parser.add_argument(
        "--width",
        type=positive,
        default=60.0,
        metavar="MM",
        help="width of the body along x, in space also along y, mm (default: %(default)g)",
    )
    parser.add_argument(
        "--height",
        type=positive,
        default=11.0,
        metavar="MM",
        help="height of the body along z, mm (default: %(default)g)",
    )
    parser.add_argument(
        "--side",
        type=positive,
        default=4.0,
        metavar="MM",
        help="side of the cube, mm (default: %(default)g)",
    )
    parser.add_argument(
        "--x",
        type=number,
        default=0.0,
        metavar="MM",
        help="place of the cube's middle along x, from that of the body, mm (default: 0)",
    )
    parser.add_argument(
        "--z",
        type=number,
        default=0.0,
        metavar="MM",
        help="the same along z, mm; off the middle a mesh is larger: in space twice for each of "
        "the two (default: 0)",
    )
    parser.add_argument(
        "--young",
        type=positive,
        default=YOUNGS_MODULUS,
        metavar="PA",
        help="Young's modulus of the body, Pa (default: %(default)g)",
    )
    parser.add_argument(
        "--poisson",
        type=number,
        default=POISSONS_RATIO,
        metavar="NU",
        help="Poisson's ratio of the body (default: %(default)g)",
    )
    parser.add_argument(
        "--rigid", action="store_true", help="take a rigid cube (default: steel, 200 GPa, 0.30)"
    )
    parser.add_argument(
        "--pad",
        metavar="half|MM",
        help="width of the pads: the halves of each face, or mm (default: that of the layout)",
    )
    parser.add_argument(
        "--pad-centre",
        type=positive,
        metavar="MM",
        help="distance of the pads' centres from the middle of the face, mm "
        "(default: 1 with --pad MM)",
    )
    parser.add_argument(
        "--neglect",
        nargs="+",
        default=[],
        metavar="MODE",
        help="modes that the calibration takes as zero",
    )
    parser.add_argument(
        "--meshes",
        type=int,
        choices=[1, 2, 3],
        default=3,
        help="number of meshes; fewer need less memory and show less of the convergence "
        "(default: %(default)s)",
    )
    parser.add_json()
    parser.add_output(
        "--figures", kind="folder", help="write pictures of convergence, response and each load"
    )
    parser.add_output("-o", "--output", kind="yaml", help="calibration file to write")
    parser.add_output(
        "--influence",
        help="with --surface --3d: write what the pads see of forces on the surface, for the "
        "contacts of a skin (.npz)",
    )


def run(options: argparse.Namespace) -> int:
    from cube_tensor_driver.config.output_files import write_json
    from cube_tensor_driver.core.errors import ElasticError
    from cube_tensor_driver.core.symmetry import default_modes, find_structure, largest_symmetry
    from cube_tensor_driver.views.terminal.interrupt import ends_at_once
    from cube_tensor_driver.views.terminal.output import progress_bar

    from ..fem.fem import compute_response
    from ..terminal.fem import show_response

    layout = padded_layout(options)
    symmetry = options.symmetry or largest_symmetry(layout)
    # Mistakes are named before any work.
    find_structure(layout, symmetry)
    default_modes(layout).index(options.neglect)
    body = body_of(options, layout)

    if options.influence is not None and not (options.surface and options.space):
        raise ElasticError(
            f"--influence {options.influence} is of a surface in space; add --surface --3d, or "
            "leave it out"
        )
    if options.surface:
        return run_surface(options, body, layout)

    print(f"{describe(body, layout)}; {layout.n_pads} pads, symmetry {symmetry}", flush=True)
    with ends_at_once(), progress_bar() as report:
        result = compute_response(body, layout, symmetry, options.meshes, report)
    show_response(result)
    if options.json is not None:
        write_json(options.json, result.to_dict())
    if options.figures is not None:
        draw(result, options.figures)
    if options.output is not None:
        write(options, result)
    return 0


def run_surface(options: argparse.Namespace, body: Body, layout: Layout) -> int:
    from cube_tensor_driver.config.output_files import write_json
    from cube_tensor_driver.core.errors import ElasticError
    from cube_tensor_driver.mechanics.influence_file import write_influence
    from cube_tensor_driver.views.figures.style import save
    from cube_tensor_driver.views.terminal.interrupt import ends_at_once
    from cube_tensor_driver.views.terminal.output import progress_bar

    from ..figures.influence import draw_influence
    from ..studies.surface_study import study_surface
    from ..terminal.surface_study import show_surface

    if options.output is not None:
        raise ElasticError(
            f"-o {options.output} is for a calibration, which --surface does not make; leave out "
            "one of them, or write the tables with --json or --influence"
        )
    print(f"{describe(body, layout)} on rigid ground; {layout.n_pads} pads", flush=True)
    with ends_at_once(), progress_bar() as report:
        study = study_surface(body, layout, options.meshes, options.neglect, report)
    show_surface(study)
    if options.json is not None:
        write_json(options.json, study.to_dict())
    if options.figures is not None:
        options.figures.mkdir(parents=True, exist_ok=True)
        picture = draw_influence(study.influence, layout, body.side / 2)
        save(picture, options.figures / "influence.png")
        print(f"picture in {options.figures}")
    if options.influence is not None:
        write_influence(options.influence, study.influence, command_of(options))
        print(f"wrote {options.influence}")
    return 0


def padded_layout(options: argparse.Namespace) -> Layout:
    """The layout with the pads that are asked for. ElasticError: they do not fit."""
    from cube_tensor_driver.config.calibration import named_layout
    from cube_tensor_driver.core.errors import ElasticError, LayoutError

    from ..fem.body import strip_layout

    layout = named_layout(options.layout or ("cube" if options.space else "planar"))
    if options.space and layout.planar:
        raise ElasticError(
            f"layout {layout.name!r} lies in a plane; leave out --3d, or take --layout cube"
        )
    width_mm, centre_mm = pad_geometry(options, layout)
    if centre_mm is None:
        return layout
    d0_mm = options.side / 2
    try:
        return strip_layout(layout, width_mm / d0_mm, centre_mm / d0_mm)
    except LayoutError as error:
        reach_mm = centre_mm + width_mm / 2
        reason = str(error)
        if reach_mm > d0_mm:
            reason = f"they reach to {reach_mm:g} mm and the faces end at {d0_mm:g} mm"
        raise ElasticError(
            f"pads {width_mm:g} mm wide, {centre_mm:g} mm from the middle of their faces: "
            f"{reason}; change --pad or --pad-centre"
        ) from None


def pad_geometry(options: argparse.Namespace, layout: Layout) -> tuple[float, float | None]:
    """Width of the pads and distance of their centres from the middle of the face, mm.

    None: neither is asked for, they stay where the layout has them.
    """
    from cube_tensor_driver.core.errors import ElasticError

    d0_mm, centre_mm = options.side / 2, options.pad_centre
    if options.pad is None:
        return layout.pad_size * d0_mm, centre_mm
    if options.pad == "half":
        if centre_mm not in (None, d0_mm / 2):
            raise ElasticError(
                f"--pad half sets the pads' centres; leave out --pad-centre {centre_mm:g}"
            )
        return d0_mm, d0_mm / 2
    try:
        width_mm = float(options.pad)
    except ValueError:
        width_mm = math.nan
    if not 0 < width_mm < math.inf:
        raise ElasticError(f"--pad is {options.pad!r}; it must be half, or a width in mm above 0")
    return width_mm, 1.0 if centre_mm is None else centre_mm


def body_of(options: argparse.Namespace, layout: Layout) -> Body:
    """ElasticError: no such body can be computed."""
    from cube_tensor_driver.core.errors import ElasticError

    from ..fem.body import Body

    if options.plane is not None and not layout.planar:
        raise ElasticError(
            f"--plane {options.plane} is for layouts in a plane; "
            f"{layout.name!r} is computed in space"
        )
    return Body(
        width=options.width * 1e-3,
        depth=options.width * 1e-3,
        height=options.height * 1e-3,
        side=options.side * 1e-3,
        young=options.young,
        poisson=options.poisson,
        cube_young=math.inf if options.rigid else STEEL_PA,
        plane=options.plane or "strain",
        x=options.x * 1e-3,
        z=options.z * 1e-3,
    )


def describe(body: Body, layout: Layout) -> str:
    lengths = [body.width, body.height]
    plane = f", plane {body.plane}"
    if not layout.planar:
        lengths.insert(1, body.depth)
        plane = ""
    size = " x ".join(f"{1e3 * length:g}" for length in lengths)
    cube = "rigid" if math.isinf(body.cube_young) else "steel"
    where = ""
    if body.x or body.z:
        where = f", {1e3 * body.x:g} mm along x and {1e3 * body.z:g} mm along z off its middle"
    law = f"E {body.young / 1e6:g} MPa, nu {body.poisson:g}{plane}"
    return f"{cube} cube of {1e3 * body.side:g} mm in a body of {size} mm{where} ({law})"


def command_of(options: argparse.Namespace) -> str:
    """The command line that computes the same, without what is default and what it writes."""
    parser = Parser()
    arguments(parser)
    words = ["./cube", "fem"]
    for name, default in vars(parser.parse_args([])).items():
        value = getattr(options, name)
        if value == default or name in (*WRITTEN, "outputs"):
            continue
        words.append("--3d" if name == "space" else f"--{name.replace('_', '-')}")
        if isinstance(value, float):
            words.append(f"{value:g}")
        elif isinstance(value, list):
            words += value
        elif value is not True:
            words.append(str(value))
    return shlex.join(words)


def draw(result: Response, folder: Path) -> None:
    """Pictures of convergence and response, and of the loads of a layout in a plane."""
    from cube_tensor_driver.views.figures.style import save

    from ..figures.deformation import draw_loads
    from ..figures.response import draw_convergence, draw_response
    from ..paper.experiments import mode_deformations

    folder.mkdir(parents=True, exist_ok=True)
    save(draw_convergence(result), folder / "convergence.png")
    save(draw_response(result), folder / "response.png")
    if result.layout.planar:
        loads = draw_loads(result.layout, mode_deformations(result.body, result.layout))
        save(loads, folder / "loads.png")
    print(f"pictures in {folder}")


def write(options: argparse.Namespace, result: Response) -> None:
    """The calibration file, with what it holds and does not hold in its first lines."""
    from cube_tensor_driver.config.calibration import write_calibration

    from ..fem.fem import calibration_from_fem

    command = command_of(options)
    whole = result.structure_residual > UNEXPLAINED
    calibration = calibration_from_fem(
        result, whole_matrix=whole, neglect=options.neglect, source=f"computed by {command}"
    )
    strongest = float(abs(result.matrix[:, result.modes.index("zz")]).max())
    crushing_kpa = calibration.modulus.max() / strongest / 1e3
    lines = [
        f"Made by: {command} -o {options.output}",
        f"The response is computed: {describe(result.body, result.layout)}.",
        "Rest frequencies, beta and modulus are not: they are placeholders until the cube is tared"
        " and fitted.",
        f"With this modulus a uniform sigma_zz of -{crushing_kpa:.3g} kPa crushes a pad, which is"
        " where its law ends.",
    ]
    if options.neglect:
        lines.append(
            "The modes under neglect must be small: too few pads to tell them from the others."
        )
    write_calibration(options.output, calibration, "\n".join(lines))
    what = f"calibration {calibration.id}"
    if whole:
        what += f", with the whole matrix: symmetry {result.symmetry} does not explain it"
    print(f"wrote {options.output}: {what}")
