# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Reprocessing of many bags into one folder, in parallel processes."""

from __future__ import annotations

import multiprocessing
import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from ...config.yaml import read_yaml, write_yaml
from ...core.errors import BagError, CubeError
from ..tables import PARTIAL_PREFIX, report_write_errors
from .job import Overrides, ReprocessJob, ReprocessResult, reprocess

if TYPE_CHECKING:
    from .contacts import ContactOptions

SUFFIXES = {
    "bag": "",
    "parquet": ".parquet",
    "csv": ".csv",
    "zarr": ".zarr",
}
"""Output format -> suffix of the file or folder with the reprocessed data."""

RECIPE_NAME = "reprocess.yaml"
"""Name of the file in the folder of the results that states their format, calibrations, tare and
settings of contacts."""


def make_jobs(
    bags: Sequence[Path],
    folder: Path,
    form: str,
    overrides: Overrides,
    contacts: ContactOptions | None = None,
) -> list[ReprocessJob]:
    """Return one job per bag, whose result has the name of the bag and the suffix of the format.

    Args:
        bags: Folders or files of the bags.
        folder: Folder of the results.
        form: Format of the results, a key of `SUFFIXES`.
        overrides: Calibrations and tare that replace those of the recordings.
        contacts: Options with which contacts are computed; None: no contacts are computed.

    Raises:
        BagError: Two bags have the same name, so that their results would be the same file.
    """
    # All results lie in one folder, so bags from different folders must have different names.
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
        ReprocessJob(
            bag,
            folder / f"{name}{SUFFIXES[form]}",
            form,
            overrides,
            contacts,
        )
        for name, bag in names.items()
    ]


def write_recipe(folder: Path, job: ReprocessJob) -> None:
    """Create the folder of the results, with a file `RECIPE_NAME` that states their options.

    The file prevents that an interrupted run is continued with other options.

    Args:
        folder: Folder of the results.
        job: One of the jobs, which all have the same options.

    Raises:
        BagError: The folder has results that were made with other options, or cannot be written.
    """
    overrides, contacts = job.overrides, job.contacts
    cubes = overrides.skin.cubes if overrides.skin else ()
    recipe: dict[str, object] = {
        "format": job.form,
        "calibration": overrides.calibration.id if overrides.calibration else None,
        "skin": {cube.name: cube.calibration.id for cube in cubes} or None,
        "tare_from_s": list(overrides.tare) if overrides.tare else None,
    }
    if contacts is not None:
        settings = asdict(contacts.settings)
        recipe["contacts"] = {**settings, "rate": contacts.rate}
    path = folder / RECIPE_NAME
    # A folder with this file but without results comes from a run that failed before its first
    # result. Then the file may be replaced.
    if path.exists() and has_results(folder):
        if read_yaml(path) != recipe:
            raise BagError(
                f"{folder} was made with other options ({path} says which); name another folder"
            )
        return
    with report_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_yaml(path, recipe, "How the bags of this folder were reprocessed.")


def has_results(folder: Path) -> bool:
    """Return whether a folder contains at least one complete result."""
    others = (RECIPE_NAME, PARTIAL_PREFIX)
    return any(not path.name.startswith(others) for path in folder.iterdir())


def remove_without_results(folder: Path) -> None:
    """Remove a folder of results, with incomplete ones, if it contains no complete result."""
    if folder.is_dir() and not has_results(folder):
        shutil.rmtree(folder, ignore_errors=True)


def reprocess_all(
    jobs: Sequence[ReprocessJob],
    executor: Executor,
) -> Iterator[tuple[ReprocessJob, ReprocessResult | CubeError]]:
    """Reprocess bags in parallel.

    Args:
        jobs: One job per bag.
        executor: Worker processes that do the jobs.

    Yields:
        Each job with its result or its error, in the order in which the jobs end.
    """
    futures = {executor.submit(reprocess, job): job for job in jobs}
    for future in as_completed(futures):
        try:
            yield futures[future], future.result()
        except CubeError as error:
            yield futures[future], error


def start_workers(wanted: int | None, jobs: int) -> Executor:
    """Return an executor with worker processes, which end when its `with` block ends.

    Args:
        wanted: Number of processes that the user gave; None: one per core of this machine.
        jobs: Number of jobs, which is the largest useful number of processes.
    """
    # With one process per core, further threads of numpy (OpenBLAS) would only compete for the
    # cores. The worker processes inherit this environment variable.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    count = max(1, min(wanted or os.cpu_count() or 1, jobs))
    # The processes are spawned, not forked, because numpy's threads do not survive a fork.
    return ProcessPoolExecutor(count, multiprocessing.get_context("spawn"))
