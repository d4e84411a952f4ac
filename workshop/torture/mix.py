"""The mix of a torture: faults of the hubs, and deeds done to the nodes, by time and seed."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import Any

import numpy as np

from cube_tensor_driver.simulation.faults import CUT_FAULTS, FRAME_FAULTS, PAD_FAULTS

HUBS, CUBES_PER_HUB, PADS, RATE = 4, 8, 8, 500.0
DEEDS = {
    "stall reconstruction": "stop the process for `seconds`, less than its queue holds",
    "stall subscriber": "stop another subscriber of stress for longer than its queue holds",
    "rate": "have the hubs sample `value` times a second",
    "tare": "tare the cubes of the hub whose load stays",
    "clear": "clear the tare",
    "restart reconstruction": "kill the process and start it again",
    "reconfigure reconstruction": "deactivate, clean up, configure and activate it",
    "cycle driver": "deactivate and activate it",
    "restart driver": "kill the process and start it again",
}
"""What is done to the nodes."""
ROUND_S = 30.0
ROUND: tuple[tuple[float, dict[str, Any]], ...] = (
    (0.6, {"kind": "hold", "link": "hub0", "seconds": 5.0}),
    (0.8, {"deed": "stall reconstruction", "seconds": 1.0}),
    (3.6, {"deed": "tare"}),
    (5.2, {"deed": "clear"}),
    (5.3, {"deed": "rate", "value": RATE / 2}),
    (6.4, {"deed": "rate", "value": RATE}),
    (8.2, {"kind": "hold", "link": "hub0", "seconds": 5.3}),
    (11.1, {"deed": "tare"}),
    (12.2, {"deed": "restart reconstruction"}),
    (16.0, {"deed": "clear"}),
    (17.5, {"deed": "reconfigure reconstruction"}),
    (19.5, {"deed": "cycle driver"}),
    (21.5, {"deed": "stall subscriber", "seconds": 3.0}),
    (25.5, {"deed": "restart driver"}),
)
"""What comes in each round, in s after its begin. The load stays for a tare 2.9 s before, because
a tare takes the last whole second of what has come, and a busy host is late. The rate does not
change then: where in the load a hub is depends on its period."""
ONCE = ("restart reconstruction", "restart driver")
"""Only in the first round: memory is judged by how it grows in the life of a process."""
HELD_HUB = 0
"""The hub whose load stays for the tare, and that nothing else happens to then."""
QUIET_S = (4.0, 7.0)
"""s before the begin of a tare's hold, and after it, in which that hub has no other fault."""
OPENING_HUB, OPENING_CUBES = 2, (3, 4, 2, 5, 1)
"""Where each fault of a pad is once before the first cut: cubes that the load moves enough."""
FIRST_CUT_S = 3.5
LAST_S = 3.5
"""No fault begins so shortly before the end."""


def schedule(duration: float, seed: int) -> Iterator[tuple[float, dict[str, Any]]]:
    """(time in s, event) in order. An event is a fault of a hub, with `kind`, or a deed, with
    `deed`.

    Harmed frames all the time, cuts of each link one after the other, broken pads, warm hubs; and
    the deeds of ROUND again and again.
    """
    random = np.random.default_rng(seed)
    coming: list[tuple[float, int, dict[str, Any]]] = []
    end = duration - LAST_S

    def add(at: float, **event: Any) -> None:
        heapq.heappush(coming, (round(at, 3), len(coming), event))

    def add_quietly(at: float, **fault: Any) -> None:
        """Unless it would disturb a tare."""
        if fault["link"] != f"hub{HELD_HUB}" or not _disturbs(at, fault.get("seconds", 0.0)):
            add(at, **fault)

    for start in np.arange(0.0, max(end, 0.1), ROUND_S).tolist():
        for after, event in ROUND:
            if start + after < end and (start == 0 or event.get("deed") not in ONCE):
                add(start + after, **event)
    at = 0.0
    while (at := at + random.exponential(0.15)) < duration:
        kind, hub = str(random.choice(FRAME_FAULTS)), int(random.integers(HUBS))
        add(at, kind=kind, link=f"hub{hub}", count=int(random.integers(1, 6)))
    for kind, cube in zip(PAD_FAULTS, OPENING_CUBES, strict=True):
        pad = int(random.integers(PADS))
        add(0.5, kind=kind, link=f"hub{OPENING_HUB}", cube=cube, pad=pad, seconds=1.8)
    add(1.5, kind="temperature", link="hub1", value=5.0, seconds=1.0)
    add(4.5, kind="temperature", link="hub1", value=0.0)
    # Each kind in turn, so that a short torture has them all.
    rounds = range(1 + int(duration))
    kinds = [kind for _ in rounds for kind in random.permutation(CUT_FAULTS).tolist()]
    for hub in range(HUBS):
        at = random.uniform(FIRST_CUT_S, FIRST_CUT_S + 3.0)
        while at < end:
            kind, seconds = kinds.pop(), random.uniform(0.3, 2.0)
            fault = {"kind": kind, "link": f"hub{hub}", "seconds": round(seconds, 3)}
            if kind == "drift":
                # Another crystal comes with another hub: the rate changes at a restart.
                ppm = round(random.uniform(-100, 100), 3)
                add_quietly(at, kind="drift", link=f"hub{hub}", value=ppm)
                fault["kind"] = "reset"
            elif kind == "step":
                fault["value"] = round(random.uniform(-0.5, 5.0), 3)
            elif kind == "wrap":
                fault["count"] = int(random.integers(100, 3000))
            add_quietly(at, **fault)
            at += seconds + random.uniform(4.0, 20.0)
    at = FIRST_CUT_S
    while (at := at + random.uniform(1.0, 4.0)) < end:
        add_quietly(
            at,
            kind=str(random.choice(PAD_FAULTS)),
            link=f"hub{random.integers(HUBS)}",
            cube=int(random.integers(CUBES_PER_HUB)),
            pad=int(random.integers(PADS)),
            seconds=round(random.uniform(0.5, 3.0), 3),
        )
    at = 0.0
    while (at := at + random.uniform(8.0, 25.0)) < end - 1:
        link = f"hub{random.integers(1, HUBS)}"
        value = round(random.uniform(1.0, 10.0), 2)
        add(at, kind="temperature", link=link, value=value, seconds=2.0)
        add(at + 3.0, kind="temperature", link=link, value=0.0)
    while coming:
        moment, _, event = heapq.heappop(coming)
        yield moment, event


def _disturbs(at: float, seconds: float) -> bool:
    """Whether a fault of the held hub would be near a tare."""
    holds = [after for after, event in ROUND if event.get("kind") == "hold"]
    before, after = QUIET_S
    return any(
        at < start + hold + after and at + seconds > start + hold - before
        for hold in holds
        for start in np.arange(0.0, at + ROUND_S + 10, ROUND_S).tolist()
    )
