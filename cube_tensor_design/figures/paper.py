# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Pictures and numbers of docs/paper.md: figure 4 of the source paper, its experiments, a rod."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from cube_tensor_driver.config.output_files import write_json
from cube_tensor_driver.views.figures.style import save

from ..fem.fem import Progress
from ..paper.experiments import compute_figure_4, run_experiments
from ..paper.normal_fall import split_normal_fall
from ..paper.rod_parts import split_rod_signals
from ..paper.rod_shear import recover_rod_shear
from .deformation import draw_figure_4
from .experiments import draw_experiment, draw_rod_parts, draw_rod_shear

NEAR_PLACES = (1e-3, 2e-3, 3e-3)
"""Positions along x, in m from the cube's centre, of the rod whose force is the same with and
without the cube. Farther away the cube changes the force of a held rod by less than 20 %."""
PARTS = ("Fig. 4", "linear", "finite", "rod", "rod, held force", "shear")
"""Names of the parts of the work of `./cube paper`, in order."""


def save_paper(folder: Path, report: Progress) -> list[Path]:
    """Write pictures and paper.json into a folder, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []

    def save_picture(figure: Figure, name: str) -> None:
        written.append(folder / f"{name}.png")
        save(figure, written[-1])

    # Each picture is written as soon as it is there: the whole takes many minutes.
    report(0, 1, PARTS[0])
    save_picture(draw_figure_4(compute_figure_4()), "figure_4")
    numbers: dict[str, object] = {}
    for law in ("linear", "finite"):
        report_law = _report_part(report, law)
        results = run_experiments(finite=law == "finite", progress=report_law)
        for number, result in enumerate(results, 1):
            save_picture(draw_experiment(result, law), f"experiment_{number}_{law}")
            numbers[f"{result.name}, {law}"] = vars(result)
    # The last results are those of finite strain, in which P_normal falls.
    sheared = [result for result in results if result.name.startswith("b")]
    numbers["fall of P_normal"] = {one.name: vars(split_normal_fall(one)) for one in sheared}

    parts = split_rod_signals(progress=_report_part(report, "rod"))
    save_picture(draw_rod_parts(parts), "rod_parts")
    numbers["rod parts"] = {name: vars(one) for name, one in parts.items()}
    report_held = _report_part(report, "rod, held force")
    parts = split_rod_signals(
        places=NEAR_PLACES,
        held="force",
        progress=report_held,
    )
    numbers["rod parts, held force"] = {name: vars(one) for name, one in parts.items()}

    recovered = recover_rod_shear(progress=_report_part(report, "shear"))
    save_picture(draw_rod_shear(recovered), "rod_shear")
    numbers["rod shear"] = vars(recovered)
    written.append(folder / "paper.json")
    write_json(written[-1], numbers)
    return written


def _report_part(report: Progress, name: str) -> Progress:
    """Return a function that reports the progress of a part as progress of the whole."""
    before = PARTS.index(name)

    def report_part(done: float, total: float, what: str) -> None:
        report(before + done / total, len(PARTS), f"{name}: {what}")

    return report_part
