# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""`./cube torture`: a skin under a random mix of all faults, in processes of its own.

Every row that arrives is compared with what was measured and with what was done.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.demo.running import Interrupted
from cube_tensor_driver.processes.domain import use_own_domain
from cube_tensor_driver.processes.stop_signals import stop_event
from cube_tensor_driver.views.terminal.output import show_progress_bar

from ..checks.all_checks import check_all
from ..report import report
from .mutations import MUTATIONS, NEEDS_RESTART
from .play import play

MUTATED_S = 10.0
"""Duration, in seconds, of a torture with a mutation (deliberate error in a node): long enough for
each kind of fault and each action except the restarts."""

RESTARTED_S = 16.0
"""Duration, in seconds, of a torture with a mutation (deliberate error in a node) that shows only
when the reconstruction starts again."""

FORBIDDEN = (
    "unreadable",
    "lost",
    "wrong",
    "repeated",
    "miscounted",
    "missing_tensors",
    "wrong_tensors",
    "unflagged",
    "false_alarms",
    "wrong_periods",
    "actions_failed",
    "crashes",
    "threads_leaked",
)
"""Names of the figures of a torture that must be 0."""

LIMITS = {
    **dict.fromkeys(FORBIDDEN, 0.0),
    "rss_slope_mb_per_min": 5.0,
    "worst_reconnect_s": 3.0,
    "stamp_error_p50_ms": 0.3,
    "stamp_error_p90_ms": 1.5,
    "stamp_error_p99_ms": 10.0,
}
"""Largest allowed value of each checked figure of a torture, by its name.

On a busy host the queues of DDS fill, and memory grows with them. A leak of 200 bytes per message
would be 6 MB per minute.
"""


def run_torture(
    *,
    duration: float,
    seed: int = 0,
    json_path: Path | None = None,
) -> int:
    """Torture a skin and print the figures.

    Args:
        duration: Time in which faults begin, in seconds.
        seed: Seed of the mix of faults.
        json_path: File for the figures.

    Returns:
        Exit code, 0 if every figure is within its limit.

    Raises:
        CubeError: A process does not start, or ends.
    """
    result = torture(duration, seed, stop_event())
    report(result, json_path)
    broken = find_failures(result)
    if broken:
        print(f"above their limits: {', '.join(broken)}")
    return 1 if broken else 0


def run_mutations(
    name: str,
    *,
    seed: int = 0,
    json_path: Path | None = None,
) -> int:
    """Torture a mutated skin and print which figures show the mutation.

    Args:
        name: Name of one mutation, or "all" for each in turn.
        seed: Seed of the mix of faults.
        json_path: File for the results.

    Returns:
        Exit code, 0 if every mutation was found.

    Raises:
        ConfigError: There is no such mutation.
        Interrupted: A signal asked this process to end.
    """
    names = list(MUTATIONS) if name == "all" else [name]
    if not set(names) <= set(MUTATIONS):
        raise ConfigError(f"--mutate {name!r}, allowed: all, {', '.join(MUTATIONS)}")
    # Ctrl-C must not end this process at once: it ends the child process of the torture, whose
    # error `result` raises here.
    interrupted = stop_event()
    results: dict[str, dict[str, Any]] = {}
    with show_progress_bar() as progress:
        for number, name in enumerate(names):
            if interrupted.is_set():
                raise Interrupted("interrupted")
            progress(number, len(names), name)
            # Each runs in a process of its own: after 32 tortures in one process, Fast DDS 2.14
            # delivered nothing to it any more, each time it was tried.
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
                figures = process.submit(_torture_mutated, name, seed).result()
            found_by, seconds = find_failures(figures), figures["seconds"]
            results[name] = {
                "caught": bool(found_by),
                "by": found_by,
                "seconds": seconds,
            }
            outcome = f"caught by {', '.join(found_by)}" if found_by else "not caught"
            print(f"{name}: {outcome}, {seconds:g} s", flush=True)
    report({"mutations": results}, json_path)
    missed = [name for name, result in results.items() if not result["caught"]]
    if missed:
        print(f"not caught: {', '.join(missed)}")
    return 1 if missed else 0


def _torture_mutated(name: str, seed: int) -> dict[str, Any]:
    """Return the figures of a torture of a skin with one mutation."""
    duration = RESTARTED_S if name in NEEDS_RESTART else MUTATED_S
    return torture(duration, seed, stop_event(), name)


def find_failures(result: dict[str, Any]) -> list[str]:
    """Return the names of the figures that are above their limits."""
    return [name for name, limit in LIMITS.items() if (result[name] or 0) > limit]


def torture(
    duration: float,
    seed: int,
    interrupted: threading.Event,
    mutation: str = "",
) -> dict[str, Any]:
    """Play one torture and return all figures, see `play` for the arguments."""
    began_s = time.monotonic()
    # A skin that runs elsewhere on this machine must not be heard.
    with use_own_domain(), tempfile.TemporaryDirectory(prefix="cube_torture_") as folder:
        played = play(duration, seed, Path(folder), interrupted, mutation)
        checked = check_all(played.record, played.log, played.readings)
    return {
        "duration_s": duration,
        "seed": seed,
        "seconds": round(time.monotonic() - began_s, 1),
        **checked,
        **played.figures,
    }
