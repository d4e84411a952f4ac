# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rules of the line: L1 to L5."""

from __future__ import annotations

from cube_tensor_driver.device.wire.protocol import Command, Hello, Sample, Stats

from ..conversation import AWAY_S, SECOND_S
from ..rule import RuleResult, enter_untried, report_failed, report_not_tried, report_passed, rule
from ..transcript import Transcript
from .request import select_behind_ack
from .sample import compute_increase, compute_sample_rate

TELNET_COMMANDS = range(0xFB, 0xFF)
"""Second byte of a Telnet negotiation: WILL, WON'T, DO, DON'T (RFC 854)."""

TLS_RECORD = b"\x15\x03"
"""Beginning of the alert that a TLS server sends to a client that does not speak TLS."""

MIN_TAKEN_SHARE = 0.7
"""Smallest ratio of the samples that a hub took while its port was closed to those that were due in
this time. Below it, the hub has stopped sampling."""


@rule("L1", "no flow control, neither RTS/CTS nor XON/XOFF")
def check_no_flow_control(transcript: Transcript) -> RuleResult:
    """A hub with XON/XOFF would stop sending behind an XOFF byte."""
    if transcript.find_ack("XOFF", Command.STOP) is None:
        return report_failed("the hub did not answer behind an XOFF byte (0x13)")
    return report_passed("an XOFF byte (0x13) does not stop the hub")


@rule("L2", "must send while DTR is set", needs=())
def check_sends_with_dtr(transcript: Transcript) -> RuleResult:
    """Check that anything comes from a serial port, whose DTR line the check has set."""
    if transcript.is_tcp:
        return report_not_tried("TCP has no DTR")
    if not transcript.first_bytes:
        seconds = sum(step.end_s - step.sent_s for step in transcript.steps.values())
        return report_failed(f"not one byte in {seconds:.1f} s, with DTR and RTS set")
    return report_passed("the hub sends with DTR and RTS set")


@rule("L3", "The bytes are those of a serial port and nothing else: no Telnet, no TLS.", needs=())
def check_no_telnet_or_tls(transcript: Transcript) -> RuleResult:
    """Check that a TCP connection does not begin with bytes of Telnet or TLS."""
    if not transcript.is_tcp:
        return report_not_tried("this is no TCP link")
    first = transcript.first_bytes
    # 0xFF begins a command of Telnet.
    if len(first) > 1 and first[0] == 0xFF and first[1] in TELNET_COMMANDS:
        return report_failed(f"the bridge begins with a command of Telnet: {first[:3].hex(' ')}")
    if first[:2] == TLS_RECORD:
        return report_failed(f"the bridge begins with a record of TLS: {first[:3].hex(' ')}")
    if not first:
        return report_not_tried("nothing came")
    return report_passed("neither Telnet nor TLS at the beginning")


enter_untried(
    "L4",
    "A connection that ends or fails is lost.",
    "a rule of the host",
)


@rule(
    "L5",
    "The hub keeps sampling, drops what it cannot send, counts it, and answers the next host as "
    "it would have answered the last one.",
    needs=(Hello, Sample, Stats),
)
def check_closed_port(transcript: Transcript) -> RuleResult:
    """The counters of STATS around the time in which the port was closed must have gone on."""
    before = transcript.select_visit_frames(Stats)[-1]
    earlier = transcript.select_visit_frames(Hello)
    after = transcript.select_frames(Stats, "back")
    hellos = transcript.select_frames(Hello, "back")
    if not hellos:
        return report_failed(
            f"no HELLO after the port was closed for {AWAY_S:g} s and opened again"
        )
    if not after:
        return report_failed("no STATS after the port was closed and opened again")
    # The uptime went back, so the hub has restarted; only a serial port may cause that.
    if after[-1].uptime_ms < before.uptime_ms:
        if transcript.is_tcp:
            return report_failed("the hub restarted when the connection was closed and made again")
        return report_not_tried("this hub restarts when its port is opened, as L2 allows")
    if earlier and earlier[-1].period_us != hellos[-1].period_us:
        return report_failed(
            f"HELLO said {earlier[-1].period_us} µs, now {hellos[-1].period_us} µs"
        )
    if transcript.select_frames(Sample, "back while stopped"):
        return report_failed("samples came after a stopped hub's port was closed and opened again")
    taken = compute_increase(after[-1].taken, before.taken)
    if taken < 0:
        return report_failed(
            f"{before.taken} samples taken before the port was closed, {after[-1].taken}"
            " after it was opened again"
        )
    seconds = 1e-3 * (after[-1].uptime_ms - before.uptime_ms)
    # Samples that a busy host reads before the ACK were taken at the faster period.
    samples = select_behind_ack(transcript.steps["period again"], Command.SET_PERIOD)
    rate = compute_sample_rate(samples[1:])
    if taken < MIN_TAKEN_SHARE * seconds * rate:
        return report_failed(
            f"{taken} samples taken in the {seconds:.2f} s in which the port was closed and opened "
            f"again, {seconds * rate:.0f} were due"
        )
    if rate and not select_behind_ack(transcript.steps["back"], Command.HELLO):
        return report_failed(f"no sample came in {SECOND_S:g} s after the port was opened again")
    return report_passed(f"{taken} samples taken in {seconds:.2f} s around a port that was closed")
