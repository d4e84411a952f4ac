# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Programming errors that the checks of torture must find.

Each mutation is put into the process of a node when it starts; the nodes do not know of it. It
wraps or replaces one function. Most change the rows of a message just before it is sent.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import count
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from cube_tensor_driver.core.rows import FrequencyRows
from cube_tensor_driver.core.status import NOISY, OPEN, RESIDUAL, SHORT, STUCK
from cube_tensor_driver.device.scans.sequence import Arrival
from cube_tensor_driver.device.wire import decoder
from cube_tensor_driver.processes.skin_processes import Process

Patch = Callable[[], None]
"""Function that puts a mutation (deliberate programming error) into this process."""

RowsChange = Callable[[Any], Any]
"""Function that makes changed rows (`FrequencyRows` or `StressRows`) from the rows of one
message."""

ColumnChange = Callable[[Any], Any]
"""Function that makes the changed column (an array) of rows from the column as it should be."""

MESSAGES_PER_CHANGE = 200
"""Number of messages of which one is changed, by mutations that do not change all messages."""

CUBES_PER_HUB = 8
"""Number of cubes on each hub of the torture."""

NOISY_CUBE = 5
"""Number of the cube whose first pad the mutation `ghosts` flags although it works."""


class Mutation(NamedTuple):
    """A deliberate programming error that the checks must find.

    Attributes:
        node: Name of the node whose process is patched, "driver" or "reconstruction".
        patch: Function that puts the error into this process.
    """

    node: str
    patch: Patch


def mutated(process: Process, name: str) -> Process:
    """Return the process with a mutation, or as it is if the mutation is of another process."""
    if not name or MUTATIONS[name].node != process.executable:
        return process
    return replace(process, module=__name__, arguments=(name,))


def _replace(
    place: str,
    name: str,
    make: Callable[[Any], Any],
) -> Patch:
    """Replace an attribute of a class or module of the driver by one made from it.

    Args:
        place: Module below `cube_tensor_driver`, and the class in it behind a colon.
        name: Name of the attribute.
        make: Function of the attribute that returns its replacement.
    """

    def patch() -> None:
        # The place is imported only in the process of the node that is patched.
        owner = resolve_name(f"cube_tensor_driver.{place}")
        setattr(owner, name, make(getattr(owner, name)))

    return patch


def _wrap(
    place: str,
    name: str,
    mutate: Callable[..., Any],
) -> Patch:
    """Call mutate(original, self, ...) in place of a function (self, ...) of the driver."""

    def make(original: Any) -> Any:
        return lambda *arguments, **options: mutate(original, *arguments, **options)

    return _replace(place, name, make)


def _skip(place: str, name: str) -> Patch:
    """Do nothing in place of a function of the driver."""
    return _wrap(place, name, lambda *_, **__: None)


def _change_result(
    place: str,
    name: str,
    change: Callable[[Any], Any],
) -> Patch:
    """Change what a function of the driver returns."""

    def mutate(original: Any, *arguments: Any, **options: Any) -> Any:
        return change(original(*arguments, **options))

    return _wrap(place, name, mutate)


def _change_frequencies(change: RowsChange | None = None, **columns: ColumnChange) -> Patch:
    """Change the rows, or columns of them, of each message of frequencies."""
    change = change or partial(_change_columns, columns)

    def publish(original: Any, publisher: Any) -> None:
        if publisher._next is not None:
            rows = publisher._next.rows
            changed = change(rows)
            # The rows are views of the message, so they are changed in place.
            for name, column in rows.columns().items():
                column[:] = getattr(changed, name)
        original(publisher)

    return _wrap("ros.nodes.driver:FrequenciesPublisher", "publish", publish)


def _change_stress(change: RowsChange | None = None, **columns: ColumnChange) -> Patch:
    """Change the rows, or columns of them, of each message of stress."""
    change = change or partial(_change_columns, columns)

    def publish(original: Any, publisher: Any, rows: Any, *header: Any) -> None:
        original(publisher, change(rows), *header)

    return _wrap("ros.nodes.stress_publisher:StressPublisher", "publish", publish)


def _change_columns(changes: Mapping[str, ColumnChange], rows: Any) -> Any:
    """Change columns of rows, each by a function of its old values."""
    # A copy, because the change may be in place, and others still need the old values.
    columns = {name: make(np.array(getattr(rows, name))) for name, make in changes.items()}
    return replace(rows, **columns)


def _make_stale(name: str) -> RowsChange:
    """Give one of `MESSAGES_PER_CHANGE` messages a column of the message before."""
    numbers = count()
    last: list[Any] = []

    def change(rows: Any) -> Any:
        now = np.array(getattr(rows, name))
        before = last.pop() if last else now
        last.append(now)
        is_due = next(numbers) % MESSAGES_PER_CHANGE == 0
        # Messages around a cut have other numbers of rows.
        if not is_due or before.shape != now.shape:
            return rows
        return replace(rows, **{name: before})

    return change


def _repeat(place: str, times: int) -> Patch:
    """Publish one of `MESSAGES_PER_CHANGE` messages several times, or not at all."""
    numbers = count(1)

    def publish(original: Any, *arguments: Any) -> None:
        for _ in range(1 if next(numbers) % MESSAGES_PER_CHANGE else times):
            original(*arguments)

    return _wrap(place, "publish", publish)


def _drop_last_row() -> Patch:
    """Publish some messages without their last row, which the driver counts all the same."""
    numbers = count(1)

    def publish(original: Any, publisher: Any) -> None:
        message = publisher._next
        is_due = message is not None and next(numbers) % MESSAGES_PER_CHANGE == 0
        if is_due and len(message.rows) > 1:
            part = message.rows.select(slice(len(message.rows) - 1))
            # A message has a fixed number of rows, so a smaller one is made.
            publisher._next = publisher._make_buffer(len(part), part.frequency.shape[1])
            publisher._next.fill(part)
        original(publisher)

    return _wrap("ros.nodes.driver:FrequenciesPublisher", "publish", publish)


def _swap_pads(frequency: Any) -> Any:
    frequency[:, [0, 1]] = frequency[:, [1, 0]]
    return frequency


def _swap_cubes(rows: FrequencyRows) -> FrequencyRows:
    one = np.flatnonzero(rows.cube == 1)
    other = np.flatnonzero(rows.cube == 2)
    frequency = np.array(rows.frequency)
    # A message may have rows of only one of the two cubes.
    if len(one) == len(other):
        frequency[np.r_[one, other]] = frequency[np.r_[other, one]]
    return replace(rows, frequency=frequency)


def _swap_hubs(cube: Any) -> Any:
    other_hub = (cube + CUBES_PER_HUB) % (2 * CUBES_PER_HUB)
    return np.where(cube < 2 * CUBES_PER_HUB, other_hub, cube)


def _treat_as(found: Arrival, instead: Arrival) -> Patch:
    """Treat samples of one kind as another kind."""
    return _change_result(
        "device.scans.sequence:SampleAccount",
        "sample",
        lambda arrival: instead if arrival is found else arrival,
    )


def _ignore_checksums() -> None:
    """Let every frame count as one with the right checksum."""
    checksum = SimpleNamespace(crc32=lambda _: decoder._CRC_RESIDUE)
    _replace("device.wire.decoder", "zlib", lambda _: checksum)()
    # Only the decoder in Python has a checksum that can be replaced.
    _replace("device.links.link", "Decoder", lambda _: decoder.PythonDecoder)()


def _leave_thread(original: Any, *arguments: Any) -> None:
    # A daemon thread, so that the process can still end.
    threading.Thread(target=threading.Event().wait, daemon=True).start()
    original(*arguments)


def _swap_open_and_short(status: Any) -> Any:
    swapped = status & ~np.uint16(OPEN | SHORT)
    swapped |= np.where(status & OPEN, SHORT, 0).astype(np.uint16)
    return swapped | np.where(status & SHORT, OPEN, 0).astype(np.uint16)


def _transpose(gradient: Any) -> Any:
    matrices = gradient.reshape(-1, 3, 3)
    return matrices.transpose(0, 2, 1).reshape(-1, 9)


def _flag_nothing(
    original: Any,
    pipeline: Any,
    rows: FrequencyRows,
    *_: Any,
    **options: Any,
) -> Any:
    return original(pipeline, rows, np.zeros(len(rows), np.uint32), out=options["out"])


def _flag_sound_pad(
    original: Any,
    pipeline: Any,
    rows: FrequencyRows,
    left_out: Any = None,
    **options: Any,
) -> Any:
    stress = original(pipeline, rows, left_out, **options)
    flagged = rows.cube == NOISY_CUBE
    changed = original(pipeline, rows, stress.left_out | flagged.astype(np.uint32))
    return replace(changed, status=changed.status | stress.status | flagged * np.uint16(NOISY))


def _never_release(
    original: Any,
    conditions: Any,
    found: Any,
    came: Any,
) -> None:
    # `_recent` holds the conditions of the present window (row 0) and of those before it. What was
    # known becomes a condition of the window that ends, so that it does not age.
    kept = conditions.state | found
    original(conditions, found, came)
    conditions._recent[1] |= kept


def _use_bad_pads(
    original: Any,
    pipeline: Any,
    rows: FrequencyRows,
    left_out: Any = None,
    **options: Any,
) -> Any:
    wrong = original(pipeline, rows, np.zeros(len(rows), np.uint32))
    # Only the components are wrong: the row still states that pads are left out.
    right = original(pipeline, rows, left_out, **options)
    return replace(right, stress=wrong.stress, gradient=wrong.gradient)


def _undo_tare(original: Any, reconstructor: Any, *arguments: Any) -> Any:
    before = reconstructor.rest_frequency, reconstructor.rest_changes
    rest = original(reconstructor, *arguments)
    reconstructor.rest_frequency, reconstructor.rest_changes = before
    return rest


def _lengthen_windows() -> None:
    """Let windows of statistics last 2 s, and the latest row twice as long."""
    _replace("core.health.health", "WINDOW_NS", lambda _: 2_000_000_000)()
    _replace("core.health.health", "MAX_BACKWARD_NS", lambda _: 4_000_000_000)()


def _lose_silently() -> None:
    """Make the queues short, and let nobody count what they drop."""
    _replace("ros.qos", "MAX_PAUSE_S", lambda _: 0.1)()
    _skip("ros.diagnostics.reconstruction:LostMessages", "note_arrival")()


DRIVER: dict[str, Patch] = {
    # A row is dropped inside a message but counted as published.
    "lost row": _drop_last_row(),
    # 1 of 200 messages is not sent.
    "lost scan": _repeat("ros.nodes.driver:FrequenciesPublisher", 0),
    # 1 of 200 messages is sent twice.
    "scan twice": _repeat("ros.nodes.driver:FrequenciesPublisher", 2),
    # Two pads of each cube are swapped.
    "swapped pads": _change_frequencies(frequency=_swap_pads),
    # The readings of two cubes are swapped.
    "swapped cubes": _change_frequencies(_swap_cubes),
    # The cubes of two hubs are swapped.
    "swapped hubs": _change_frequencies(cube=_swap_hubs),
    # Frequencies are 1 ppm too high.
    "scaled": _change_frequencies(frequency=lambda f: f * np.float32(1 + 1e-6)),
    # Frequencies are in mHz.
    "millihertz": _change_frequencies(frequency=lambda f: 1000 * f),
    # Frequencies are rounded to 1 Hz.
    "rounded": _change_frequencies(frequency=np.rint),
    # 1 of 200 messages has the frequencies of the one before.
    "stale": _change_frequencies(_make_stale("frequency")),
    # A pad that was not measured reads 0 Hz.
    "zero": _change_frequencies(frequency=np.nan_to_num),
    # Stamps are 0.8 ms late.
    "late stamps": _change_frequencies(stamp_ns=lambda t: t + 800_000),
    # Stamps are 1 ms early.
    "early stamps": _change_frequencies(stamp_ns=lambda t: t - 1_000_000),
    # Stamps are the time of sending.
    "arrival stamps": _change_frequencies(stamp_ns=lambda t: np.full_like(t, time.time_ns())),
    # Sequence numbers are one too high.
    "sequence": _change_frequencies(sequence=lambda sequence: sequence + np.uint32(1)),
    # The temperature is 10 °C too high.
    "warm": _change_frequencies(temperature=lambda celsius: celsius + np.float32(10)),
    # The temperature is unknown.
    "no temperature": _change_frequencies(
        temperature=lambda celsius: np.full_like(celsius, np.nan)
    ),
    # The faults of pads that the hub reports are omitted.
    "no pad fault": _change_frequencies(pad_fault=np.zeros_like),
    # The faults of pads that the hub reports are given to the next cube.
    "other pad fault": _change_frequencies(pad_fault=lambda bits: np.roll(bits, 1)),
    # Samples that came twice are delivered twice.
    "duplicates": _treat_as(Arrival.DUPLICATE, Arrival.NEW),
    # Samples out of order are treated as duplicates.
    "late lost": _treat_as(Arrival.LATE, Arrival.DUPLICATE),
    # Samples lost on the way are not counted.
    "losses uncounted": _change_result(
        "device.scans.sequence:SampleAccount",
        "counters",
        lambda counters: {**counters, "lost_on_the_way": 0},
    ),
    # Checksums are not checked.
    "checksum": _ignore_checksums,
    # A new rate is not requested.
    "rate ignored": _skip("device.chain:LiveLinks", "set_rate"),
    # Each change of a link's state leaves a thread.
    "threads": _wrap("device.chain:LiveLinks", "_on_state", _leave_thread),
}
"""Patches of the driver by the name of the mutation; the comments say what each does wrong."""

RECONSTRUCTION: dict[str, Patch] = {
    # 1 of 200 messages of stress is not sent.
    "lost stress": _repeat("ros.nodes.stress_publisher:StressPublisher", 0),
    # 1 of 200 messages of stress is sent twice.
    "stress twice": _repeat("ros.nodes.stress_publisher:StressPublisher", 2),
    # Queues hold 0.1 s, and nobody counts what they drop.
    "losses unseen": _lose_silently,
    # Health finds and flags nothing.
    "blind": _wrap("core.pipeline:Pipeline", "process", _flag_nothing),
    # Health flags a sound pad.
    "ghosts": _wrap("core.pipeline:Pipeline", "process", _flag_sound_pad),
    # Stuck pads are not found.
    "never stuck": _change_result(
        "core.health.diagnosis:PadDiagnosis", "_find_stuck", np.zeros_like
    ),
    # Noisy pads are not found.
    "never noisy": _change_result(
        "core.health.diagnosis:PadDiagnosis", "_find_noisy", np.zeros_like
    ),
    # The status does not state that a pad is stuck.
    "no stuck bit": _change_stress(status=lambda status: status & ~np.uint16(STUCK)),
    # The status states short for open, and open for short.
    "open is short": _change_stress(status=_swap_open_and_short),
    # A pad is never used again.
    "for ever": _wrap("core.health.diagnosis:Conditions", "end_window", _never_release),
    # Windows of statistics last 2 s.
    "slow": _lengthen_windows,
    # The mask of pads that are left out is 0.
    "no mask": _change_stress(left_out=np.zeros_like),
    # The mask of pads that are left out names the next pad.
    "other mask": _change_stress(left_out=lambda mask: mask << np.uint32(1)),
    # Pads that are left out are used all the same.
    "mask unused": _wrap("core.pipeline:Pipeline", "process", _use_bad_pads),
    # The residual is 0.
    "no residual": _change_stress(residual=np.zeros_like),
    # The residual is doubled.
    "residual doubled": _change_stress(residual=lambda value: 2 * value),
    # The status states nothing about residuals.
    "no residual bit": _change_stress(status=lambda status: status & ~np.uint16(RESIDUAL)),
    # The components xx and zz are swapped.
    "swapped components": _change_stress(stress=lambda stress: stress[:, [2, 1, 0, 3, 4, 5]]),
    # The component zx has the other sign.
    "shear sign": _change_stress(stress=lambda stress: stress * [1, 1, 1, 1, -1, 1]),
    # Stress and gradient have the other sign: compression is positive.
    "pressure positive": _change_stress(stress=np.negative, gradient=np.negative),
    # Stress is in kPa.
    "kilopascal": _change_stress(stress=lambda stress: stress / 1e3),
    # Gradients are in Pa/mm.
    "per millimetre": _change_stress(gradient=lambda value: value / 1e3),
    # The matrix of gradients is transposed.
    "gradient transposed": _change_stress(gradient=_transpose),
    # Components that are not observed are 0.
    "unknown is zero": _change_stress(stress=np.nan_to_num, gradient=np.nan_to_num),
    # 1 of 200 messages has the stress of the one before.
    "stale stress": _change_stress(_make_stale("stress")),
    # The tensors of neighbours are swapped.
    "swapped tensors": _change_stress(stress=lambda stress: stress[::-1]),
    # Stress has stamps 1 ms later than its frequencies.
    "stress stamps": _change_stress(stamp_ns=lambda stamp_ns: stamp_ns + 1_000_000),
    # Stress has sequence numbers one higher.
    "stress sequence": _change_stress(sequence=lambda sequence: sequence + np.uint32(1)),
    # A component that is observed is marked as not observed.
    "observed": _change_stress(observed=lambda observed: observed & ~np.uint16(1)),
    # A tare gives rest frequencies 100 ppm too high.
    "wrong tare": _change_result(
        "core.reconstructor:Reconstructor", "measure_rest", lambda rest: (1 + 1e-4) * rest
    ),
    # A tare takes the frequencies of the next cube.
    "tare of others": _change_result(
        "core.reconstructor:Reconstructor",
        "measure_rest",
        lambda rest: np.roll(rest, 1, axis=0),
    ),
    # A tare changes nothing.
    "no tare": _wrap("core.reconstructor:Reconstructor", "tare", _undo_tare),
    # Clearing the tare changes nothing.
    "no clear": _skip("core.reconstructor:Reconstructor", "clear_tare"),
    # The covariance of single cubes is doubled.
    "covariance": _change_result(
        "ros.nodes.stress_publisher:CubeTopics",
        "_covariance",
        lambda covariance: 2 * covariance,
    ),
    # The topic of a cube has the tensor of another one.
    "other cube": _wrap(
        "ros.nodes.stress_publisher",
        "tensor_message",
        lambda original, header, rows, row, *others: original(header, rows, row - 1, *others),
    ),
    # A tare is not restored at the start.
    "tare not restored": _skip("ros.nodes.taring:Taring", "_restore_tare"),
}
"""Patches of the reconstruction by the name of the mutation; the comments say what each does
wrong."""

NEEDS_RESTART = ("tare not restored",)
"""Names of the mutations that show only when the reconstruction starts again."""

MUTATIONS: dict[str, Mutation] = {
    **{name: Mutation("driver", patch) for name, patch in DRIVER.items()},
    **{name: Mutation("reconstruction", patch) for name, patch in RECONSTRUCTION.items()},
}
"""All mutations by name."""


def main() -> None:
    """Run a node with a mutation: `python -m workshop.torture.mutations NAME --ros-args …`."""
    mutation = MUTATIONS[sys.argv.pop(1)]
    mutation.patch()
    resolve_name(f"cube_tensor_driver.ros.nodes.{mutation.node}").main()


if __name__ == "__main__":
    main()
