# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Mix of a torture: faults of the hubs and actions on the nodes, by time and seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np

from cube_tensor_driver.config.yaml import read_yaml
from cube_tensor_driver.simulation.faults import FRAME_FAULTS, PAD_FAULTS

from ..checks.record import CUT_FAULTS

HUBS = 4
"""Number of simulated hubs of the tortured skin."""

CUBES_PER_HUB = 8
"""Number of cubes on each hub of the tortured skin."""

PADS = 8
"""Number of pads of each cube of the tortured skin."""

RATE = 500.0
"""Sampling rate of all cubes of the tortured skin, in Hz."""

Event = dict[str, Any]
"""A fault of a hub, with the key `kind` as in `simulation.faults`, or an action on a node, with the
key `action`; other keys are its values."""

CYCLE_S = 30.0
"""Time, in seconds, after which the actions of `CYCLE` are repeated."""

CYCLE = cast("dict[float, Event]", read_yaml(Path(__file__).with_name("cycle.yaml")))
"""Events of each cycle, by time in seconds after its start."""

FIRST_CYCLE_ONLY = ("restart reconstruction", "restart driver")
"""Actions of the first cycle only. They end the life of a process, over which the growth of its
memory is measured."""

HELD_HUB = 0
"""Index of the hub whose load is kept constant ("hold") during a tare. It has no other faults near
that time."""

HELD_CUBES = tuple(range(HELD_HUB * CUBES_PER_HUB, (HELD_HUB + 1) * CUBES_PER_HUB))
"""Cubes of the hub whose load is held; these are tared."""

QUIET_BEFORE_S = 4.0
"""Time, in seconds, before a "hold" (the load of a hub is kept constant) in which the hub has no
other fault."""

QUIET_AFTER_S = 7.0
"""Time, in seconds, after the start of a "hold" (the load of a hub is kept constant) in which the
hub has no other fault."""

OPENING_HUB = 2
"""Hub on which each fault of a pad occurs once at the beginning, before the first cut."""

OPENING_CUBES = (3, 4, 2, 5, 1)
"""Numbers on `OPENING_HUB` of the cubes of which a pad has a fault at the beginning, one for each
kind of fault. The load moves these cubes enough for a stuck pad to be found."""

FIRST_CUT_S = 3.5
"""Time, in seconds after the start of a torture, of the earliest cut of a link."""

LAST_EVENT_S = 3.5
"""Length, in seconds, of the last part of a torture, in which no fault begins."""


def schedule(duration: float, seed: int) -> list[tuple[float, Event]]:
    """Return all events of a torture of `duration` seconds, each with its time in seconds.

    Frames are damaged all the time, links are cut one after the other, pads break, hubs get warm,
    and the actions of `CYCLE` are repeated.
    """
    # The order of these calls decides what each seed gives.
    mix = _Mix(duration, seed)
    mix.add_cycles()
    mix.add_frame_faults()
    mix.add_opening()
    for hub in range(HUBS):
        mix.add_cuts(hub)
    mix.add_pad_faults()
    mix.add_temperatures()
    # Equal times stay in the order in which they were added.
    return sorted(mix.events, key=lambda item: item[0])


class _Mix:
    """Draws the events of a torture. The same seed gives the same events."""

    def __init__(self, duration: float, seed: int) -> None:
        self.events: list[tuple[float, Event]] = []
        self._random = np.random.default_rng(seed)
        self._duration, self._end = duration, duration - LAST_EVENT_S
        # Kinds of the cuts to come. Each kind occurs once before any is repeated, so that a short
        # torture has all kinds.
        self._cuts: list[str] = []

    def _add(self, at: float, **event: Any) -> None:
        self.events.append((round(at, 3), event))

    def _add_fault(self, at: float, hub: int, **fault: Any) -> None:
        """Add a fault of a hub, unless it would disturb a tare. Damage to frames disturbs no
        tare."""
        disturbs = fault["kind"] not in FRAME_FAULTS and hub == HELD_HUB
        if not (disturbs and _disturbs_tare(at, fault.get("seconds", 0.0))):
            self._add(at, link=f"hub{hub}", **fault)

    def add_cycles(self) -> None:
        """Add the actions on the nodes, and the times at which the load of a hub is held."""
        # `np.arange` needs an end above 0 to give one cycle, also for a very short torture.
        starts = np.arange(0.0, max(self._end, 0.1), CYCLE_S)
        for start in starts.tolist():
            for after, event in CYCLE.items():
                # Cycles after the first do not end processes, see `FIRST_CYCLE_ONLY`.
                is_due = start == 0 or event.get("action") not in FIRST_CYCLE_ONLY
                if start + after < self._end and is_due:
                    self._add(start + after, **event)

    def add_frame_faults(self) -> None:
        """Damage frames all the time, on all hubs."""
        random, at = self._random, 0.0
        while (at := at + random.exponential(0.15)) < self._duration:
            kind = str(random.choice(FRAME_FAULTS))
            hub = int(random.integers(HUBS))
            self._add_fault(
                at,
                hub,
                kind=kind,
                count=int(random.integers(1, 6)),
            )

    def add_opening(self) -> None:
        """Add one fault of each kind to the pads of a hub, and a warm hub."""
        for kind, cube in zip(PAD_FAULTS, OPENING_CUBES, strict=True):
            pad = int(self._random.integers(PADS))
            self._add_fault(
                0.5,
                OPENING_HUB,
                kind=kind,
                cube=cube,
                pad=pad,
                seconds=1.8,
            )
        self._add_fault(1.5, 1, kind="temperature", value=5.0, seconds=1.0)
        # A hub keeps its temperature until the next fault of this kind, here back to normal.
        self._add_fault(4.5, 1, kind="temperature", value=0.0)
        rounds = range(1 + int(self._duration))
        # These are more kinds than needed, because several seconds pass between two cuts.
        self._cuts = [
            kind for _ in rounds for kind in self._random.permutation(CUT_FAULTS).tolist()
        ]

    def add_cuts(self, hub: int) -> None:
        """Add faults of `CUT_FAULTS`, which interrupt or restart a hub or disturb its clock.

        Args:
            hub: Index of the hub.
        """
        random = self._random
        at = random.uniform(FIRST_CUT_S, FIRST_CUT_S + 3.0)
        while at < self._end:
            kind = self._cuts.pop()
            seconds = random.uniform(0.3, 2.0)
            fault = {"kind": kind, "seconds": round(seconds, 3)}
            if kind == "drift":
                # A drift stands for a hub that was replaced by one with another crystal, so the
                # clock rate changes only together with a restart.
                ppm = round(random.uniform(-100, 100), 3)
                self._add_fault(at, hub, kind="drift", value=ppm)
                fault["kind"] = "reset"
            elif kind == "step":
                fault["value"] = round(random.uniform(-0.5, 5.0), 3)
            elif kind == "wrap":
                # The sample numbers of the hub begin again at 0 after this number of samples.
                fault["count"] = int(random.integers(100, 3000))
            self._add_fault(at, hub, **fault)
            # Between two cuts, the link delivers for at least 4 s.
            at += seconds + random.uniform(4.0, 20.0)

    def add_pad_faults(self) -> None:
        """Break pads of all hubs."""
        random, at = self._random, FIRST_CUT_S
        while (at := at + random.uniform(1.0, 4.0)) < self._end:
            kind = str(random.choice(PAD_FAULTS))
            self._add_fault(
                at,
                int(random.integers(HUBS)),
                kind=kind,
                cube=int(random.integers(CUBES_PER_HUB)),
                pad=int(random.integers(PADS)),
                seconds=round(random.uniform(0.5, 3.0), 3),
            )

    def add_temperatures(self) -> None:
        """Warm hubs, except the one whose load is held."""
        random, at = self._random, 0.0
        while (at := at + random.uniform(8.0, 25.0)) < self._end - 1:
            hub, value = int(random.integers(1, HUBS)), round(random.uniform(1.0, 10.0), 2)
            self._add_fault(
                at,
                hub,
                kind="temperature",
                value=value,
                seconds=2.0,
            )
            self._add_fault(at + 3.0, hub, kind="temperature", value=0.0)


def _disturbs_tare(at: float, seconds: float) -> bool:
    """Return whether a fault of the held hub would be too close to a tare."""
    holds = [after for after, event in CYCLE.items() if event.get("kind") == "hold"]
    # The fault may last into the next cycle.
    cycles = np.arange(0.0, at + CYCLE_S + 10, CYCLE_S)
    hold_s = np.add.outer(cycles, holds)
    begins_before = at < hold_s + QUIET_AFTER_S
    ends_after = at + seconds > hold_s - QUIET_BEFORE_S
    return bool((begins_before & ends_after).any())
