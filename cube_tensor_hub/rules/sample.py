# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rules of SAMPLE and STATS: S1 to S9.

Samples are counted until the port is closed, because what the kernel holds then is lost.
"""

from __future__ import annotations

from collections import Counter
from itertools import groupby, pairwise

import numpy as np

from cube_tensor_driver.core.arrays import Array
from cube_tensor_driver.core.rows import COUNTER_RANGE
from cube_tensor_driver.device.clock.line import MAX_DRIFT
from cube_tensor_driver.device.wire.protocol import Hello, Sample, Stats

from ..conversation import UNREAD_S
from ..rule import RuleResult, report_failed, report_not_tried, report_passed, rule
from ..transcript import Transcript
from .hello import count_frames_per_sample, find_irregularity, select_kind

MAX_STATS_GAP_S = 2.5
"""Largest difference of the uptimes in two successive STATS, in seconds, which a hub sends once a
second. A larger one means that the hub has waited for the host to read."""

MIN_TAKEN_SHARE = 0.1
"""Smallest ratio of the samples that a hub took while the host did not read to those that were due.
Below it, the hub has waited for the host to read."""

MAX_UPTIME_DIFFERENCE_S = 5.0
"""Largest difference between the device time in SAMPLE and the uptime in STATS, in seconds. Both
count from power-up, but a hub may start them one after the other."""

MIN_MILLIHERTZ = 10_000_000
"""Smallest credible median of the frequencies of all pads, in mHz (10 kHz). Oscillators of pads run
at 50 kHz and more, so a smaller number has another unit, for example Hz."""

MAX_FREQUENCY_RATIO = 2.0
"""Largest credible ratio of the highest to the lowest frequency of a pad during a check, as the
median over the pads. A press changes a frequency by less, bytes in the wrong order by more."""

NOT_MEASURED = 0xFFFFFFFF
"""Frequency that some firmware sends for a pad that was not measured, instead of 0."""

MIN_DRIFT_SAMPLES = 20
"""Smallest number of samples from which the rates of the clocks of hub and host are compared."""


def compute_increase(later: int, earlier: int) -> int:
    """Return by how much a number that wraps at 2^32 grew; negative if it went back."""
    # The shift by half of the range makes a small step back negative instead of nearly 2^32.
    half = COUNTER_RANGE // 2
    return (later - earlier + half) % COUNTER_RANGE - half


def find_first_frames(samples: list[Sample]) -> list[Sample]:
    """Return the first frame of each sample."""
    later = [b for a, b in pairwise(samples) if b.sequence != a.sequence]
    return [*samples[:1], *later]


def compute_periods_us(samples: list[Sample]) -> Array:
    """Return the device time from sample to sample, per sequence number, in µs."""
    gaps = [
        (after.device_us - before.device_us) / compute_increase(after.sequence, before.sequence)
        for before, after in pairwise(find_first_frames(samples))
        if compute_increase(after.sequence, before.sequence) > 0
    ]
    return np.array(gaps)


def compute_sample_rate(samples: list[Sample]) -> float:
    """Return the median rate of samples by their device times, in Hz; 0 if it is not known."""
    gaps = compute_periods_us(samples)
    median = float(np.median(gaps)) if len(gaps) else 0.0
    return 1e6 / median if median > 0 else 0.0


@rule(
    "S1",
    "Samples are numbered from 0 at power-up, one for each that is taken, also while nobody "
    "listens. START, STOP and a new period do not change the numbers.",
    needs=(Sample,),
)
def check_sequence_numbers(transcript: Transcript) -> RuleResult:
    """The first frames of the samples must have growing numbers; S3 checks the other frames."""
    begin = min(sample.first_cube for sample in transcript.select_frames(Sample))
    samples = [
        (name, sample)
        for name in transcript.first_visit
        for sample in transcript.select_frames(Sample, name)
        if sample.first_cube == begin
    ]
    for (before, last), (name, sample) in pairwise(samples):
        where = f"in the step '{name}'" if name == before else f"from '{before}' to '{name}'"
        if compute_increase(sample.sequence, last.sequence) <= 0:
            return report_failed(f"number {sample.sequence} came after {last.sequence}, {where}")
    first, last = samples[0][1], samples[-1][1]
    # A hub that has just been switched on says so: it has taken no sample yet.
    stats = transcript.select_frames(
        Stats,
        "opened",
        "hello",
        "stop",
        "quiet",
    )
    if stats and stats[-1].taken == 0 and first.sequence != 0:
        return report_failed(f"the first sample since power-up has number {first.sequence}")
    return report_passed(
        f"numbers {first.sequence} to {last.sequence} over START, STOP, new periods"
    )


@rule(
    "S2",
    "Device time is that of the middle of the measurement, in µs since power-up. It never goes "
    "back while the hub runs",
    needs=(Sample,),
)
def check_device_time(transcript: Transcript) -> RuleResult:
    """Device time must grow, agree with the uptime, and run at the rate of the host's clock."""
    samples = find_first_frames(transcript.select_visit_frames(Sample))
    for before, after in pairwise(samples):
        if (
            compute_increase(after.sequence, before.sequence) > 0
            and after.device_us <= before.device_us
        ):
            return report_failed(
                f"device time goes from {before.device_us} µs of sample {before.sequence} to "
                f"{after.device_us} µs of sample {after.sequence}"
            )
    stats = transcript.select_visit_frames(Stats)
    device_s = 1e-6 * samples[-1].device_us
    # A hub that restarts its device time at START, for example, shows here.
    if stats and abs(device_s - 1e-3 * stats[-1].uptime_ms) > MAX_UPTIME_DIFFERENCE_S:
        uptime_s = 1e-3 * stats[-1].uptime_ms
        return report_failed(
            f"device time is {device_s:.3f} s, the uptime in STATS {uptime_s:.3f} s"
        )
    flow = select_kind(transcript, Sample, "start")
    if len(flow) < MIN_DRIFT_SAMPLES:
        return report_not_tried(
            f"{len(flow)} samples came in the step 'start', {MIN_DRIFT_SAMPLES} are needed"
        )
    host_us = np.array([1e6 * heard.at_s for heard in flow])
    device_us = np.array(
        [float(sample.device_us) for sample in transcript.select_frames(Sample, "start")]
    )
    drift, unsure, jitter = measure_drift(host_us - host_us[0], device_us - device_us[0])
    text = f"{1e6 * drift:+.0f} ± {1e6 * unsure:.0f} ppm against the host, jitter {jitter:.0f} µs"
    # `MAX_DRIFT` is the largest drift that the driver's estimate of the clock allows.
    if abs(drift) - unsure > MAX_DRIFT:
        return report_failed(f"device time runs {text}")
    return report_passed(f"never back, {text}")


def measure_drift(host: Array, device: Array) -> tuple[float, float, float]:
    """Compare the rates of two clocks.

    The delay of an arrival is never negative, so that the arrivals with the smallest delay in both
    halves give the rate. Their own unknown delays make it uncertain.

    Args:
        host: (N,) times of arrival, in µs.
        device: (N,) times of the samples, in µs.

    Returns:
        Relative drift, its uncertainty, and the median delay above the smallest one, in µs.
    """
    delay = host - device
    # The drift moves the delays apart, and the more so the further apart the two samples are.
    half = len(delay) // 2
    early = int(np.argmin(delay[:half]))
    late = half + int(np.argmin(delay[half:]))
    apart = float(host[late] - host[early])
    drift = float(delay[early] - delay[late]) / apart
    above = delay + drift * host
    jitter = float(np.median(above) - above.min())
    return drift, 2 * (jitter + 1) / apart, jitter


@rule(
    "S3",
    "A sample that does not fit one frame takes several, sent one behind the other, always split "
    "at the same cubes. All have the same number and device time.",
    needs=(Sample,),
)
def check_frames_of_samples(transcript: Transcript) -> RuleResult:
    """Check the frames of samples that do not fit one frame: order, split and device time."""
    samples = transcript.select_visit_frames(Sample)
    if len({sample.first_cube for sample in samples}) == 1:
        return report_not_tried("each sample of this hub fits one frame")
    groups = [list(group) for _, group in groupby(samples, key=lambda sample: sample.sequence)]
    seen: set[int] = set()
    for group in groups:
        times = sorted({sample.device_us for sample in group})
        if len(times) > 1:
            return report_failed(
                f"frames of sample {group[0].sequence} have device times {times} µs"
            )
        # `groupby` begins a new group where another sample's frame lies in between.
        if group[0].sequence in seen and group[0].first_cube:
            return report_failed(
                f"between frames of sample {group[0].sequence} came one of another"
            )
        seen.add(group[0].sequence)
    # Samples that lost a frame are left out: that is for S4 and F5 to check.
    n_frames = max(map(len, groups))
    whole = [group for group in groups if len(group) == n_frames]
    splits = sorted({tuple((one.first_cube, one.n_cubes) for one in group) for group in whole})
    if len(splits) > 1:
        return report_failed(
            f"one sample is split into (first cube, cubes) {splits[0]}, one {splits[1]}"
        )
    return report_passed(f"{n_frames} frames for each of {len(groups)} samples")


@rule(
    "S4",
    "A hub that must drop drops all frames of a sample and counts 1.",
    needs=(Sample, Stats),
)
def check_dropped_samples(transcript: Transcript) -> RuleResult:
    """The count of dropped samples in STATS must contain all sequence numbers that are missing
    before this STATS.

    It may be larger, because the hub may also have dropped samples that follow the last one that
    came.
    """
    base = transcript.select_visit_frames(Stats)[0].dropped
    frames = Counter(sample.sequence for sample in transcript.select_visit_frames(Sample))
    n_frames = count_frames_per_sample(transcript)
    missing, counted = 0, 0
    previous: int | None = None
    for frame in transcript.iterate_visit_frames():
        if isinstance(frame, Sample) and frame.sequence != previous:
            number = frame.sequence
            step = 1 if previous is None else compute_increase(number, previous)
            if step < 0:
                return report_not_tried("the numbers go back: see S1")
            # A sample that lacks a frame counts as dropped as a whole.
            missing += max(0, step - 1) + (frames[number] < n_frames)
            previous = number
        elif isinstance(frame, Stats):
            counted = frame.dropped - base & 0xFFFFFFFF
            # Number of samples that the hub took after the last one that came.
            behind = 0
            if previous is not None:
                behind = max(0, compute_increase(frame.taken, previous) - 1)
            if not missing <= counted <= missing + behind:
                return report_failed(
                    f"{missing} numbers are missing, STATS counts {counted} as dropped"
                )
    if counted:
        return report_passed(f"{len(frames)} samples came; {counted} were dropped, all are counted")
    return report_passed(f"{len(frames)} samples came, none is missing and none counts as dropped")


@rule(
    "S5",
    "n_pads is that of HELLO. The frames of a sample have each cube once, and pad faults only bits "
    "of pads that exist.",
    needs=(Hello, Sample),
)
def check_samples_fit_hello(transcript: Transcript) -> RuleResult:
    """Check that the samples have the pads and cubes that HELLO states, each cube once."""
    hello: Hello | None = None
    seen: set[tuple[int, int]] = set()
    for sample in transcript.iterate_visit_frames():
        if isinstance(sample, Hello):
            hello = sample
        elif isinstance(sample, Sample) and hello is not None:
            if sample.n_pads != hello.n_pads:
                return report_failed(f"SAMPLE has {sample.n_pads} pads, HELLO says {hello.n_pads}")
            last = sample.first_cube + sample.n_cubes
            if last > hello.n_cubes:
                return report_failed(
                    f"SAMPLE has cubes up to {last - 1}, HELLO says {hello.n_cubes}"
                )
            faults = int(np.bitwise_or.reduce(sample.pad_fault, initial=0))
            if faults >> sample.n_pads:
                return report_failed(f"pad faults 0x{faults:x} of cubes with {sample.n_pads} pads")
            cubes = {(sample.sequence, cube) for cube in range(sample.first_cube, last)}
            # A sample that came twice is for S1 to report.
            if seen & cubes and sample.first_cube:
                return report_failed(f"sample {sample.sequence} has cube {sample.first_cube} twice")
            seen |= cubes
    n_cubes = 0 if hello is None else hello.n_cubes
    never = set(range(n_cubes)) - {cube for _, cube in seen}
    if never:
        return report_failed(f"cube {min(never)} is in no SAMPLE, HELLO says {n_cubes} cubes")
    return report_passed("pads and cubes of the samples are those of HELLO")


@rule("S6", "Frequencies are in mHz, and 0 means not measured.", needs=(Sample,))
def check_frequencies(transcript: Transcript) -> RuleResult:
    """The median over the pads must be possible; a single pad may be broken."""
    frames = [one for one in transcript.select_frames(Sample, "start") if one.frequency.size]
    # Frames with other cubes, or with another number of them, are for H4 and S3 to check.
    frames = [one for one in frames if one.frequency.shape == frames[0].frequency.shape]
    if not frames:
        return report_not_tried("no frequency came in the step 'start'")
    table = np.array([one.frequency.ravel() for one in frames], float)
    if (table == NOT_MEASURED).any():
        return report_failed(f"a frequency is 0x{NOT_MEASURED:X}")
    is_measured = table > 0
    works = is_measured.any(axis=0)
    measured = np.where(is_measured, table, np.nan)[:, works]
    if not measured.size:
        return report_not_tried("no pad was measured")
    middle = float(np.nanmedian(measured))
    if middle < MIN_MILLIHERTZ:
        return report_failed(f"the median frequency is {middle:.0f} mHz: look for another unit")
    highest = np.nanmax(measured, axis=0)
    lowest = np.nanmin(measured, axis=0)
    ratio = float(np.median(highest / lowest))
    if ratio > MAX_FREQUENCY_RATIO:
        return report_failed(
            f"frequencies of a pad differ by a factor of {ratio:.1f}: look at the bytes"
        )
    return report_passed(f"median {1e-6 * middle:.3f} kHz; stop one oscillator to see its 0")


@rule(
    "S7",
    "*Samples taken* of STATS is the number of the next sample, so 0 before the first one, and "
    "wraps with it. STATS goes out behind the frames of the samples that it counts.",
    needs=(Sample, Stats),
)
def check_number_taken(transcript: Transcript) -> RuleResult:
    """The count of taken samples in STATS must be above the number of the sample before this STATS,
    and at most the number of the sample behind it.

    If no sample was lost in between, a single count is right.
    """
    waiting: list[Stats] = []
    # Number that the next sample has if none is lost.
    expected: int | None = None
    n_compared = 0
    for frame in transcript.iterate_visit_frames():
        if isinstance(frame, Stats):
            waiting.append(frame)
        elif isinstance(frame, Sample):
            number = frame.sequence
            lowest = number if expected is None else expected
            for stats in waiting:
                too_low = expected is not None and compute_increase(stats.taken, lowest) < 0
                too_high = compute_increase(number, stats.taken) < 0
                if compute_increase(number, lowest) >= 0 and (too_low or too_high):
                    last = "none" if expected is None else str((expected - 1) & 0xFFFFFFFF)
                    return report_failed(
                        f"STATS says {stats.taken} taken, the sample before it is {last}, the "
                        f"one behind it {number}"
                    )
            n_compared += len(waiting)
            waiting = []
            expected = (number + 1) & 0xFFFFFFFF
    return report_passed(f"{n_compared} STATS fit the samples before and behind them")


@rule("S8", "A hub sends STATS once a second, started or not.", needs=(Hello,))
def check_stats_times(transcript: Transcript) -> RuleResult:
    """Check that STATS (counters of the hub) come once a second, started or not."""
    wrong = find_irregularity(transcript, Stats)
    if wrong:
        return report_failed(wrong)
    return report_passed("stopped and started")


@rule(
    "S9",
    "A full transmit buffer never makes a hub wait: it drops whole frames.",
    needs=(Sample, Stats),
)
def check_full_buffer(transcript: Transcript) -> RuleResult:
    """Check that a hub whose host does not read drops whole samples and does not wait."""
    step = transcript.steps["unread"]
    # Damage in other steps comes from the line and says nothing about the buffer.
    if sum(other.damaged for other in transcript.steps.values()) > step.damaged:
        return report_not_tried("frames are damaged in any case: see F5")
    if step.damaged:
        return report_failed(f"{step.damaged} damaged frames after {UNREAD_S:g} s without reading")
    if transcript.select_frames(Sample, "fast") and not transcript.select_frames(
        Sample,
        "period again",
    ):
        return report_failed(f"no sample came any more after {UNREAD_S:g} s without reading")
    # The reference is the last STATS of the steps before "unread", in which everything was read.
    read = transcript.first_visit[: transcript.first_visit.index("unread")]
    before = transcript.select_frames(Stats, *read)[-1]
    stats = [before, *transcript.select_frames(Stats, "unread", "period again")]
    dropped = compute_increase(stats[-1].dropped, before.dropped)
    if dropped:
        return report_passed(f"{dropped} whole samples dropped in {UNREAD_S:g} s without reading")
    # Nothing was dropped: either the line took everything, or the hub has waited for the host.
    due_ms = before.uptime_ms + 1e3 * UNREAD_S
    if stats[-1].uptime_ms < due_ms:
        return report_failed(f"no STATS any more after {UNREAD_S:g} s without reading")
    # The period in force may be a rounded one, so it is measured.
    rate = compute_sample_rate(transcript.select_frames(Sample, "fast"))
    for one, other in pairwise(stats):
        seconds = 1e-3 * (other.uptime_ms - one.uptime_ms)
        if seconds > MAX_STATS_GAP_S:
            return report_failed(f"no STATS for {seconds:.1f} s while nobody read: the hub waited")
        taken = compute_increase(other.taken, one.taken)
        if other.uptime_ms <= due_ms and taken < MIN_TAKEN_SHARE * seconds * rate:
            return report_failed(
                f"while nobody read, {taken} samples were taken in {seconds:.1f} s at {rate:.0f} "
                "Hz, and none counts as dropped: the hub waited"
            )
    return report_not_tried(f"the line took all that came in {UNREAD_S:g} s without reading")
