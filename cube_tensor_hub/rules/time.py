"""Rules of TIME: T1 to T5."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from cube_tensor_driver.device.wire.protocol import Command, Result, Sample, Time

from ..transcript import Transcript
from ..verdict import ANY_FRAME, Verdict, failed, not_tried, passed, rule
from .hello import of_kind

MAX_RATE = 0.02
"""By how much two clocks may differ here; S2 judges the rate of the hub's."""
OTHER_CLOCK_S = 1.0
"""A sample that comes so long after or before it was measured has another clock than TIME."""


@dataclass(frozen=True)
class RoundTrip:
    """A question and its answer: between sent_s and came_s, host's clock, the hub's clock showed
    device_s."""

    sent_s: float
    came_s: float
    device_s: float


def round_trips(talk: Transcript) -> list[RoundTrip]:
    trips = []
    for step in talk.steps.values():
        if step.name.startswith("time"):
            for heard in step.heard:
                if isinstance(heard.frame, Time):
                    device_s = 1e-6 * heard.frame.device_us
                    trips.append(RoundTrip(step.sent_s, heard.at_s, device_s))
                    break
    return trips


def knows_time(talk: Transcript) -> bool:
    return bool(talk.frames(Time))


NOT_KNOWN = "this hub does not know request 6: see T4"


@rule(
    "T1",
    "The hub reads its clock for TIME after the last byte of the request has come and before the "
    "first byte of the answer goes out.",
    needs=(ANY_FRAME,),
)
def clock_is_read_between(talk: Transcript) -> Verdict:
    """Between two readings the hub's clock goes on by what the host's does, give or take the round
    trips."""
    trips = round_trips(talk)
    if not knows_time(talk) or len(trips) < 2:
        return not_tried(NOT_KNOWN)
    shortest = min(trip.came_s - trip.sent_s for trip in trips)
    for first, trip in pairwise(trips):
        slack = MAX_RATE * (trip.came_s - first.sent_s) + 2e-6
        least, most = trip.sent_s - first.came_s - slack, trip.came_s - first.sent_s + slack
        went = trip.device_s - first.device_s
        if not least <= went <= most:
            return failed(
                f"between two TIMEs the hub's clock went on by {went:.6f} s, the host's by "
                f"{least:.6f} to {most:.6f} s"
            )
    return passed(f"{len(trips)} answers, shortest round trip {1e3 * shortest:.2f} ms")


@rule(
    "T2",
    "Each sound request 6 gets one TIME with the request's argument, started or not.",
    needs=(ANY_FRAME,),
)
def one_time_each(talk: Transcript) -> Verdict:
    if not knows_time(talk):
        return not_tried(NOT_KNOWN)
    for step in talk.steps.values():
        numbers = [time.number for time in step.frames(Time)]
        asked = [ask.argument for ask in step.requests if ask.request == Command.TIME]
        if numbers != asked:
            wanted, came = (", ".join(map(str, one)) or "none" for one in (asked, numbers))
            return failed(f"asked with number {wanted}, answered with {came} ('{step.name}')")
    return passed("one TIME with the number of the question, stopped and started")


@rule("T3", "The clock is that of the device time in SAMPLE.", needs=(ANY_FRAME,))
def clock_of_samples(talk: Transcript) -> Verdict:
    trips = round_trips(talk)
    samples = of_kind(talk, Sample, "start")
    if not trips:
        return not_tried(NOT_KNOWN)
    if not samples:
        return not_tried("no SAMPLE came")
    best = min(trips, key=lambda trip: trip.came_s - trip.sent_s)
    for heard, sample in zip(samples, talk.frames(Sample, "start"), strict=True):
        age_s = heard.at_s - best.sent_s - (1e-6 * sample.device_us - best.device_s)
        if abs(age_s) > OTHER_CLOCK_S:
            return failed(
                f"by the clock of TIME, sample {sample.sequence} came {age_s:.3f} s after it "
                "was measured"
            )
    return passed("samples come after they were measured, by the clock of TIME")


@rule(
    "T4",
    "A hub that does not know request 6 answers it with ACK and result 1, as any unknown request.",
    needs=(ANY_FRAME,),
)
def unknown_time(talk: Transcript) -> Verdict:
    if knows_time(talk):
        return not_tried("this hub knows request 6")
    ack = talk.steps["time stopped 0"].ack(Command.TIME)
    if ack is None:
        return failed("request 6 got neither TIME nor ACK")
    if ack.result != Result.UNKNOWN:
        return failed(f"request 6 got no TIME, but an ACK with result {ack.result}")
    return passed("this hub does not know request 6 and says so")


@rule("T5", "The host asks each hub about once a second")
def asking_for_time(talk: Transcript) -> Verdict:
    return not_tried("a rule of the host")
