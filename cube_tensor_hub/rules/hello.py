# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rules of HELLO: H1 to H5."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from statistics import mode

import numpy as np

from cube_tensor_driver.core.layout import MAX_PADS
from cube_tensor_driver.device.wire.protocol import Ack, Command, Hello, Sample, Stats

from ..rule import RuleResult, enter_untried, report_failed, report_not_tried, report_passed, rule
from ..transcript import CheckStep, Heard, Transcript

MAX_BEHIND_ACK_S = 0.3
"""Longest time, in seconds, from the ACK of request 1 (hello) to the HELLO that answers it. A later
HELLO may be one of those that a hub sends once a second without a request."""

MAX_FIRST_HELLO_S = 0.9
"""Longest time, in seconds, from power-up of a hub to its first HELLO. A later one would be the
first of those that a hub sends once a second."""


def find_irregularity(transcript: Transcript, kind: type) -> str:
    """Return what is wrong with the times of frames of a kind, which must come once a second while
    the hub has stopped and while it has started; "" if nothing is."""
    for step, state in (("quiet", "stopped"), ("start", "started")):
        heard = select_kind(transcript, kind, step)
        what = f"{kind.__name__.upper()} while {state}"
        if len(heard) < 3:
            return f"{len(heard)} {what} in a time in which 3 were due"
        gaps = [after.at_s - before.at_s for before, after in pairwise(heard)]
        mean = sum(gaps) / len(gaps)
        # A busy host or emulator is late by some tenths of a second now and then.
        if not 0.9 < mean < 1.1 or max(gaps) > 1.6:
            return f"{what} every {mean:.2f} s, at most {max(gaps):.2f} s apart"
    return ""


def count_frames_per_sample(transcript: Transcript) -> int:
    """Return the number of frames that most samples consist of."""
    frames = Counter(sample.sequence for sample in transcript.select_frames(Sample))
    return mode(frames.values())


def select_kind(transcript: Transcript, kind: type, *names: str) -> list[Heard]:
    """Return the frames of a kind with their times, in the named steps."""
    return [heard for heard in transcript.iterate_heard(*names) if isinstance(heard.frame, kind)]


def is_hello_behind_ack(step: CheckStep) -> bool:
    """Return whether a HELLO came behind the ACK of request 1.

    A missing ACK is for R1 to report.
    """
    acked_s: float | None = None
    for heard in step.heard:
        if isinstance(heard.frame, Ack) and heard.frame.request == Command.HELLO:
            acked_s = heard.at_s
        elif isinstance(heard.frame, Hello) and acked_s is not None:
            return heard.at_s - acked_s < MAX_BEHIND_ACK_S
    return acked_s is None


def is_late_after_power_up(transcript: Transcript) -> bool:
    """Return whether a hub that was switched on during the check sent no HELLO at power-up.

    The moment of power-up follows from the uptime in STATS.
    """
    stats = select_kind(transcript, Stats, "opened")
    hellos = select_kind(transcript, Hello, "opened")
    if not stats or not isinstance(stats[0].frame, Stats):
        return False
    power_up_s = stats[0].at_s - 1e-3 * stats[0].frame.uptime_ms
    if power_up_s < transcript.steps["opened"].sent_s:
        return False
    return not hellos or hellos[0].at_s - power_up_s > MAX_FIRST_HELLO_S


@rule(
    "H1",
    "A hub sends HELLO after power-up, behind the ACK of request 1, and once a second.",
    needs=(),
)
def check_hello_times(transcript: Transcript) -> RuleResult:
    """Check the HELLOs (descriptions of the hub) at power-up, on request, and once a second."""
    if not transcript.first_bytes and not transcript.is_tcp:
        return report_not_tried("nothing came: see L2")
    if not any(transcript.iterate_heard()):
        return report_failed("no HELLO came, and no other frame")
    if not all(map(is_hello_behind_ack, transcript.steps.values())):
        return report_failed(f"no HELLO within {MAX_BEHIND_ACK_S:g} s behind the ACK of request 1")
    if is_late_after_power_up(transcript):
        return report_failed(f"no HELLO in the first {MAX_FIRST_HELLO_S:g} s after power-up")
    wrong = find_irregularity(transcript, Hello)
    if wrong:
        return report_failed(wrong)
    return report_passed("behind the ACK of request 1, and once a second, stopped and started")


@rule("H2", "All other uids of a hub differ", needs=(Hello,))
def check_uids(transcript: Transcript) -> RuleResult:
    """Check that the uids (unique numbers) of hub and cubes are unique and stay the same."""
    hellos = transcript.select_frames(Hello)
    hubs = list(dict.fromkeys(hello.hub_uid for hello in hellos))
    if len(hubs) > 1:
        return report_failed(f"the hub's uid changed from 0x{hubs[0]:x} to 0x{hubs[1]:x}")
    for one, other in pairwise(hellos):
        # Nobody exchanges cubes during a check; a hub may find more of them after power-up.
        same_number = one.n_cubes == other.n_cubes
        if same_number and one.cube_uids.tolist() != other.cube_uids.tolist():
            return report_failed(
                "the uids of the cubes, or their order, changed between two HELLOs"
            )
    uids = Counter(hellos[-1].cube_uids.tolist())
    # A uid of 0 means that the cube has none.
    without = uids.pop(0, 0)
    for uid, number in uids.items():
        if number > 1:
            cubes = np.flatnonzero(hellos[-1].cube_uids == uid)
            return report_failed(f"cubes {' and '.join(map(str, cubes))} both have uid 0x{uid:x}")
    text = f"hub 0x{hubs[0]:x}, {len(uids)} cubes with different uids"
    return report_passed(text + (f", {without} without one" if without else ""))


@rule("H3", "A hub has 1 to 32 pads per cube", needs=(Hello,))
def check_number_of_pads(transcript: Transcript) -> RuleResult:
    """Check the number of pads in each HELLO; the mask of pad faults has 32 bits."""
    for hello in transcript.select_frames(Hello):
        if hello.n_cubes and not 1 <= hello.n_pads <= MAX_PADS:
            return report_failed(f"HELLO says {hello.n_pads} pads per cube")
    return report_passed(f"{hello.n_cubes} cubes of {hello.n_pads} pads")


@rule(
    "H4",
    "Cubes, pads and their order may change between two HELLOs, not between a HELLO and a SAMPLE "
    "behind it.",
    needs=(Hello, Sample),
)
def check_cubes_stay(transcript: Transcript) -> RuleResult:
    """The number of cubes in SAMPLE may change only behind a HELLO with another number.

    Whether it is the number of HELLO is for S5 to check.
    """
    frames = count_frames_per_sample(transcript)
    hello, last = 0, None
    for frame in transcript.iterate_visit_frames():
        if isinstance(frame, Hello):
            # From here on another number of cubes is right.
            if frame.n_cubes != hello:
                hello, last = frame.n_cubes, None
        # A frame of a split sample does not have all cubes.
        elif isinstance(frame, Sample) and frames == 1:
            if last not in (None, frame.n_cubes):
                return report_failed(
                    f"samples had {last} cubes, then {frame.n_cubes}, and no HELLO said so"
                )
            last = frame.n_cubes
    return report_passed("the cubes of the samples are the same from HELLO to HELLO")


enter_untried(
    "H5",
    "The pads of a cube are in the order of its layout",
    "bytes do not show it: press on one pad after the other, docs/build.md",
)
