# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Reprocessing of one bag: stress is computed again from its recorded frequencies.

The result is equal, bit by bit, to the stress that the reconstruction node published, unless other
calibrations or another tare (measurement without load) are chosen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...config.calibration import format_calibration
from ...config.skin import Skin
from ...core.arrays import Array
from ...core.calibration import Calibration
from ...core.compensation.compensation import Compensation
from ...core.errors import BagError, CalibrationError, CubeError
from ...core.pipeline import Pipeline
from ...core.reconstructor import Reconstructor
from ...core.rows import StressRows
from ...messages.codec import stress_codec
from ...messages.types import FREQUENCIES_TYPE, INFO_TYPE, STRESS_TYPE
from ..metadata import describe_quality
from ..read import Bag, read_stamp_ns, serialise
from ..recording import Settings, reconstruct_rows
from ..source import BagSource, Segment
from ..tables import BufferedTable, TableWriter, complete_output
from ..write import BagWriter

if TYPE_CHECKING:
    from ...msg import SkinInfo
    from .contacts import ContactOptions

MAX_NAMED_CUBES = 5
"""Largest number of cubes that one error message names."""


@dataclass(frozen=True)
class Overrides:
    """Calibrations and tare (rest frequencies) that replace those of a recording.

    None keeps what was recorded.

    Attributes:
        calibration: Calibration that is used for every cube.
        skin: Skin whose calibrations and elastomer are used. A recorded cube gets the calibration
            of the cube that has the same name in this skin. The recorded elastomer is kept if the
            skin states none.
        tare: Start and end of a time without load, in s after the start of the bag. The mean
            frequencies in it become the rest frequencies.
    """

    calibration: Calibration | None = None
    skin: Skin | None = None
    tare: tuple[float, float] | None = None


AS_RECORDED = Overrides()
"""Overrides that replace nothing, so that the recorded calibrations and tare (frequencies without
load) are used."""


@dataclass(frozen=True)
class ReprocessJob:
    """One bag to reprocess.

    Attributes:
        bag: Folder or file of the bag.
        output: Folder or file to write.
        form: Format of the output: bag, parquet, csv or zarr.
        overrides: Calibrations and tare that replace those of the recording.
        contacts: Options with which contacts are computed and written into an output bag; None: no
            contacts are computed.
    """

    bag: Path
    output: Path
    form: str
    overrides: Overrides = AS_RECORDED
    contacts: ContactOptions | None = None


class ReprocessResult(NamedTuple):
    """Amount of data that one job has reprocessed.

    Attributes:
        messages: Number of messages of stress that were computed.
        rows: Number of rows of stress (samples of cubes).
        seconds: Duration of the recording, in s.
        skipped: Number of recorded messages that were left out because they are damaged.
    """

    messages: int
    rows: int
    seconds: float
    skipped: int = 0


def reprocess(job: ReprocessJob) -> ReprocessResult:
    """Reprocess one bag. The output gets its final name only when it is complete.

    Raises:
        BagError: The bag is damaged, the overrides do not fit its cubes, or the output cannot be
            written.
    """
    with complete_output(job.output) as partial, Bag(job.bag) as bag:
        return _reprocess(bag, job, partial)


def make_table(path: Path, cubes: list[str]) -> BufferedTable:
    """Create a table of stress; the suffix of its path decides the format.

    Args:
        path: Table to create, ending in .zarr, .csv or .parquet.
        cubes: Names of the skin's cubes in the order of their indices, and one more name, which all
            rows with a higher index get.

    Raises:
        ModuleNotFoundError: The library zarr, which .zarr requires, is not installed.
        BagError: The table cannot be created.
    """
    if path.suffix == ".zarr":
        from ..zarr_table import ZarrWriter

        return ZarrWriter(path, cubes)
    return TableWriter(path, cubes)


def choose_settings(source: BagSource, overrides: Overrides) -> list[Settings]:
    """Return the calibrations and rest frequencies to use for each SkinInfo message of a bag.

    A rest frequency is the frequency of a pad without load, as a tare measures it.

    Args:
        source: The recorded frequencies with their SkinInfo messages.
        overrides: Calibrations and tare that replace those of the recording.

    Returns:
        The settings; without overrides, the list of the recorded ones itself.

    Raises:
        BagError: The overrides do not fit the cubes of the bag.
    """
    recording = source.recording
    settings = recording.settings
    if overrides.skin is not None or overrides.calibration is not None:
        settings = [
            _recalibrate(source, info, recorded, overrides)
            for info, recorded in zip(recording.infos, settings, strict=True)
        ]
    if overrides.tare is not None:
        rest = _measure_rest(source, settings[-1], *overrides.tare)
        settings = [replace(one, rest_frequency=rest) for one in settings]
    return settings


def reconstruct(
    source: BagSource,
    settings: list[Settings] | None = None,
) -> Iterator[tuple[Segment, StressRows]]:
    """Compute the stress of a bag from its recorded frequencies again.

    Args:
        source: The recorded frequencies.
        settings: Calibrations and rest frequencies for each SkinInfo message of the bag, as
            `choose_settings` returns them; None: the recorded ones.

    Yields:
        Each segment (consecutive messages of frequencies with the same cubes) and its stress.

    Raises:
        BagError: The bag is damaged.
    """
    for segment, stress, _ in _reconstruct(source, settings):
        yield segment, stress


def _reconstruct(
    source: BagSource,
    settings: list[Settings] | None,
    *,
    join: bool = True,
) -> Iterator[tuple[Segment, StressRows, Reconstructor]]:
    """Compute the stress of a bag as `reconstruct` does.

    Args:
        source: The recorded frequencies.
        settings: See `reconstruct`.
        join: Whether a segment may have several messages, which is faster. The stress is the same.

    Yields:
        Each segment, its stress, and the reconstructor that has computed it as the last one.
    """
    recorded = source.recording.settings
    settings = settings or recorded
    # With other settings than the recorded ones, other pads can be faulty, so the health of the
    # pads is determined anew.
    use_health = settings is recorded
    number = -1
    ids: list[str] = []
    refused: CubeError | None = None
    for segment in source.read_segments(use_health=use_health, join=join):
        if segment.number != number:
            number = segment.number
            current = settings[number]
            new_ids = [one.id for one in current.calibrations]
            # A tare changes only rest frequencies and must not reset the tracked health of the
            # pads. Therefore only other calibrations require a new reconstructor.
            if new_ids != ids:
                ids = new_ids
                reconstructor = Reconstructor(current.calibrations)
            reconstructor.rest_frequency = current.rest_frequency
        if use_health:
            reconstructor.compensation.restore(segment.states)
        try:
            stress = reconstruct_rows(
                reconstructor,
                segment.messages.rows,
                segment.health,
            )
        except CubeError as error:
            # These messages do not fit the skin, for example in the number of pads. The ROS node
            # leaves them out, too.
            refused = error
            source.skip(segment, error)
            continue
        yield segment, stress, reconstructor
    if refused is not None and not source.messages:
        raise BagError(f"{source.bag.path}: {source.topic}: {refused}")


def _reprocess(
    bag: Bag,
    job: ReprocessJob,
    output: Path,
) -> ReprocessResult:
    """Reconstruct all skins of a bag and write them in the format of the job.

    Args:
        bag: The open bag.
        job: Output format, overrides and options of contacts.
        output: Folder or file to write, which is renamed when it is complete.
    """
    topics = bag.list_topics(FREQUENCIES_TYPE)
    if not topics:
        raise BagError(f"{job.bag}: no topic of {FREQUENCIES_TYPE}; record frequencies and info")
    if job.form != "bag" and len(topics) > 1:
        raise BagError(
            f"{job.bag}: {len(topics)} skins ({', '.join(topics)}); a table holds one: write a bag"
        )
    # The constructor reads the SkinInfo messages of each skin. All are read before the output is
    # created, so that an invalid one leaves no output behind.
    sources = [BagSource(bag, topic) for topic in topics]
    if job.form == "bag":
        with BagWriter(output) as writer:
            for source in sources:
                _write_skin(source, job, writer)
    else:
        names = [cube.name for cube in sources[0].skin.cubes]
        with make_table(output, [*names, "unknown"]) as table:
            settings = choose_settings(sources[0], job.overrides)
            for _, stress in reconstruct(sources[0], settings):
                table.write(stress)
    return ReprocessResult(
        messages=sum(source.messages for source in sources),
        rows=sum(source.rows for source in sources),
        seconds=(bag.end_ns - bag.start_ns) * 1e-9,
        skipped=bag.skipped.total(),
    )


def _write_skin(
    source: BagSource,
    job: ReprocessJob,
    writer: BagWriter,
) -> None:
    """Write the SkinInfo messages, stress and, if the job has options for them, contacts of a skin.

    Args:
        source: The recorded frequencies of the skin.
        job: Job with the calibrations and tare that replace those of the recording (overrides), and
            with the options with which contacts are computed.
        writer: The bag to write into.
    """
    bag, skin = source.bag, source.topic.removesuffix("frequencies")
    settings = choose_settings(source, job.overrides)
    writer.add_topic(
        f"{skin}info",
        INFO_TYPE,
        [describe_quality(latched=True)],
    )
    writer.add_topic(f"{skin}stress", STRESS_TYPE, [describe_quality()])
    infos = list(_replace_settings(source.recording.infos, settings))
    for info in infos:
        # A SkinInfo message can be stamped before or after the recording. It is written at a time
        # within the recording, so that the output has the same start and end.
        inside_ns = min(bag.end_ns, read_stamp_ns(info))
        inside_ns = max(bag.start_ns, inside_ns)
        writer.write(f"{skin}info", inside_ns, serialise(INFO_TYPE, info))

    contacts = None
    if job.contacts is not None:
        # Importing the models of contacts takes longer than reprocessing a small bag.
        from .contacts import ContactWriter

        new_skin = job.overrides.skin
        elastomer = None if new_skin is None else new_skin.elastomer
        contacts = ContactWriter(
            writer,
            skin,
            job.contacts,
            elastomer,
        )
    # How uncertain contacts are depends on the state of the compensation after each message.
    join = contacts is None or not _is_compensated(source, settings)
    for segment, stress, reconstructor in _reconstruct(source, settings, join=join):
        messages = segment.messages
        encoded = stress_codec.encode(
            stress,
            messages.stamp_ns,
            messages.frame_id,
        )
        times_ns = segment.recorded_ns.tolist()
        for time_ns, data in zip(times_ns, encoded, strict=True):
            writer.write(f"{skin}stress", time_ns, data)
        if contacts is not None:
            contacts.set_up(infos[segment.number], reconstructor)
            contacts.write(stress, messages.stamp_ns.tolist(), times_ns)


def _is_compensated(source: BagSource, settings: list[Settings]) -> bool:
    """Return whether weight, creep or temperature may be subtracted from recorded frequencies.

    Args:
        source: The recorded frequencies.
        settings: Calibrations and rest frequencies for each SkinInfo message of the bag.
    """
    calibrations = [one for current in settings for one in current.calibrations]
    effects = [one.weight or one.creep or one.thermal for one in calibrations]
    return source.recording.compensation.is_recorded or any(effects)


def _recalibrate(
    source: BagSource,
    info: SkinInfo,
    recorded: Settings,
    overrides: Overrides,
) -> Settings:
    """Return recorded settings with the calibrations of the overrides instead of the recorded ones.

    Rest frequencies that a tare (measurement without load) found are kept.

    Args:
        source: The recorded frequencies. Errors name the bag that they come from.
        info: SkinInfo message with the names and uids of the cubes.
        recorded: Calibrations and rest frequencies in this message.
        overrides: Calibration of all cubes, or a skin with calibrations of the same cubes.

    Raises:
        BagError: The skin lacks a cube, or a calibration does not fit the layout or uid of a cube.
    """
    path = source.bag.path
    if overrides.skin is not None:
        by_name = {cube.name: cube.calibration for cube in overrides.skin.cubes}
        missing = [cube.name for cube in info.cubes if cube.name not in by_name]
        if missing:
            names = ", ".join(missing[:MAX_NAMED_CUBES])
            raise BagError(
                f"{path}: the skin file {overrides.skin.name} has no cubes {names}; the bag has"
            )
        calibrations = [by_name[cube.name] for cube in info.cubes]
    else:
        calibrations = [overrides.calibration] * len(info.cubes)  # type: ignore[list-item]

    rest_frequency = recorded.rest_frequency.copy()
    for cube, old, new, rest in zip(
        info.cubes,
        recorded.calibrations,
        calibrations,
        rest_frequency,
        strict=True,
    ):
        try:
            new.check(old.layout, cube.uid or None)
        except CalibrationError as error:
            raise BagError(f"{path}: cube {cube.name}: {error}") from None
        # A rest frequency that differs from the old calibration was measured by a tare (without
        # load) and is kept. An equal one came from the old calibration and is replaced.
        pads = rest[: old.layout.n_pads]
        pads[:] = np.where(
            pads != old.rest_frequency,
            pads,
            new.rest_frequency,
        )
    return Settings(tuple(calibrations), rest_frequency)


def _measure_rest(
    source: BagSource,
    settings: Settings,
    begin_s: float,
    end_s: float,
) -> Array:
    """Return the mean frequencies in a span of a bag in which nothing touched the skin.

    Args:
        source: The recorded frequencies.
        settings: Calibrations, which state the effect of temperature, and rest frequencies, whose
            NaN states which pads a cube does not have.
        begin_s: Start of the span, in s after the start of the bag.
        end_s: End of the span, in s after the start of the bag.

    Returns:
        (cubes, P) mean frequencies of the P pads, in Hz, converted to the reference temperature of
        the calibration; NaN where a cube has fewer than P pads.

    Raises:
        BagError: A pad has no valid frequency in the span.
    """
    bag = source.bag
    pipeline = Pipeline([replace(one, creep=None) for one in settings.calibrations])
    exists = np.isfinite(settings.rest_frequency)
    total = np.zeros(exists.shape)
    count = np.zeros(exists.shape)
    begin_ns = bag.start_ns + round(begin_s * 1e9)
    end_ns = bag.start_ns + round(end_s * 1e9)
    # Weight is compensated, so that the rest frequencies are valid in every pose of the skin.
    # Creep is not compensated, because only a load causes it, and a tare requires that there is no
    # load.
    compensation = Compensation(pipeline)
    for rows in BagSource(bag, source.topic):
        rows = rows.select(rows.cube < len(exists))
        cube = rows.cube.astype(np.intp)
        offset = np.zeros(rows.frequency.shape)
        out = pipeline.make_rows(rows)
        compensation.process(
            rows,
            None,
            watch=None,
            known=None,
            out=out,
            offset=offset,
        )
        inside = (rows.stamp_ns >= begin_ns) & (rows.stamp_ns < end_ns)
        rows = rows.select(inside)
        if not len(rows):
            continue
        cube = cube[inside]
        factor = pipeline.compute_unloaded_factor(
            cube,
            rows.temperature,
            offset[inside],
        )
        frequency = rows.frequency / factor
        pads = np.arange(frequency.shape[1])
        is_faulty = rows.pad_fault[:, np.newaxis] >> pads & 1 > 0
        is_valid = np.isfinite(frequency) & (frequency > 0)
        is_usable = is_valid & ~is_faulty
        usable = np.where(is_usable, frequency, 0)
        np.add.at(total, cube, usable)
        np.add.at(count, cube, is_usable)

    lacks_pads = (exists & (count == 0)).any(axis=1)
    unmeasured = np.flatnonzero(lacks_pads)
    if len(unmeasured):
        named = unmeasured[:MAX_NAMED_CUBES]
        names = ", ".join(source.skin.cubes[cube].name for cube in named)
        seconds = (bag.end_ns - bag.start_ns) * 1e-9
        raise BagError(
            f"{bag.path}: --tare-from {begin_s:g} {end_s:g}: not every pad of {names} was "
            f"measured in that time; the bag lasts from 0 to {seconds:.3f} s"
        )
    mean = total / np.maximum(count, 1)
    return np.where(exists, mean, np.nan)


def _replace_settings(
    infos: list[SkinInfo],
    settings: list[Settings],
) -> Iterator[SkinInfo]:
    """Yield the recorded SkinInfo messages with replaced calibrations and rest frequencies.

    A rest frequency is the frequency of a pad without load.

    Args:
        infos: The recorded SkinInfo messages.
        settings: Calibrations and rest frequencies for each of them.
    """
    covariances: dict[str, Array] = {}
    for info, current in zip(infos, settings, strict=True):
        # A SkinInfo message contains each calibration once, even if several cubes share it. The
        # calibration's text and covariance are taken from the first of these cubes.
        numbered = reversed(list(enumerate(current.calibrations)))
        first_cube = {calibration.id: number for number, calibration in numbered}
        if not first_cube.keys() <= covariances.keys():
            pipeline = Pipeline(current.calibrations)
            covariances |= {
                name: pipeline.compute_covariance(number) for name, number in first_cube.items()
            }
        cubes = [
            replace(
                cube,
                calibration_id=calibration.id,
                half_side=calibration.half_side,
                rest_frequency=rest[: calibration.layout.n_pads],
            )
            for cube, calibration, rest in zip(
                info.cubes,
                current.calibrations,
                current.rest_frequency,
                strict=True,
            )
        ]
        texts = [format_calibration(current.calibrations[cube]) for cube in first_cube.values()]
        covariance = np.array([covariances[name] for name in first_cube])
        yield replace(
            info,
            sender="reconstruction",
            cubes=cubes,
            calibration_ids=list(first_cube),
            calibrations=texts,
            covariance=covariance.ravel(),
        )
