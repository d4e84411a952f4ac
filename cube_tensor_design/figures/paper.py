"""Pictures and numbers of docs/paper.md: figure 4 of the source paper, its experiments, a rod."""

from __future__ import annotations

from pathlib import Path

from cube_tensor_driver.config.output_files import write_json
from cube_tensor_driver.views.figures.style import save

from ..fem.fem import Progress
from ..paper.experiments import Experiment, experiments, figure_4
from ..paper.normal_fall import NormalFall, normal_fall
from ..paper.rod_parts import RodParts, rod_parts
from ..paper.rod_shear import RodShear, rod_shear
from .deformation import draw_figure_4
from .experiments import draw_experiment, draw_rod_parts, draw_rod_shear

NEAR = (1e-3, 2e-3, 3e-3)
"""Of the rod whose force is held, m: farther away the cube changes the force by less than 20 %."""
BEGIN_END = {
    "linear": (0.01, 0.17),
    "finite": (0.17, 0.59),
    "rod": (0.59, 0.69),
    "rod, held force": (0.69, 0.87),
    "shear": (0.87, 1.0),
}
"""When the parts begin and end, as measured parts of the whole time; before them comes Fig. 4."""


def save_paper(folder: Path, report: Progress) -> list[Path]:
    """Pictures and paper.json into a folder; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    report(0, 1, "Fig. 4")
    written = [folder / "figure_4.png"]
    save(draw_figure_4(figure_4()), written[0])
    numbers: dict[str, object] = {}
    for law in ("linear", "finite"):
        results = experiments(finite=law == "finite", progress=_part(report, law))
        for number, result in enumerate(results, 1):
            written.append(folder / f"experiment_{number}_{law}.png")
            save(draw_experiment(result, law), written[-1])
            numbers[f"{result.name}, {law}"] = _numbers(result)
    numbers["fall of P_normal"] = {
        result.name: _lists(normal_fall(result)) for result in results if result.name[0] == "b"
    }
    parts = rod_parts(progress=_part(report, "rod"))
    written.append(folder / "rod_parts.png")
    save(draw_rod_parts(parts), written[-1])
    numbers["rod parts"] = {name: _lists(one) for name, one in parts.items()}
    parts = rod_parts(places=NEAR, held="force", progress=_part(report, "rod, held force"))
    numbers["rod parts, held force"] = {name: _lists(one) for name, one in parts.items()}
    recovered = rod_shear(progress=_part(report, "shear"))
    written.append(folder / "rod_shear.png")
    save(draw_rod_shear(recovered), written[-1])
    numbers["rod shear"] = _lists(recovered)
    written.append(folder / "paper.json")
    write_json(written[-1], numbers)
    return written


def _part(report: Progress, name: str) -> Progress:
    """Progress of a part as progress of the whole."""
    begin, end = BEGIN_END[name]

    def report_part(done: float, total: float, what: str) -> None:
        report(begin + (end - begin) * done / total, 1, f"{name}: {what}")

    return report_part


def _lists(table: NormalFall | RodParts | RodShear) -> dict[str, object]:
    return {name: column.tolist() for name, column in vars(table).items()}


def _numbers(result: Experiment) -> dict[str, object]:
    names = ("displacement", "prototype", "upper", "pads", "recovered", "truth", "rotation")
    return {name: getattr(result, name).tolist() for name in names}
