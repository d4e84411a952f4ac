# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rules of frames: F1 to F5."""

from __future__ import annotations

from cube_tensor_driver.device.wire.protocol import Hello, Request, Sample

from ..conversation import AFTER_DAMAGE, AFTER_WRONG_WAY, DAMAGED
from ..rule import RuleResult, report_failed, report_not_tried, report_passed, rule
from ..transcript import Transcript

OVERFULL = ("unread", "gone")
"""Names of the steps of a check in which buffers overflow. Damaged frames there are for rule S9
(a full buffer) to report."""


@rule("F1", "A sender puts a zero before and behind each frame.")
def check_zeros_around_frames(transcript: Transcript) -> RuleResult:
    """Between two frames there must be two zeros: one behind the first, one before the second."""
    # Behind damaged bytes it is not known which zeros belong to the next frame (`opened` is None).
    opened = [heard.opened for heard in transcript.iterate_heard() if heard.opened is not None]
    if not opened:
        return report_not_tried("no two frames came one behind the other")
    missing = opened.count(False)
    if missing:
        return report_failed(
            f"{missing} of {len(opened)} frames have no zero of their own before them"
        )
    return report_passed(f"all of {len(opened)} frames")


@rule(
    "F2",
    "A receiver counts each run that is no frame, as above, and continues with the next. It never "
    "answers it",
)
def check_frames_behind_damage(transcript: Transcript) -> RuleResult:
    """Damaged requests must not be answered, and a valid request behind them must be."""
    step = transcript.steps["damaged"]
    answered = [DAMAGED[ack.request] for ack in step.acks if ack.request in DAMAGED]
    if answered:
        return report_failed(f"the hub answered a request {answered[0]}")
    if step.find_ack(AFTER_DAMAGE) is None:
        return report_failed("no answer to a valid request behind noise and damaged requests")
    return report_passed(f"no answer to noise and to a request {', '.join(DAMAGED.values())}")


@rule("F3", "A frame that goes the wrong way, or that nobody waits for, is ignored.")
def check_wrong_way_frames(transcript: Transcript) -> RuleResult:
    """Check that frames which only hubs send are not answered, and a request behind them is."""
    step = transcript.steps["wrong way"]
    if step.find_ack(AFTER_WRONG_WAY) is None:
        return report_failed("no answer to a request behind frames that only hubs send")
    if len(step.acks) > 1:
        others = [ack for ack in step.acks if ack.request != AFTER_WRONG_WAY]
        return report_failed(
            f"the hub answered a frame that only hubs send: {(others or step.acks)[0]}"
        )
    return report_passed("HELLO, SAMPLE, STATS, TIME and ACK are not answered")


@rule("F4", "Flags and spare bytes are sent as 0")
def check_flags(transcript: Transcript) -> RuleResult:
    """Check the bytes of HELLO and SAMPLE that version 1 of the protocol does not use."""
    flags = [hello.flags for hello in transcript.select_frames(Hello) if hello.flags]
    if flags:
        return report_failed(f"flags of HELLO are 0x{flags[0]:02x}")
    spare = [sample.spare for sample in transcript.select_frames(Sample) if any(sample.spare)]
    if spare:
        return report_failed(f"spare bytes of SAMPLE are {spare[0].hex(' ')}")
    return report_passed("flags of HELLO and spare bytes of SAMPLE are 0")


@rule(
    "F5",
    "Each run of bytes between two zeros of a sender is a frame of this page that goes its way.",
    needs=(),
)
def check_all_runs_are_frames(transcript: Transcript) -> RuleResult:
    """Every run of bytes must be a frame, and none a REQUEST, which only hosts send."""
    steps = [step for step in transcript.steps.values() if step.name not in OVERFULL]
    damaged = sum(step.damaged for step in steps)
    if damaged:
        kinds = ", ".join(f"{name} {count}" for name, count in transcript.damage.items())
        other = "" if transcript.other_version is None else f"; version {transcript.other_version}"
        return report_failed(f"{damaged} runs of bytes are no frame ({kinds}{other})")
    # A REQUEST is a valid frame, but it goes from hosts to hubs only.
    wrong_way = [heard for step in steps for heard in step.heard if type(heard.frame) is Request]
    if wrong_way:
        return report_failed(f"the hub sent {len(wrong_way)} frames of type REQUEST")
    frames = sum(len(step.heard) for step in steps)
    if not frames:
        return report_not_tried("nothing came")
    return report_passed(f"all of {frames} runs")
