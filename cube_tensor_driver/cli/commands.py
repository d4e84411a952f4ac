"""What each command of the command line calls. Imports happen inside: --help works without the
environment."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def demo(options: argparse.Namespace) -> int:
    from ..trials.demo import Options, run_demo

    duration = options.duration
    if duration is None and (options.headless or options.json or options.figure):
        duration = 10.0
    return run_demo(
        Options(
            options.config,
            options.cubes,
            options.rate,
            duration,
            options.headless,
            options.json,
            options.view,
            options.load,
            options.figure,
        )
    )


def config_grid(options: argparse.Namespace) -> int:
    from ..config.grid import grid
    from ..config.yaml import write_yaml

    skin = grid(
        options.name,
        nx=options.nx,
        ny=options.ny,
        pitch=options.pitch,
        links=options.links,
        calibration=options.calibration,
        layout=options.layout,
        rate=options.rate,
        port=options.port,
    )
    text = f"{options.nx} x {options.ny} cubes, {1e3 * options.pitch:g} mm apart, on {options.links} links"
    write_yaml(options.output, skin, f"{text}. docs/config.md describes the keys.")
    print(f"wrote {options.output}: {text}")
    return 0


def config_check(options: argparse.Namespace) -> int:
    from collections import Counter

    from ..config.skin import check_skin

    skin, mistakes = check_skin(options.file)
    if skin is None:
        print(
            "\n".join(f"cube: {options.file}: {mistake}" for mistake in mistakes), file=sys.stderr
        )
        return 1
    layouts = Counter(cube.calibration.layout.name for cube in skin.cubes)
    kinds = ", ".join(f"{count} {name}" for name, count in layouts.items())
    rate = "as the hubs have it" if skin.rate is None else f"{skin.rate:g} Hz"
    print(
        f"{options.file}: skin {skin.name}, {kinds} on {len(skin.links)} links, {rate}: nothing wrong"
    )
    return 0


def urdf(options: argparse.Namespace) -> int:
    from ..config.skin import read_skin
    from ..config.urdf import skin_urdf

    print(skin_urdf(read_skin(options.file)), end="")
    return 0


def torture(options: argparse.Namespace) -> int:
    from ..trials.torture import Options, run_torture

    return run_torture(Options(options.duration, options.seed, options.json))


def inject(options: argparse.Namespace) -> int:
    from ..simulation.inject import inject

    inject(options.ports, options.fault)
    return 0


def layout(options: argparse.Namespace) -> int:
    from .layout import run_layout

    figure = options.figure or Path(f"{Path(options.name).stem}.png")
    return run_layout(options.name, options.symmetry, options.calibration, options.json, figure)


def fit(options: argparse.Namespace) -> int:
    from .fit import Options, run_fit

    figure = options.figure or options.output.with_suffix(".png")
    return run_fit(
        Options(
            options.loads,
            options.layout,
            options.symmetry,
            options.output,
            options.base,
            options.area,
            options.uid,
            figure,
            options.json,
            options.reference,
            options.cube,
        )
    )


def fem(options: argparse.Namespace) -> int:
    from .fem import Options, run_fem

    given = {name: value for name, value in vars(options).items() if name not in ("command", "run")}
    return run_fem(Options(**given | {"neglect": tuple(given.get("neglect", ()))}))


def study(options: argparse.Namespace) -> int:
    from .study import run_study

    return run_study(options.json, options.figure)


def paper(options: argparse.Namespace) -> int:
    from .paper import run_paper

    return run_paper(options.out)


def bench(options: argparse.Namespace) -> int:
    if options.what == "decode":
        from ..trials.bench_decode import bench_decode

        return bench_decode(options.json)
    from ..trials import bench

    if options.what == "pipeline":
        return bench.bench_pipeline(options.cubes, options.json)
    if options.what == "echo":
        return bench.bench_echo(options.cubes, options.rate, options.duration, options.json)
    if options.what == "skin":
        return bench.bench_skin(
            options.cubes,
            options.rate,
            options.duration,
            options.publish_period,
            options.composed,
            options.json,
        )
    return bench.bench_scale(
        options.counts, options.rate, options.duration, options.json, options.figure
    )


def record(options: argparse.Namespace) -> int:
    from .record import Options, run_record

    return run_record(
        Options(
            options.output,
            options.topics,
            options.duration,
            options.storage,
            round((options.split_size or 0) * 1e6),
            options.split_time or 0.0,
        )
    )


def replay(options: argparse.Namespace) -> int:
    from .replay import Options, run_replay

    return run_replay(
        Options(
            options.bag,
            options.rate,
            options.loop,
            options.start,
            options.clock,
            options.stress,
            options.view,
        )
    )


def reprocess(options: argparse.Namespace) -> int:
    from .reprocess import Options, run_reprocess

    tare = tuple(options.tare_from) if options.tare_from else None
    return run_reprocess(
        Options(
            options.bags,
            options.output,
            options.format,
            options.calibration,
            options.skin,
            tare,
            options.jobs,
            options.scheduler,
        )
    )


def plot(options: argparse.Namespace) -> int:
    from ..bags.read import Bag
    from ..plot.style import save
    from ..plot.time_series import cube_series, draw_series

    with Bag(options.bag) as bag:
        series = cube_series(bag, options.cube, options.start, options.to)
    save(draw_series(series, options.bag.resolve().name), options.output)
    print(f"wrote {options.output}: cube {series.name}, {len(series.seconds)} samples")
    return 0


def bag_info(options: argparse.Namespace) -> int:
    from .bag import run_info

    return run_info(options.bag)


def bag_repair(options: argparse.Namespace) -> int:
    from .bag import run_repair

    return run_repair(options.bag)


def view(options: argparse.Namespace) -> int:
    from ..browser.viewer import run_view

    return run_view(options.port, options.depth)


def pictures(options: argparse.Namespace) -> int:
    from .pictures import run_pictures

    return run_pictures(options.output)


def docs(options: argparse.Namespace) -> int:
    """Sphinx, every warning an error."""
    command = ["sphinx", "-W", "--keep-going", "-q", "docs", str(options.output)]
    return subprocess.run([sys.executable, "-m", *command], cwd=ROOT, check=False).returncode


def test(options: argparse.Namespace) -> int:
    os.chdir(ROOT)
    os.execv(sys.executable, [sys.executable, "-m", "pytest", *(options.arguments or ["test"])])


def lint(options: argparse.Namespace) -> int:
    commands = (["ruff", "check", "."], ["ruff", "format", "--check", "."], ["mypy"])
    return max(
        subprocess.run([sys.executable, "-m", *command], cwd=ROOT, check=False).returncode
        for command in commands
    )
