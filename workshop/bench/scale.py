"""The picture of `./cube bench scale`: cost and latency over the number of cubes."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from cube_tensor_driver.views.figures.style import print_style

_CPU_KEYS = {
    "driver": ("cpu_driver_percent", "o-", "black"),
    "reconstruction": ("cpu_reconstruction_percent", "s-", "black"),
    "echo": ("echo_cpu_percent", "^:", "0.55"),
}
_NAMES = {
    "driver": "driver",
    "reconstruction": "reconstruction",
    "echo": "echo: the same messages, no work",
}
_LATENCY_KEYS = {
    "median": ("latency_p50_ms", "o-"),
    "99th percentile": ("latency_p99_ms", "s--"),
}


@print_style()
def draw_scale(rows: list[dict[str, Any]]) -> Figure:
    """CPU per frame and latency over the number of cubes; rows as `./cube bench skin` gives them.

    Echo is the floor: the same messages sent and received, with no work done on them.
    """
    figure = Figure(figsize=(8, 3.6))
    left, right = figure.subplots(1, 2)
    cubes = [row["cubes"] for row in rows]
    for name, (key, style, color) in _CPU_KEYS.items():
        used = [1e4 * row[key] / row["rate_hz"] for row in rows]
        left.plot(cubes, used, style, color=color, mfc="white", ms=5, label=_NAMES[name])
    left.set(
        xscale="log",
        xlabel="number of cubes",
        ylabel="CPU per scan / µs",
        title="cost of one scan of all cubes",
        ylim=(0, None),
    )
    left.legend()
    for name, (key, style) in _LATENCY_KEYS.items():
        latency = [row[key] for row in rows]
        right.plot(cubes, latency, style, color="black", mfc="white", ms=5, label=name)
    right.set(
        xscale="log",
        xlabel="number of cubes",
        ylabel="latency / ms",
        title="from reading the pads to receiving the tensor",
        ylim=(0, None),
    )
    for axis in (left, right):
        axis.set_xticks(cubes, [str(count) for count in cubes])
        axis.xaxis.minorticks_off()
    right.legend()
    return figure
