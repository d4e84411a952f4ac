"""Recorded frequencies to stress again, by the pipeline of the reconstruction node and to the same
bits."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..config.calibration import calibration_text
from ..config.skin import Skin
from ..core.calibration import Calibration
from ..core.errors import BagError, CalibrationError, CubeError
from ..core.pattern import count_repeats
from ..core.pipeline import Pipeline
from ..core.reconstructor import Reconstructor, Verdicts
from ..core.rows import FrequencyRows, StressRows, concatenate
from .mcap import HEAD
from .message_codec import SECOND, Decoded, stress_codec
from .read import FREQUENCIES, INFO, STRESS, VERSIONS, Bag, damage, pipeline, typestore
from .recorded_verdicts import RecordedVerdicts
from .tables import TableWriter
from .write import BagWriter, quality

PARTIAL = ".partial"
"""Folder beside the results for what is not complete; a restart begins those anew."""

BATCHES_BYTES = 30 << 20


@dataclass(frozen=True)
class Change:
    """What to do differently from the recording. None: as it was.

    calibration: for all cubes; skin: the calibrations of its cubes, by name; tare: from and to in s
    after the start of the bag, between which the cubes were without load.
    """

    calibration: Calibration | None = None
    skin: Skin | None = None
    tare: tuple[float, float] | None = None


@dataclass(frozen=True)
class Job:
    """One bag to reprocess: where to, as what (bag, parquet, csv)."""

    bag: Path
    output: Path
    form: str
    change: Change


class Done(NamedTuple):
    """What a job did: messages and rows of stress, how much time they cover in s."""

    messages: int
    rows: int
    seconds: float


class Recording:
    """The frequencies of a bag as a stream of stress; `topic` of frequencies. infos, pipelines: by
    time.

    BagError: no info in the bag, or the change does not fit its cubes.
    """

    def __init__(self, bag: Bag, topic: str, change: Change | None = None) -> None:
        change = change or Change()
        self.bag, self.topic = bag, topic
        infos = bag.infos(topic.removesuffix("frequencies") + "info")
        # The driver knows of no tare: what it says counts only where no reconstruction ran.
        infos = [info for info in infos if info.sender == "reconstruction"] or infos
        infos.sort(key=lambda info: _stamp_ns(info))
        self.infos = infos
        self._now: tuple[int, Reconstructor] | None = None
        self._since = np.array([_stamp_ns(info) for info in infos])
        with damage(bag.path):
            self.pipelines = [self._changed(info, change) for info in infos]
        if change.tare is not None:
            self._tare(*change.tare)
        # What was found bad under other rest frequencies need not be so under these.
        self.found = RecordedVerdicts(bag, topic, change == Change())

    def batches(
        self,
    ) -> Iterator[tuple[Decoded[FrequencyRows], NDArray[np.int64], StressRows]]:
        """Frequencies, when they were recorded, the stress of all their rows in order."""
        for messages, recorded_ns in self.bag.frequencies(self.topic):
            cube = messages.by_message(messages.rows.cube)
            times_ns = messages.by_message(messages.rows.stamp_ns)
            # An info holds for what was sampled from its stamp on: the node stamps it just behind
            # the last row before.
            newest_ns = times_ns.max(axis=1) if times_ns.size else messages.stamp_ns
            which = np.maximum(np.searchsorted(self._since, newest_ns, side="right") - 1, 0)
            found = self.found.of(messages.stamp_ns, cube)
            changed = (cube[1:] != cube[:-1]).any(axis=1) | (np.diff(which) != 0)
            ends = [0, *(np.flatnonzero(changed) + 1).tolist(), len(cube)]
            n = cube.shape[1]
            for run in map(slice, ends[:-1], ends[1:]):
                part = Decoded(
                    messages.rows.select(slice(run.start * n, run.stop * n)),
                    messages.stamp_ns[run],
                    messages.frame_id,
                )
                verdicts = Verdicts(
                    np.repeat(found.known[run], n),
                    found.left_out[run].ravel(),
                    found.bits[run].ravel(),
                )
                yield part, recorded_ns[run], self._process(int(which[run.start]), part, verdicts)

    def number(self, newest_ns: int) -> int:
        """Which info holds for a message whose newest row was sampled then."""
        return max(int(np.searchsorted(self._since, newest_ns, side="right")) - 1, 0)

    def info_messages(self) -> list[bytes]:
        """The SkinInfo messages that go with the stress, serialised."""
        return [_info(info, made) for info, made in zip(self.infos, self.pipelines, strict=True)]

    def _process(
        self, number: int, messages: Decoded[FrequencyRows], verdicts: Verdicts
    ) -> StressRows:
        """Stress of all rows of messages of the same cubes, as the node makes it message by
        message."""
        reconstructor, rows = self._use(number), messages.rows
        n = len(rows) // len(messages)
        try:
            if count_repeats(rows.cube[:n]) or len(messages) == 1:
                return reconstructor.process(rows, verdicts)
            # Cubes in another order: only message by message are the bits the node's.
            parts = [slice(k, k + n) for k in range(0, len(rows), n)]
            return concatenate(
                [reconstructor.process(rows.select(p), verdicts.select(p)) for p in parts]
            )
        except CubeError as error:
            raise BagError(f"{self.bag.path}: {self.topic}: {error}") from None

    def _use(self, number: int) -> Reconstructor:
        """The reconstructor under an info: a tare changes rest frequencies only."""
        wanted = self.pipelines[number]
        if self._now is None or [c.id for c in self._now[1].calibrations] != [
            c.id for c in wanted.calibrations
        ]:
            made = Reconstructor(wanted.calibrations)
        elif self._now[0] != number:
            made = self._now[1]
        else:
            return self._now[1]
        made.rest_frequency = wanted.rest_frequency
        self._now = number, made
        return made

    def _changed(self, info: Any, change: Change) -> Pipeline:
        recorded = pipeline(info)
        if change.skin is not None:
            by_name = {cube.name: cube.calibration for cube in change.skin.cubes}
            missing = [cube.name for cube in info.cubes if cube.name not in by_name]
            if missing:
                raise BagError(
                    f"{self.bag.path}: the skin file {change.skin.name} has no cubes "
                    f"{', '.join(missing[:5])}; the bag has"
                )
            new = [by_name[cube.name] for cube in info.cubes]
        elif change.calibration is not None:
            new = [change.calibration] * len(info.cubes)
        else:
            return recorded
        rest = []
        for cube, old, made, was in zip(
            info.cubes, recorded.calibrations, new, recorded.rest_frequency, strict=True
        ):
            try:
                made.check(old.layout, cube.uid or None)
            except CalibrationError as error:
                raise BagError(f"{self.bag.path}: cube {cube.name}: {error}") from None
            # A tare is a measurement and stays; without one the calibration says what no load is.
            n = old.layout.n_pads
            tared = was[:n] != old.rest_frequency
            rest.append(
                np.pad(
                    np.where(tared, was[:n], made.rest_frequency),
                    (0, len(was) - n),
                    constant_values=np.nan,
                )
            )
        result = Pipeline(new, np.float32)
        result.rest_frequency = np.array(rest)
        return result

    def _tare(self, begin_s: float, end_s: float) -> None:
        """Mean frequencies of all pads between two times, temperature taken out, become the rest
        frequencies."""
        of = self.pipelines[-1]
        total, count = np.zeros_like(of.rest_frequency), np.zeros(of.rest_frequency.shape)
        begin_ns, end_ns = (self.bag.start_ns + round(time * 1e9) for time in (begin_s, end_s))
        for messages, _ in self.bag.frequencies(self.topic):
            rows = messages.rows
            inside = (rows.stamp_ns >= begin_ns) & (rows.stamp_ns < end_ns)
            rows = rows.select(inside & (rows.cube < len(of.calibrations)))
            if not len(rows):
                continue
            frequency = rows.frequency / of.temperature_factor(rows.cube, rows.temperature)
            bad = rows.pad_fault[:, None] >> np.arange(frequency.shape[1]) & 1 > 0
            good = np.isfinite(frequency) & (frequency > 0) & ~bad
            np.add.at(total, rows.cube, np.where(good, frequency, 0))
            np.add.at(count, rows.cube, good)
        exists = np.isfinite(of.rest_frequency)
        without = (exists & (count == 0)).any(axis=1)
        if without.any():
            names = ", ".join(
                self.infos[-1].cubes[cube].name for cube in np.flatnonzero(without)[:5]
            )
            seconds = (self.bag.end_ns - self.bag.start_ns) * 1e-9
            raise BagError(
                f"{self.bag.path}: --tare-from {begin_s:g} {end_s:g}: not every pad of {names} was "
                f"measured in that time; the bag lasts from 0 to {seconds:.3f} s"
            )
        rest = np.where(exists, total / np.maximum(count, 1), np.nan)
        for made in self.pipelines:
            made.rest_frequency = rest


def reprocess(job: Job) -> Done:
    """Do one job; its output appears when it is complete. BagError: what is wrong with bag or
    output."""
    # malloc gives back what is free above twice the largest block that it ever gave back: not the
    # batches' memory.
    np.empty(BATCHES_BYTES, np.uint8)
    partial = job.output.parent / PARTIAL / job.output.name
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)
        with Bag(job.bag) as bag:
            topics = bag.topics(FREQUENCIES)
            if not topics:
                raise BagError(f"{job.bag}: no topic of {FREQUENCIES}; record frequencies and info")
            if job.form == "bag":
                done = _to_bag(bag, topics, job.change, partial)
            elif len(topics) > 1:
                raise BagError(
                    f"{job.bag}: {len(topics)} skins ({', '.join(topics)}); a table holds one: write a bag"
                )
            else:
                done = _to_table(bag, topics[0], job.change, partial)
        partial.replace(job.output)
        with suppress(OSError):  # other jobs are at work in there
            partial.parent.rmdir()
    except OSError as error:
        raise BagError(
            f"{job.output}: {error.strerror}; name a folder that can be written"
        ) from None
    return done


def _to_bag(bag: Bag, topics: list[str], change: Change, output: Path) -> Done:
    messages = rows = 0
    with BagWriter(output) as writer:
        for topic in topics:
            skin = topic.removesuffix("frequencies")
            recording = Recording(bag, topic, change)
            writer.add_topic(f"{skin}info", INFO, [quality(latched=True)])
            writer.add_topic(f"{skin}stress", STRESS, [quality()])
            for info, data in zip(recording.infos, recording.info_messages(), strict=True):
                writer.write(
                    f"{skin}info", max(bag.start_ns, min(bag.end_ns, _stamp_ns(info))), data
                )
            for source, recorded_ns, stress in recording.batches():
                made = stress_codec.encode_many(stress, source.stamp_ns, source.frame_id, HEAD)
                writer.write_many(f"{skin}stress", recorded_ns, made)
                messages += len(recorded_ns)
                rows += len(stress)
    return Done(messages, rows, (bag.end_ns - bag.start_ns) * 1e-9)


def _to_table(bag: Bag, topic: str, change: Change, output: Path) -> Done:
    messages = rows = 0
    recording = Recording(bag, topic, change)
    with TableWriter(
        output, [cube.name for cube in recording.infos[-1].cubes] + ["unknown"]
    ) as table:
        for _, recorded_ns, stress in recording.batches():
            table.write(stress)
            messages += len(recorded_ns)
            rows += len(stress)
    return Done(messages, rows, (bag.end_ns - bag.start_ns) * 1e-9)


def _stamp_ns(info: Any) -> int:
    return int(info.header.stamp.sec) * SECOND + int(info.header.stamp.nanosec)


def _info(info: Any, made: Pipeline) -> bytes:
    """The recorded info with the calibrations and rest frequencies of the pipeline, serialised."""
    distinct = {
        calibration.id: number
        for number, calibration in reversed(list(enumerate(made.calibrations)))
    }
    cubes = [
        replace(
            cube,
            calibration_id=calibration.id,
            half_side=calibration.half_side,
            rest_frequency=rest[: calibration.layout.n_pads],
        )
        for cube, calibration, rest in zip(
            info.cubes, made.calibrations, made.rest_frequency, strict=True
        )
    ]
    changed = replace(
        info,
        version=max(VERSIONS),
        sender="reconstruction",
        cubes=cubes,
        calibration_ids=list(distinct),
        calibrations=[calibration_text(made.calibrations[number]) for number in distinct.values()],
        covariance=np.array([made.covariance(number) for number in distinct.values()]).ravel(),
    )
    return bytes(typestore().serialize_cdr(changed, INFO))
