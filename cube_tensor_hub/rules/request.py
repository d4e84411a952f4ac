# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rules of REQUEST and ACK: R1 to R8."""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.device.wire.protocol import Ack, Command, Hello, Result, Sample, Stats

from ..conversation import PERIOD_US, UNKNOWN
from ..rule import RuleResult, enter_untried, report_failed, report_not_tried, report_passed, rule
from ..transcript import CheckStep, Transcript
from .sample import compute_periods_us, find_first_frames

MAX_SHIFT = 0.1
"""Largest shift of the sampling times, as a share of the sample period, that is taken for the delay
of a hub on a busy machine. A larger one means that a request has moved the samples."""

PERIOD_TOLERANCE = 0.01
"""Largest relative difference between the sample period that a hub states and the median of the
measured ones."""

MIN_PERIODS = 3
"""Smallest number of measured sample periods from which a rule draws a conclusion."""


def find_period_in_force(step: CheckStep) -> int:
    """Return the sample period in the ACK of SET_PERIOD in a step, in µs; 0: there was no ACK."""
    ack = step.find_ack(Command.SET_PERIOD)
    return 0 if ack is None else ack.argument


def select_behind_ack(step: CheckStep, request: int) -> list[Sample]:
    """Return the samples of a step that came behind the first ACK (answer) to a request."""
    frames = [heard.frame for heard in step.heard]
    for at, frame in enumerate(frames):
        if isinstance(frame, Ack) and frame.request == request:
            return [frame for frame in frames[at:] if isinstance(frame, Sample)]
    return []


@rule("R1", "Each valid request gets one ACK, in order, after it was carried out")
def check_acks(transcript: Transcript) -> RuleResult:
    """In each step the ACKs must be those of the requests, in order.

    That a request was carried out before its ACK shows in the samples around START and STOP.
    """
    n_requests = 0
    for step in transcript.steps.values():
        # A hub that knows request 6 answers it with TIME: T2 checks that.
        asked = [ask.request for ask in step.requests if ask.request != Command.TIME]
        if not asked:
            continue
        n_requests += len(asked)
        answered = [ack.request for ack in step.acks]
        if answered != asked:
            return report_failed(
                f"requests {format_numbers(asked)} got ACKs {format_numbers(answered)}, "
                f"in the step '{step.name}'"
            )
    # A STOP that was carried out before its ACK leaves no sample behind it.
    for name in ("stop", "stop samples"):
        late = select_behind_ack(transcript.steps[name], Command.STOP)
        if late:
            return report_failed(f"{len(late)} samples came behind the ACK of STOP")
    if not transcript.select_frames(Sample, "start"):
        return report_failed("no SAMPLE came behind the ACK of START")
    return report_passed(f"{n_requests} requests, one ACK each, in order")


def format_numbers(numbers: list[int]) -> str:
    """Return numbers as text for a sentence, such as "1, 3", or "none"."""
    return ", ".join(map(str, numbers)) or "none"


@rule(
    "R2",
    "The argument of requests 1, 2 and 3 is 0, and hubs ignore it. The argument of their ACK is "
    "0, as is that of request 5 and of unknown requests.",
    needs=(Ack,),
)
def check_zero_arguments(transcript: Transcript) -> RuleResult:
    """Check argument and result of the ACKs (answers) of all requests but SET_PERIOD."""
    acks = [ack for ack in transcript.select_frames(Ack) if ack.request != Command.SET_PERIOD]
    for ack in acks:
        if ack.argument:
            return report_failed(f"the ACK of request {ack.request} has argument {ack.argument}")
        # The result of a second START or STOP is for R6 to check.
        if ack.request in (Command.HELLO, Command.IDENTIFY) and ack.result != Result.DONE:
            return report_failed(f"request {ack.request} was answered with result {ack.result}")
    unknown = transcript.find_ack("unknown request", UNKNOWN)
    if unknown is not None and unknown.result != Result.UNKNOWN:
        return report_failed(f"unknown request {UNKNOWN} was answered with result {unknown.result}")
    return report_passed(f"in {len(acks)} ACKs; the arguments of requests are ignored")


@rule(
    "R3",
    "It answers 0 (done) with the period now in force, which HELLO then says too.",
    needs=(Ack, Hello),
)
def check_period_is_kept(transcript: Transcript) -> RuleResult:
    """Check that ACK, HELLO and samples agree on the sample period."""
    ack = transcript.find_ack("period", Command.SET_PERIOD)
    if ack is None or ack.result == Result.REFUSED:
        return report_not_tried(f"the hub did not take a period of {PERIOD_US} µs")
    if ack.result != Result.DONE:
        return report_failed(f"request 4 was answered with result {ack.result}")
    wrong = _find_other_period(transcript)
    if wrong:
        return report_failed(wrong)
    gaps = compute_periods_us(transcript.select_frames(Sample, "start"))
    if len(gaps) < MIN_PERIODS:
        return report_not_tried(f"{len(gaps)} periods came in the step 'start', 3 are needed")
    middle = float(np.median(gaps))
    text = f"asked {PERIOD_US} µs, in force {ack.argument} µs, median {middle:.1f} µs"
    # Both times of a period are rounded to 1 µs, the resolution of device time: hence the 2 µs.
    if abs(middle - ack.argument) > PERIOD_TOLERANCE * ack.argument + 2:
        return report_failed(text)
    return report_passed(f"{text}, mean {gaps.mean():.1f} µs, jitter {gaps.std():.1f} µs")


def _find_other_period(transcript: Transcript) -> str:
    """Return where a HELLO states another sample period than the ACK before it; "" if none does."""
    period_us = 0
    for name in transcript.first_visit:
        step = transcript.steps[name]
        # Until the ACK comes, HELLO may have the old period or the new one.
        if any(ask.request == Command.SET_PERIOD for ask in step.requests):
            period_us = 0
        for heard in step.heard:
            frame = heard.frame
            if isinstance(frame, Ack) and frame.request == Command.SET_PERIOD:
                # Which period holds after a refusal is for R4 to check.
                period_us = frame.argument if frame.result == Result.DONE else 0
            elif isinstance(frame, Hello) and period_us and frame.period_us != period_us:
                return f"ACK says {period_us} µs, HELLO says {frame.period_us} µs ('{name}')"
    return ""


@rule(
    "R4",
    "A hub that cannot do a period answers 2 (refused) with the one in force, and keeps that.",
    needs=(Ack, Hello),
)
def check_impossible_period(transcript: Transcript) -> RuleResult:
    """Check that a sample period of 0 changes nothing, whether the hub has started or not."""
    ack = transcript.find_ack("impossible period", Command.SET_PERIOD)
    if ack is None:
        return report_not_tried("request 4 was not answered: see R1")
    # The last HELLO before the request tells the period that was in force.
    before = transcript.select_frames(Hello, "three at once")
    after = transcript.select_frames(Hello, "after impossible period")
    if after and after[0].period_us != ack.argument:
        return report_failed(
            f"0 µs was answered with {ack.argument} µs, HELLO says {after[0].period_us} µs now"
        )
    started = transcript.steps["refused while started"]
    was_sampling = transcript.select_frames(Sample, "start again 2")
    if was_sampling and started.acks and len(select_behind_ack(started, Command.SET_PERIOD)) < 2:
        return report_failed("no samples came any more after a period of 0 µs")
    # A hub may round any period to one that it can do.
    if ack.result == Result.DONE and ack.argument:
        return report_not_tried(
            f"the hub rounded a period of 0 µs to {ack.argument} µs, as R3 allows"
        )
    if ack.result != Result.REFUSED:
        return report_failed(f"a period of 0 µs was answered with result {ack.result}")
    if before and ack.argument != before[-1].period_us:
        return report_failed(
            f"refused with {ack.argument} µs, where {before[-1].period_us} µs were in force"
        )
    return report_passed(f"0 µs is refused, {ack.argument} µs stay in force")


enter_untried(
    "R5",
    "A HELLO with a period that is neither the one asked for",
    "a rule of the host",
)


@rule(
    "R6",
    "START of a hub that has started changes nothing, and is answered 0. So does STOP of one that "
    "has stopped.",
    needs=(Ack,),
)
def check_repeated_start_and_stop(transcript: Transcript) -> RuleResult:
    """Check that a second START or STOP is answered 0 (done) and moves no sample."""
    # START is sent three times, at different places within a period.
    again = [name for name in transcript.steps if name.startswith("start again")]
    asked = [(Command.START, name) for name in again]
    asked += [(Command.STOP, name) for name in ("three at once", "stop again")]
    for command, name in asked:
        ack = transcript.find_ack(name, command)
        if ack is not None and ack.result != Result.DONE:
            return report_failed(f"a second {command.name} was answered with result {ack.result}")
    period_us = find_period_in_force(transcript.steps["period"])
    # The last samples before the second START; earlier ones may have drifted.
    before = compute_phases(transcript.select_frames(Sample, "start"), period_us)[-5:]
    if len(before) < 3:
        return report_not_tried("too few samples came to see it")
    for name in again:
        behind = compute_phases(transcript.select_frames(Sample, name), period_us)
        if len(behind) < 3:
            return report_failed(f"{len(behind)} samples came after a second START")
        # A busy emulator is late for some samples, so those nearest to each other are compared.
        apart = (behind[:, None] - before + 0.5) % 1.0 - 0.5
        shift = float(np.abs(apart).min())
        if shift > MAX_SHIFT:
            return report_failed(f"a second START moved the samples by {shift:.2f} periods")
        before = behind
    return report_passed("a second START moves no sample; both are answered 0")


def compute_phases(samples: list[Sample], period_us: int) -> Array:
    """Return the phase (0 to 1) of the device time of each sample within the sample period."""
    times = [sample.device_us for sample in find_first_frames(samples)]
    return np.array(times) % max(1, period_us) / max(1, period_us)


@rule("R7", "A new period counts at once, also while samples flow.", needs=(Sample, Ack))
def check_new_period(transcript: Transcript) -> RuleResult:
    """Check the times of the samples behind the ACK of a new sample period."""
    period_us = find_period_in_force(transcript.steps["slower"])
    if not period_us or period_us == find_period_in_force(transcript.steps["period"]):
        return report_not_tried("the hub did not take another period")
    # The first gap behind the ACK may still have begun with the old period.
    gaps = compute_periods_us(select_behind_ack(transcript.steps["slower"], Command.SET_PERIOD))[1:]
    if len(gaps) < MIN_PERIODS:
        return report_failed(f"{len(gaps) + 1} periods came after a new period of {period_us} µs")
    # There are few gaps, so the limit is wide; R3 checks the period closely.
    middle = float(np.median(gaps))
    if abs(middle - period_us) > MAX_SHIFT * period_us:
        return report_failed(f"{period_us} µs in force, but samples come every {middle:.0f} µs")
    return report_passed(f"{middle:.0f} µs from the next sample on")


@rule("R8", "After power-up a hub has stopped, until START.")
def check_stopped_until_start(transcript: Transcript) -> RuleResult:
    """Check that a hub that was switched on, or restarted, during the check sends no samples.

    If it was switched on before the check, samples may be those of an earlier START.
    """
    restarted = transcript.select_frames(Stats, "back")
    visit = transcript.select_visit_frames(Stats)
    if restarted and visit and restarted[-1].uptime_ms < visit[-1].uptime_ms:
        # Opening the port has restarted this hub, and no START was sent after that. Samples from
        # before the restart may still be on the way until it answers.
        n = len(select_behind_ack(transcript.steps["back"], Command.HELLO))
        text = f"{n} samples came behind a restart when the port was opened"
        return report_failed(text) if n else report_passed(text)
    early = transcript.select_frames(Sample, "opened", "hello")
    stats = transcript.select_frames(Stats, "opened", "hello", "quiet")
    if not stats:
        return report_not_tried("no STATS came, so when the power came on is not known")
    opened = transcript.steps["opened"].sent_s
    first = next(heard for heard in transcript.iterate_heard() if isinstance(heard.frame, Stats))
    # If the power came on before the port was opened, samples may be those of an earlier START.
    uptime_s = 1e-3 * stats[0].uptime_ms
    if early and uptime_s < first.at_s - opened + 0.5:
        return report_failed(
            f"{len(early)} samples came before START, {uptime_s:.1f} s after power-up"
        )
    if stats[0].taken == 0 and not early:
        return report_passed(f"no sample in the first {uptime_s:.1f} s since power-up")
    return report_not_tried(
        f"the power came on {uptime_s:.0f} s ago: switch the hub off and on, and check"
    )
