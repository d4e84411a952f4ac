"""./cube reprocess: bags through the pipeline again, in parallel, here or on a Dask cluster. ROS
does not run."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from ..bags.reprocess import Change, Job, reprocess
from ..config.calibration import find_calibration, read_calibration
from ..config.skin import read_skin
from ..config.yaml import read_yaml, write_yaml
from ..core.errors import BagError, ConfigError, CubeError

SUFFIX = {"bag": "", "parquet": ".parquet", "csv": ".csv"}
RECIPE = "reprocess.yaml"


@dataclass(frozen=True)
class Options:
    """As on the command line; None: not given. form: bag, parquet or csv."""

    bags: list[Path]
    output: Path
    form: str
    calibration: str | None
    skin: Path | None
    tare: tuple[float, float] | None
    jobs: int | None
    scheduler: str | None


def run_reprocess(options: Options) -> int:
    """Reprocess what is not there yet; 1 if a bag could not be. CubeError: nothing was begun."""
    change = _change(options)
    jobs = _jobs(options, change)
    _remember(options, change)
    console = Console(stderr=True, highlight=False)
    waiting = [job for job in jobs if not job.output.exists()]
    if len(waiting) < len(jobs):
        console.print(
            f"{len(jobs) - len(waiting)} of {len(jobs)} bags are there already in {options.output}"
        )
    failed = 0
    with _executor(options, len(waiting)) as executor, Progress(console=console) as progress:
        task = progress.add_task("reprocessing", total=len(waiting))
        futures = {executor.submit(reprocess, job): job for job in waiting}
        for future in as_completed(futures):
            try:
                done = future.result()
                console.print(
                    f"{futures[future].output}: {done.messages} messages, {done.rows} rows, {done.seconds:.1f} s"
                )
            except CubeError as error:
                failed += 1
                console.print(f"cube: {error}", style="red", markup=False)
            progress.advance(task)
    if failed:
        console.print(f"{failed} of {len(jobs)} bags could not be reprocessed", style="red")
    return 1 if failed else 0


def _change(options: Options) -> Change:
    if options.calibration is not None and options.skin is not None:
        raise ConfigError("found both --calibration and --skin; give one")
    if options.tare is not None and not 0 <= options.tare[0] < options.tare[1]:
        raise ConfigError(
            f"--tare-from {options.tare[0]:g} {options.tare[1]:g}: needed is 0 <= T0 < T1, in s"
        )
    calibration = options.calibration and read_calibration(
        find_calibration(options.calibration, Path())
    )
    return Change(
        calibration or None, read_skin(options.skin) if options.skin else None, options.tare
    )


def _jobs(options: Options, change: Change) -> list[Job]:
    names: dict[str, Path] = {}
    for bag in options.bags:
        path = bag.resolve()
        name = path.stem if path.is_file() else path.name
        if name in names:
            raise BagError(
                f"{names[name]} and {bag} would both become {name}; reprocess them into two folders"
            )
        names[name] = bag
    return [
        Job(bag, options.output / f"{name}{SUFFIX[options.form]}", options.form, change)
        for name, bag in names.items()
    ]


def _remember(options: Options, change: Change) -> None:
    """Write down how the folder was made, so that a restart does not mix two ways. BagError: it was
    another way."""
    cubes = change.skin.cubes if change.skin else ()
    recipe: dict[str, Any] = {
        "format": options.form,
        "calibration": change.calibration.id if change.calibration else None,
        "skin": {cube.name: cube.calibration.id for cube in cubes} or None,
        "tare_from_s": list(change.tare) if change.tare else None,
    }
    path = options.output / RECIPE
    if path.exists():
        if read_yaml(path) != recipe:
            raise BagError(
                f"{options.output} was made with other options ({path} says which); name another folder"
            )
        return
    try:
        options.output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BagError(
            f"{options.output}: {error.strerror}; name a folder that can be written"
        ) from None
    write_yaml(path, recipe, "How the bags of this folder were reprocessed.")


@contextmanager
def _executor(options: Options, count: int) -> Iterator[Executor]:
    if options.scheduler is None:
        workers = max(1, min(options.jobs or os.cpu_count() or 1, count))
        # Spawned, not forked: numpy's threads do not survive a fork.
        with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as executor:
            yield executor
        return
    from distributed import Client

    try:
        client = Client(options.scheduler, timeout="5s")
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--scheduler {options.scheduler}: {error}; name a running scheduler, tcp://host:8786"
        ) from None
    with client:
        yield client.get_executor()
