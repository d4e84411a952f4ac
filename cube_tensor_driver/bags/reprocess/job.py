"""Recorded frequencies to stress again: a bag source, a Reconstructor, a writer.

The result has the bits that the reconstruction node published, unless something is asked for that
differs from the recording.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...config.calibration import calibration_text
from ...config.skin import Skin
from ...core.calibration import Calibration
from ...core.errors import BagError, CalibrationError, CubeError
from ...core.pipeline import Pipeline
from ...core.reconstructor import Reconstructor
from ...core.rows import StressRows
from ...messages.codec import stress_codec
from ...messages.types import FREQUENCIES, INFO, STRESS
from ..metadata import quality
from ..read import Bag, serialise
from ..recording import Settings, stamp_ns
from ..source import BagSource, Segment
from ..tables import TableWriter
from ..write import BagWriter
from .contacts import ContactsOverTime, ContactWriter

if TYPE_CHECKING:
    from ..zarr_table import ZarrWriter

PARTIAL = ".partial"
"""Folder beside the results for what is not complete; a restart begins those again."""
WORKING_BYTES = 30 << 20
NAMED = 5
"""Cubes that a message names at most."""


@dataclass(frozen=True)
class Overrides:
    """What differs from the recording. None: as it was recorded.

    calibration: for all cubes
    skin: the calibrations of its cubes, by the cubes' names
    tare: (begin, end) in s after the start of the bag, between which nothing touched the skin
    """

    calibration: Calibration | None = None
    skin: Skin | None = None
    tare: tuple[float, float] | None = None

    @property
    def any(self) -> bool:
        return any(value is not None for value in (self.calibration, self.skin, self.tare))


AS_RECORDED = Overrides()


@dataclass(frozen=True)
class ReprocessJob:
    """One bag to reprocess.

    form of the output: bag, parquet, csv or zarr; contacts: a bag has them, too
    """

    bag: Path
    output: Path
    form: str
    overrides: Overrides = AS_RECORDED
    contacts: ContactsOverTime | None = None


class ReprocessResult(NamedTuple):
    """Messages and rows of stress that were made; how much time the bag covers, s."""

    messages: int
    rows: int
    seconds: float


def reprocess(job: ReprocessJob) -> ReprocessResult:
    """Do one job. The output appears when it is complete.

    BagError: what is wrong with the bag, the overrides or the output.
    """
    # glibc's malloc keeps freed memory up to twice the largest block that it has given back. This
    # block makes it keep the arrays of the batches, which come again and again.
    np.empty(WORKING_BYTES, np.uint8)
    partial = job.output.parent / PARTIAL / job.output.name
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        if partial.is_dir():
            shutil.rmtree(partial)
        else:
            partial.unlink(missing_ok=True)
        with Bag(job.bag) as bag:
            result = _reprocess(bag, job, partial)
        partial.replace(job.output)
        with suppress(OSError):  # other jobs are at work in there
            partial.parent.rmdir()
    except OSError as error:
        raise BagError(
            f"{job.output}: {error.strerror}; name a folder that can be written"
        ) from None
    return result


def _reprocess(bag: Bag, job: ReprocessJob, output: Path) -> ReprocessResult:
    topics = bag.topics(FREQUENCIES)
    if not topics:
        raise BagError(f"{job.bag}: no topic of {FREQUENCIES}; record frequencies and info")
    if job.form != "bag" and len(topics) > 1:
        raise BagError(
            f"{job.bag}: {len(topics)} skins ({', '.join(topics)}); a table holds one: write a bag"
        )
    sources = [BagSource(bag, topic) for topic in topics]
    if job.form == "bag":
        _write_bag(sources, job.overrides, job.contacts, output)
    else:
        _write_table(sources[0], job.overrides, output)
    return ReprocessResult(
        sum(source.messages for source in sources),
        sum(source.rows for source in sources),
        (bag.end_ns - bag.start_ns) * 1e-9,
    )


def _write_bag(
    sources: list[BagSource],
    overrides: Overrides,
    contacts: ContactsOverTime | None,
    output: Path,
) -> None:
    with BagWriter(output) as writer:
        for source in sources:
            bag, skin = source.bag, source.topic.removesuffix("frequencies")
            settings = settings_with(source, overrides)
            writer.add_topic(f"{skin}info", INFO, [quality(latched=True)])
            writer.add_topic(f"{skin}stress", STRESS, [quality()])
            infos = list(_infos(source.recording.infos, settings))
            for info in infos:
                inside_ns = max(bag.start_ns, min(bag.end_ns, stamp_ns(info)))
                data = serialise(info)
                writer.write(f"{skin}info", inside_ns, data)
            touched = None if contacts is None else ContactWriter(writer, skin, contacts)
            for segment, stress in _reconstruct(source, settings, with_verdicts=not overrides.any):
                messages = segment.messages
                encoded = stress_codec.encode_many(stress, messages.stamp_ns, messages.frame_id)
                for time_ns, data in zip(segment.recorded_ns.tolist(), encoded, strict=True):
                    writer.write(f"{skin}stress", time_ns, data)
                if touched is not None:
                    touched.set_up(infos[segment.number])
                    touched.write(stress, messages, segment.recorded_ns)


def _write_table(source: BagSource, overrides: Overrides, output: Path) -> None:
    settings = settings_with(source, overrides)
    names = [cube.name for cube in source.skin.cubes]
    with make_table(output, [*names, "unknown"]) as table:
        for _, stress in _reconstruct(source, settings, with_verdicts=not overrides.any):
            table.write(stress)


def make_table(path: Path, cubes: list[str]) -> TableWriter | ZarrWriter:
    """A table in the format that the suffix says. ModuleNotFoundError: its library is missing."""
    if path.suffix == ".zarr":
        from ..zarr_table import ZarrWriter

        return ZarrWriter(path, cubes)
    return TableWriter(path, cubes)


def reconstruct(
    source: BagSource, overrides: Overrides = AS_RECORDED
) -> Iterator[tuple[Segment, StressRows]]:
    """The stress of each segment of a bag. BagError: damaged, or the overrides do not fit."""
    return _reconstruct(source, settings_with(source, overrides), with_verdicts=not overrides.any)


def _reconstruct(
    source: BagSource, settings: list[Settings], *, with_verdicts: bool
) -> Iterator[tuple[Segment, StressRows]]:
    """settings: for each info. with_verdicts: use those recorded; what was found bad under other
    settings need not be so under these."""
    number = -1
    ids: list[str] = []
    for segment in source.segments():
        rows = segment.messages.rows
        verdicts = source.recording.verdicts(rows) if with_verdicts else None
        try:
            if segment.number != number:
                number = segment.number
                now = settings[number]
                # Health remembers across a tare, but not across other calibrations.
                if ids != (ids := [one.id for one in now.calibrations]):
                    reconstructor = Reconstructor(now.calibrations)
                reconstructor.rest_frequency = now.rest_frequency
            if verdicts is not None and verdicts.known.all():
                stress = reconstructor.process_known(rows, verdicts)
            else:
                stress = reconstructor.process(rows, verdicts)
        except CubeError as error:
            raise BagError(f"{source.bag.path}: {source.topic}: {error}") from None
        yield segment, stress


def settings_with(source: BagSource, overrides: Overrides) -> list[Settings]:
    """The settings of each info of a bag, with what differs. BagError: it does not fit the bag."""
    recording = source.recording
    settings = recording.settings
    if overrides.skin is not None or overrides.calibration is not None:
        settings = [
            _recalibrated(source, info, recorded, overrides)
            for info, recorded in zip(recording.infos, settings, strict=True)
        ]
    if overrides.tare is not None:
        rest = _tared(source, settings[-1], *overrides.tare)
        settings = [replace(one, rest_frequency=rest) for one in settings]
    return settings


def _recalibrated(
    source: BagSource, info: Any, recorded: Settings, overrides: Overrides
) -> Settings:
    """Settings with the calibrations of the overrides."""
    path = source.bag.path
    if overrides.skin is not None:
        by_name = {cube.name: cube.calibration for cube in overrides.skin.cubes}
        missing = [cube.name for cube in info.cubes if cube.name not in by_name]
        if missing:
            raise BagError(
                f"{path}: the skin file {overrides.skin.name} has no cubes "
                f"{', '.join(missing[:NAMED])}; the bag has"
            )
        calibrations = [by_name[cube.name] for cube in info.cubes]
    else:
        calibrations = [overrides.calibration] * len(info.cubes)  # type: ignore[list-item]
    rest_frequency = recorded.rest_frequency.copy()
    for cube, old, new, rest in zip(
        info.cubes, recorded.calibrations, calibrations, rest_frequency, strict=True
    ):
        try:
            new.check(old.layout, cube.uid or None)
        except CalibrationError as error:
            raise BagError(f"{path}: cube {cube.name}: {error}") from None
        # A tare is a measurement and stays; without one the calibration says what no load is.
        pads = rest[: old.layout.n_pads]
        pads[:] = np.where(pads != old.rest_frequency, pads, new.rest_frequency)
    return Settings(tuple(calibrations), rest_frequency)


def _tared(
    source: BagSource, settings: Settings, begin_s: float, end_s: float
) -> NDArray[np.float64]:
    """(cubes, P) Hz: mean frequencies of all pads between two times, at the reference
    temperature."""
    bag = source.bag
    pipeline = Pipeline(settings.calibrations)
    exists = np.isfinite(settings.rest_frequency)
    total, count = np.zeros(exists.shape), np.zeros(exists.shape)
    begin_ns, end_ns = (bag.start_ns + round(time * 1e9) for time in (begin_s, end_s))
    for messages, _ in bag.frequencies(source.topic):
        rows = messages.rows
        inside = (rows.stamp_ns >= begin_ns) & (rows.stamp_ns < end_ns)
        rows = rows.select(inside & (rows.cube < len(exists)))
        if not len(rows):
            continue
        frequency = rows.frequency / pipeline.temperature_factor(rows.cube, rows.temperature)
        bad = rows.pad_fault[:, None] >> np.arange(frequency.shape[1]) & 1 > 0
        good = np.isfinite(frequency) & (frequency > 0) & ~bad
        np.add.at(total, rows.cube, np.where(good, frequency, 0))
        np.add.at(count, rows.cube, good)
    without = np.flatnonzero((exists & (count == 0)).any(axis=1))
    if len(without):
        names = ", ".join(source.skin.cubes[cube].name for cube in without[:NAMED])
        seconds = (bag.end_ns - bag.start_ns) * 1e-9
        raise BagError(
            f"{bag.path}: --tare-from {begin_s:g} {end_s:g}: not every pad of {names} was "
            f"measured in that time; the bag lasts from 0 to {seconds:.3f} s"
        )
    return np.where(exists, total / np.maximum(count, 1), np.nan)


def _infos(infos: list[Any], settings: list[Settings]) -> Iterator[Any]:
    """The recorded infos with other settings."""
    covariances: dict[str, NDArray[np.float64]] = {}
    for info, one in zip(infos, settings, strict=True):
        first = {
            calibration.id: number
            for number, calibration in reversed(list(enumerate(one.calibrations)))
        }
        if not first.keys() <= covariances.keys():
            pipeline = Pipeline(one.calibrations)
            covariances |= {key: pipeline.covariance(number) for key, number in first.items()}
        cubes = [
            replace(
                cube,
                calibration_id=calibration.id,
                half_side=calibration.half_side,
                rest_frequency=rest[: calibration.layout.n_pads],
            )
            for cube, calibration, rest in zip(
                info.cubes, one.calibrations, one.rest_frequency, strict=True
            )
        ]
        yield replace(
            info,
            sender="reconstruction",
            cubes=cubes,
            calibration_ids=list(first),
            calibrations=[calibration_text(one.calibrations[n]) for n in first.values()],
            covariance=np.array([covariances[key] for key in first]).ravel(),
        )
