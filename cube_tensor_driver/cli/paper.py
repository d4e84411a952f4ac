"""./cube paper: all pictures and numbers of docs/paper.md but the study's."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from ..elastic.fem import Progress
from ..plot.deformation import draw_figure_4
from ..plot.experiments import draw_experiment, draw_rod_sweep
from ..plot.style import save
from ..research.paper import Experiment, experiments, figure_4, rod_sweep
from ..terminal.output import make_folder, progress_bar, write_json

_SHARES = {"linear": (0.01, 0.12), "finite": (0.12, 0.96), "rod": (0.96, 1.0)}
"""Of the time: where the parts begin and end, measured; before them comes Fig. 4."""


def run_paper(out: Path) -> int:
    """Pictures and paper.json into a folder."""
    make_folder("--out", out)
    with progress_bar() as report:

        def part(name: str) -> Progress:
            start, end = _SHARES[name]
            return lambda done, total, what: report(
                start + (end - start) * done / total, 1, f"{name}: {what}"
            )

        report(0, 1, "Fig. 4")
        made = [out / "figure_4.png"]
        save(draw_figure_4(figure_4()), made[0])
        numbers: dict[str, object] = {}
        for kind in ("linear", "finite"):
            for number, result in enumerate(
                experiments(finite=kind == "finite", progress=part(kind)), 1
            ):
                made.append(out / f"experiment_{number}_{kind}.png")
                save(draw_experiment(result), made[-1])
                numbers[f"{result.name}, {kind}"] = _numbers(result)
        table = rod_sweep(progress=part("rod"))
        made.append(out / "rod_positions.png")
        save(draw_rod_sweep(table), made[-1])
        numbers["rod positions"] = table
        made.append(out / "paper.json")
        write_json(made[-1], numbers)
    Console().print(
        f"wrote {', '.join(path.name for path in made)} into {out}", highlight=False, soft_wrap=True
    )
    return 0


def _numbers(result: Experiment) -> dict[str, object]:
    names = ("displacement", "prototype", "pads", "recovered", "truth")
    return {name: getattr(result, name).tolist() for name in names}
