"""`./cube torture`: a skin under a random mix of all faults, in processes of its own. The judge
compares every row that came with what was measured and what was done."""

from __future__ import annotations

import multiprocessing
import tempfile
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from cube_tensor_driver.core.errors import ConfigError
from cube_tensor_driver.demo.running import report
from cube_tensor_driver.processes.domain import own_domain
from cube_tensor_driver.processes.stop_signals import stop_event
from cube_tensor_driver.views.terminal.output import progress_bar

from ..checks.verdict import judge
from .mutations import MUTATIONS
from .skin import play

MUTATED_S = 10.0
"""How long a mutated torture lasts: long enough for each kind of fault and each deed but
restarts."""
RESTARTED_S = 16.0
"""The same, for mutations that show when the reconstruction starts again."""
LIMITS = {
    "unreadable": 0.0,
    "lost": 0.0,
    "wrong": 0.0,
    "repeated": 0.0,
    "miscounted": 0.0,
    "missing_tensors": 0.0,
    "wrong_tensors": 0.0,
    "unflagged": 0.0,
    "false_alarms": 0.0,
    "wrong_cube_messages": 0.0,
    "wrong_periods": 0.0,
    "deeds_failed": 0.0,
    "crashes": 0.0,
    "threads_leaked": 0.0,
    "rss_slope_mb_per_min": 5.0,
    "worst_reconnect_s": 3.0,
    "stamp_error_p50_ms": 0.3,
    "stamp_error_p90_ms": 1.5,
    "stamp_error_p99_ms": 10.0,
}
"""The most that each figure may be. On a busy host queues of DDS fill, and memory grows with them;
a leak of 200 bytes a message is 6 MB a minute."""


def run_torture(*, duration: float, seed: int = 0, json_path: Path | None = None) -> int:
    """Torture a skin for `duration` s with the mix of faults of a seed, and print the figures;
    returns the exit code, 0 when all figures are as they must be. CubeError: something does not
    start."""
    result = torture(duration, seed, stop_event())
    report(result, json_path)
    broken = failures(result)
    if broken:
        print(f"not as it must be: {', '.join(broken)}")
    return 1 if broken else 0


def run_mutations(name: str, *, seed: int = 0, json_path: Path | None = None) -> int:
    """Torture a mutated skin, and print what caught it; returns the exit code, 0 if it was caught.

    name: of one mutation; all: each in turn. ConfigError: there is no such mutation.
    """
    names = list(MUTATIONS) if name == "all" else [name]
    if not set(names) <= set(MUTATIONS):
        raise ConfigError(f"--mutate {name!r}, allowed: all, {', '.join(MUTATIONS)}")
    stop_event()  # ends the torture, whose error comes here
    results: dict[str, dict[str, Any]] = {}
    with progress_bar() as progress:
        for number, name in enumerate(names):
            progress(number, len(names), name)
            # Each in a process of its own: after 32 tortures in one process Fast DDS 2.14 brought
            # nothing to it any more, each time it was tried.
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
                figures = process.submit(_mutated_torture, name, seed).result()
            caught_by = failures(figures)
            results[name] = {
                "caught": bool(caught_by),
                "by": caught_by,
                "seconds": figures["seconds"],
            }
            by = f"caught by {', '.join(caught_by)}" if caught_by else "not caught"
            print(f"{name}: {by}, {figures['seconds']:g} s", flush=True)
    report({"mutations": results}, json_path)
    missed = [name for name, result in results.items() if not result["caught"]]
    if missed:
        print(f"not caught: {', '.join(missed)}")
    return 1 if missed else 0


def _mutated_torture(name: str, seed: int) -> dict[str, Any]:
    """All figures of the torture of one mutation."""
    duration = RESTARTED_S if MUTATIONS[name].needs_restart else MUTATED_S
    return torture(duration, seed, stop_event(), name)


def failures(result: dict[str, Any]) -> list[str]:
    """Names of the figures that are not as they must be."""
    return [name for name, limit in LIMITS.items() if (result[name] or 0) > limit]


def torture(
    duration: float, seed: int, interrupted: threading.Event, mutation: str = ""
) -> dict[str, Any]:
    """All figures. mutation: of the driver or the reconstruction; empty: none."""
    with own_domain(), tempfile.TemporaryDirectory(prefix="cube_torture_") as folder:
        played = play(duration, seed, Path(folder), interrupted, mutation)
        figures = judge(played.record, played.log)
    seconds = time.monotonic() - played.began_s
    return {
        "duration_s": duration,
        "seed": seed,
        "seconds": round(seconds, 1),
        **figures,
        **played.figures,
    }
