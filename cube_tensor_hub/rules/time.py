# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rules of TIME: T1 to T5."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from cube_tensor_driver.device.wire.protocol import Command, Result, Sample, Time

from ..rule import RuleResult, enter_untried, report_failed, report_not_tried, report_passed, rule
from ..transcript import Transcript
from .hello import select_kind
from .request import find_period_in_force

MAX_RATE_DIFFERENCE = 0.02
"""Largest relative difference between the rates of the clocks of hub and host in the rules about
TIME. It is wide, because rule S2 checks the rate of the hub's clock exactly."""

RESOLUTION_S = 2e-6
"""Largest sum of the rounding errors of two times on the hub's clock, in seconds; TIME has a
resolution of 1 µs."""

NOT_KNOWN = "this hub does not know request 6: see T4"
"""Reason, as the check prints it, why rules about TIME are not tried."""


@dataclass(frozen=True)
class TimeExchange:
    """A request for TIME and its answer.

    Attributes:
        sent_s: Time on the host's clock at which the request was sent, in seconds.
        came_s: Time on the host's clock at which the answer came, in seconds.
        device_s: Time on the hub's clock somewhere between these two, in seconds.
    """

    sent_s: float
    came_s: float
    device_s: float


def list_time_exchanges(transcript: Transcript, state: str) -> list[TimeExchange]:
    """Return the requests for TIME that were answered while the hub was in a state.

    Args:
        transcript: The conversation.
        state: Start of the name of the state: "before start", "started", "stopped", or "st" for
            both of the latter.
    """
    trips = []
    for step in transcript.steps.values():
        if step.name.startswith(f"time {state}"):
            for heard in step.heard:
                if isinstance(heard.frame, Time):
                    device_s = 1e-6 * heard.frame.device_us
                    trips.append(TimeExchange(step.sent_s, heard.at_s, device_s))
                    break
    return trips


def knows_time(transcript: Transcript) -> bool:
    """Return whether the hub has sent a TIME during the check, which answers request 6."""
    return bool(transcript.select_frames(Time))


@rule(
    "T1",
    "The hub reads its clock for TIME after the last byte of the request has come and before the "
    "first byte of the answer goes out.",
)
def check_time_of_clock_reading(transcript: Transcript) -> RuleResult:
    """Between two answers the hub's clock must go on by what the host's clock does.

    Each reading is uncertain by the time between request and answer.
    """
    # Requests "before start" come later in the conversation. They are left out, because the hub may
    # have restarted its clock when the port was opened before them.
    trips = list_time_exchanges(transcript, "st")
    if not knows_time(transcript) or len(trips) < 2:
        return report_not_tried(NOT_KNOWN)
    # The driver estimates the clock from the answers with the shortest time since the request.
    shortest = min(trip.came_s - trip.sent_s for trip in trips)
    for first, trip in pairwise(trips):
        slack = MAX_RATE_DIFFERENCE * (trip.came_s - first.sent_s) + RESOLUTION_S
        shortest_s = trip.sent_s - first.came_s - slack
        longest_s = trip.came_s - first.sent_s + slack
        went = trip.device_s - first.device_s
        if not shortest_s <= went <= longest_s:
            return report_failed(
                f"between two TIMEs the hub's clock went on by {went:.6f} s, the host's by "
                f"{shortest_s:.6f} to {longest_s:.6f} s"
            )
    return report_passed(f"{len(trips)} answers, shortest round trip {1e3 * shortest:.2f} ms")


@rule("T2", "Each valid request 6 gets one TIME with the request's argument, started or not.")
def check_time_answers(transcript: Transcript) -> RuleResult:
    """Check that each request for TIME has one answer, with the number of the request."""
    if not knows_time(transcript):
        return report_not_tried(NOT_KNOWN)
    for step in transcript.steps.values():
        numbers = [time.number for time in step.select_frames(Time)]
        if numbers and step.find_ack(Command.TIME):
            return report_failed(f"TIME and ACK came for one request ('{step.name}')")
        asked = [ask.argument for ask in step.requests if ask.request == Command.TIME]
        if numbers != asked:
            wanted, came = (", ".join(map(str, one)) or "none" for one in (asked, numbers))
            return report_failed(
                f"asked with number {wanted}, answered with {came} ('{step.name}')"
            )
    return report_passed("one TIME with the number of the question, stopped and started")


@rule("T3", "The clock is that of the device time in SAMPLE.")
def check_clock_of_samples(transcript: Transcript) -> RuleResult:
    """A sample comes after it was measured, and the first one is measured after START."""
    trips = list_time_exchanges(transcript, "before start")
    step = transcript.steps["start at once"]
    samples = select_kind(transcript, Sample, "start at once")
    if not trips:
        return report_not_tried(NOT_KNOWN)
    if not samples:
        return report_not_tried("no SAMPLE came")
    first, sample = samples[0], transcript.select_frames(Sample, "start at once")[0]
    device_s = 1e-6 * sample.device_us
    # A hub that measures all the time may have begun the first sample before START.
    period_s = 1e-6 * find_period_in_force(transcript.steps["shortest period"])
    for trip in trips:
        slack = MAX_RATE_DIFFERENCE * (first.at_s - trip.sent_s) + RESOLUTION_S
        latest_s = trip.device_s + first.at_s - trip.sent_s + slack
        earliest_s = trip.device_s + step.sent_s - trip.came_s - period_s - slack
        if not earliest_s <= device_s <= latest_s:
            return report_failed(
                f"by the clock of TIME, the first sample was measured at {device_s:.3f} s; it was "
                f"asked for at {earliest_s:.3f} s and came at {latest_s:.3f} s"
            )
    return report_passed(
        "samples are measured between START and their arrival, by the clock of TIME"
    )


@rule(
    "T4",
    "A hub that does not know request 6 answers it with ACK and result 1, as any unknown request.",
)
def check_unknown_time_request(transcript: Transcript) -> RuleResult:
    """Check how a hub answers that does not know the request for TIME."""
    if knows_time(transcript):
        return report_not_tried("this hub knows request 6")
    ack = transcript.find_ack("time stopped 0", Command.TIME)
    if ack is None:
        return report_failed("request 6 got neither TIME nor ACK")
    if ack.result != Result.UNKNOWN:
        return report_failed(f"request 6 got no TIME, but an ACK with result {ack.result}")
    return report_passed("this hub does not know request 6 and says so")


enter_untried(
    "T5",
    "The host asks each hub about once a second",
    "a rule of the host",
)
