"""./cube pictures: the pictures of the documentation, made anew so that they stay true."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from ..core.errors import ConfigError, CubeError
from ..elastic.field_study import DEPTH, FORCE, KINDS, FieldStudy, field_study, flat_skin, truth
from ..elastic.surface import Surface
from ..files.share import share
from ..ros.children import Children
from ..ros.start import Process, skin_processes
from .plots import save

START_S, LOOK_S = 30.0, 120.0
"""How long the processes may take to start, and the browser to make its picture."""
PORT = 8088


def run_pictures(folder: Path) -> int:
    """Write field.png, field_error.png, field.json and, where there is Chromium, view.png; returns the exit code."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: {error.strerror}; name a folder that can be written") from None
    save(draw_field(), folder / "field.png")
    study = field_study()
    save(draw_study(study), folder / "field_error.png")
    table = {name: getattr(study, name).tolist() for name in ("pitches", "widths", "error", "position", "force")}
    (folder / "field.json").write_text(json.dumps(table) + "\n")
    print(f"wrote {folder}/field.png, field_error.png, field.json\n{tables_text(study)}")
    if not shutil.which("chromedriver"):
        print("no view.png: needs Chromium, apt-get install chromium chromium-driver", file=sys.stderr)
        return 0
    photograph(folder / "view.png")
    print(f"wrote {folder}/view.png")
    return 0


def draw_field(pitch: float = 0.010, width: float = 0.012) -> Figure:
    """One contact between the cubes: true pressure, and the field of values alone and of values and gradients."""
    skin, centre = flat_skin(pitch, 0.05), pitch * np.array([0.35, 0.25])
    side, load = 20, FORCE * np.array([0.3, 0.0, -1.0])
    surfaces = {"values alone": Surface(skin, DEPTH, side, False), "values and gradients": Surface(skin, DEPTH, side)}
    points = surfaces["values alone"].points
    maps = {"truth": -truth(points, width, load, centre)[:, 2]}
    values = truth(skin.position, width, load, centre)
    maps |= {name: surface.field(values).pressure for name, surface in surfaces.items()}
    figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), sharey=True)
    order = np.lexsort((points[:, 0].round(9), points[:, 1].round(9)))
    n = round(np.sqrt(len(points)))
    x, y = (1e3 * points[order, k].reshape(n, n) for k in (0, 1))
    top = 1e-3 * max(pressure.max() for pressure in maps.values())
    for axis, (name, pressure) in zip(axes, maps.items(), strict=True):
        kilo = 1e-3 * pressure[order].reshape(n, n)
        image = axis.pcolormesh(x, y, kilo, vmin=0, vmax=top, shading="nearest", rasterized=True)
        axis.contour(x, y, kilo, levels=np.arange(2, top, 4), colors="white", linewidths=0.5)
        axis.plot(*(1e3 * skin.position[:, :2].T), "s", ms=4, mfc="none", mec="0.8", label="cube")
        axis.plot(*(1e3 * centre), "r+", ms=9, label="load")
        rms = np.sqrt(((pressure - maps["truth"]) ** 2).mean() / (maps["truth"] ** 2).mean())
        axis.set(title=name if name == "truth" else f"{name}: {100 * rms:.0f} %", xlabel="x / mm", aspect="equal",
                 xlim=(-22, 22), ylim=(-22, 22))  # fmt: skip
        axis.grid(False)
    axes[0].set_ylabel("y / mm")
    axes[0].legend(fontsize=7, loc="lower left")
    figure.colorbar(image, ax=axes, label="pressure in the cubes' plane / kPa")
    return figure


def draw_study(study: FieldStudy) -> Figure:
    """Error of the field over pitch for each width, dashed without gradients: of whole cubes, and of planar ones."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), sharey=True)
    for kind, axis in zip((1, 2), axes, strict=True):
        for row, (width, marker) in enumerate(zip(study.widths, "os^Dv", strict=True)):
            style = {"color": str(0.7 * row / len(study.widths)), "marker": marker, "ms": 4, "lw": 1}
            axis.loglog(1e3 * study.pitches, study.error[row, :, 0], ls="--", mfc="none", **style)
            axis.loglog(1e3 * study.pitches, study.error[row, :, kind], label=f"{1e3 * width:.0f} mm", **style)
        axis.set(xlabel="pitch of the cubes / mm", title=("cubes that see every gradient", "planar cubes")[kind - 1])
        axis.set_xticks(1e3 * study.pitches, [f"{1e3 * pitch:.0f}" for pitch in study.pitches], minor=False)
        axis.minorticks_off()
    axes[0].set_ylabel("rms error / rms pressure")
    axes[0].legend(title="contact width\n(dashed: values alone)", fontsize=7, title_fontsize=7)
    return figure


def tables_text(study: FieldStudy) -> str:
    """Markdown: the field's error of each kind, place and force of a contact, cubes saved."""

    def table(cell: Callable[[int, int], str]) -> str:
        head = "| width \\ pitch | " + " | ".join(f"{1e3 * pitch:.0f} mm" for pitch in study.pitches) + " |"
        lines = [head, "|---" * (1 + len(study.pitches)) + "|"]
        for row, width in enumerate(study.widths):
            cells = " | ".join(cell(row, column) for column in range(len(study.pitches)))
            lines.append(f"| {1e3 * width:.0f} mm | {cells} |")
        return "\n".join(lines)

    error, position, force = study.error, 1e3 * study.position, study.force
    parts = [
        "field: " + " / ".join(KINDS),
        table(lambda i, j: " / ".join(f"{one:.2f}" for one in error[i, j])),
        "place, p95 in mm: all components / planar",
        table(lambda i, j: " / ".join(f"{one:.2g}" for one in position[i, j, 1:])),
        "force, rms: all components / planar",
        table(lambda i, j: " / ".join(f"{one:.2f}" for one in force[i, j, 1:])),
    ]
    for level in (0.1, 0.2, 0.3, 0.5):
        saved = study.cubes_saved(level)[:, 1:]
        parts.append(f"cubes saved at an error of {level}, per width, all / planar: {np.round(saved, 1).tolist()}")
    return "\n\n".join(parts)


def photograph(path: Path) -> None:
    """The browser view of the simulated demo skin under its load. CubeError: no picture came."""
    skin = share() / "config" / "skin_demo.yaml"
    with tempfile.TemporaryDirectory(prefix="cube_pictures_") as name, Children(Path(name)) as children:
        for process in skin_processes(skin, simulated_ports=Path(name) / "ports"):
            children.start(process)
        children.start(Process("view", "cube_tensor_driver.cli", False, arguments=("view", "--port", str(PORT))))
        until = time.monotonic() + START_S
        while "http://" not in children.log("view"):
            if time.monotonic() > until:
                raise CubeError(f"the view did not start within {START_S:g} s:\n{children.log('view')}")
            children.check()
            time.sleep(0.1)
        url = children.log("view").split()[0]
        # A tool of the repository, not of the package: only it needs a browser's driver.
        command = [sys.executable, str(share() / "tools" / "photograph.py"), url, str(path.resolve())]
        done = subprocess.run(command, capture_output=True, text=True, timeout=LOOK_S, check=False)
        if done.returncode:
            raise CubeError(f"no picture of {url}:\n{done.stderr[-500:]}")
