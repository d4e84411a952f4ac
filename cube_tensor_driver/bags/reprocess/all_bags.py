"""Many bags reprocessed into a folder: in processes here, or on a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ...config.yaml import read_yaml, write_yaml
from ...core.errors import BagError, ConfigError, CubeError
from .contacts import ContactsOverTime
from .job import PARTIAL, Overrides, ReprocessJob, ReprocessResult, reprocess

SUFFIXES = {
    "bag": "",
    "parquet": ".parquet",
    "csv": ".csv",
    "zarr": ".zarr",
}
"""Suffix of the output, by its format."""

RECIPE = "reprocess.yaml"
"""File in the folder of the results that states how they were made."""


def make_jobs(
    bags: Sequence[Path],
    folder: Path,
    form: str,
    overrides: Overrides,
    contacts: ContactsOverTime | None = None,
) -> list[ReprocessJob]:
    """Make one job per bag; its result has the name of the bag.

    Args:
        bags: The bags.
        folder: Folder of the results.
        form: Format of the results, a key of `SUFFIXES`.
        overrides: What differs from the recordings.
        contacts: How contacts are computed; None: not at all.

    Raises:
        BagError: Two bags have the same name.
    """
    # Results stand side by side in one folder, whatever folders the bags come from.
    names: dict[str, Path] = {}
    for bag in bags:
        path = bag.resolve()
        name = path.stem if path.is_file() else path.name
        if name in names:
            raise BagError(
                f"{names[name]} and {bag} would both become {name}; reprocess them into two folders"
            )
        names[name] = bag
    return [
        ReprocessJob(bag, folder / f"{name}{SUFFIXES[form]}", form, overrides, contacts)
        for name, bag in names.items()
    ]


def write_recipe(
    folder: Path,
    form: str,
    overrides: Overrides,
    contacts: ContactsOverTime | None = None,
) -> None:
    """Create the folder and note how its results are made, so that a restart continues alike.

    Arguments are those of `make_jobs`.

    Raises:
        BagError: Results in the folder were made another way, or it cannot be written.
    """
    cubes = overrides.skin.cubes if overrides.skin else ()
    recipe: dict[str, Any] = {
        "format": form,
        "calibration": overrides.calibration.id if overrides.calibration else None,
        "skin": {cube.name: cube.calibration.id for cube in cubes} or None,
        "tare_from_s": list(overrides.tare) if overrides.tare else None,
    }
    if contacts is not None:
        settings = asdict(contacts.settings)
        recipe["contacts"] = {**settings, "rate": contacts.rate}
    path = folder / RECIPE
    # A recipe without results is of a run that failed at once: it may be replaced.
    if path.exists() and has_results(folder):
        if read_yaml(path) != recipe:
            raise BagError(
                f"{folder} was made with other options ({path} says which); name another folder"
            )
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BagError(f"{folder}: {error.strerror}; name a folder that can be written") from None
    write_yaml(path, recipe, "How the bags of this folder were reprocessed.")


def has_results(folder: Path) -> bool:
    """Return whether a folder of results has any."""
    names = {path.name for path in folder.iterdir()}
    return bool(names - {RECIPE, PARTIAL})


def remove_without_results(folder: Path) -> None:
    """Remove a folder in which no result was completed, with what was begun in it."""
    if folder.is_dir() and not has_results(folder):
        shutil.rmtree(folder, ignore_errors=True)


def reprocess_all(
    jobs: Sequence[ReprocessJob],
    executor: Executor,
) -> Iterator[tuple[ReprocessJob, ReprocessResult | CubeError]]:
    """Do jobs in parallel and yield each, as it ends, with its result or its error."""
    futures = {executor.submit(reprocess, job): job for job in jobs}
    for future in as_completed(futures):
        try:
            yield futures[future], future.result()
        except CubeError as error:
            yield futures[future], error


@contextmanager
def workers(count: int, scheduler: str | None = None) -> Iterator[Executor]:
    """Provide worker processes.

    Args:
        count: Number of processes on this machine.
        scheduler: Address of a Dask cluster to use instead; None: this machine.

    Raises:
        ConfigError: There is no scheduler at the address.
        ModuleNotFoundError: `distributed` is not installed.
    """
    if scheduler is None:
        # A process per core needs no threads beside it. The processes inherit it.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # Spawned, not forked: numpy's threads do not survive a fork.
        with ProcessPoolExecutor(count, multiprocessing.get_context("spawn")) as executor:
            yield executor
        return
    from distributed import Client

    try:
        client = Client(scheduler, timeout="5s")  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"--scheduler {scheduler}: {error}; name a running scheduler, tcp://host:8786"
        ) from None
    with client:
        yield client.get_executor()  # type: ignore[no-untyped-call]


def useful_workers(wanted: int | None, jobs: int) -> int:
    """Return the number of workers: as wanted (None: one per core), but at most one per job."""
    cores = os.cpu_count() or 1
    return max(1, min(wanted or cores, jobs))
