"""Programming errors that the checks of torture must find.

Each mutation is put into the process of a node when it starts; the nodes do not know of it. It
wraps or replaces one function. Most change the rows of a message just before it is sent.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import count
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

import numpy as np

from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.core.status import NOISY, OPEN, RESIDUAL, SHORT, STUCK
from cube_tensor_driver.device.scans.sequence import Arrival
from cube_tensor_driver.device.wire import decoder
from cube_tensor_driver.processes.skin_processes import Process

Patch = Callable[[], None]
"""Puts a mutation into this process."""

Rows = TypeVar("Rows", FrequencyRows, StressRows)

MESSAGES_PER_CHANGE = 200
"""Number of messages of which one is changed, where a mutation does not change all."""

CUBES_PER_HUB = 8
"""Number of cubes on each hub of the torture."""

NOISY_CUBE = 5
"""Cube of the skin that the mutation `ghosts` flags."""


class Mutation(NamedTuple):
    """A programming error.

    Attributes:
        node: Node whose process is patched.
        description: What it does wrong.
        patch: Function that puts it into the process.
        needs_restart: Whether it shows only when the reconstruction starts again.
    """

    node: str
    description: str
    patch: Patch
    needs_restart: bool = False


def mutated(process: Process, name: str) -> Process:
    """Return the process with a mutation, or as it is if the mutation is of another process."""
    if not name or MUTATIONS[name].node != process.executable:
        return process
    return Process(
        process.executable,
        __name__,
        True,
        process.parameters,
        (name,),
    )


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
    """Call mutate(original, self, ...) where the function (self, ...) was called."""

    def make(original: Any) -> Any:
        return lambda *arguments, **options: mutate(original, *arguments, **options)

    return _replace(place, name, make)


def _skip(place: str, name: str) -> Patch:
    """Do nothing where a function was called."""
    return _wrap(place, name, lambda *_, **__: None)


def _change_result(
    place: str,
    name: str,
    change: Callable[[Any], Any],
) -> Patch:
    """Change what a function returns."""

    def mutate(original: Any, *arguments: Any, **options: Any) -> Any:
        return change(original(*arguments, **options))

    return _wrap(place, name, mutate)


def _change_frequencies(change: Callable[[FrequencyRows], FrequencyRows]) -> Patch:
    """Change the rows of each message of frequencies."""

    def publish(original: Any, publisher: Any) -> None:
        if publisher._next is not None:
            rows = publisher._next.rows
            changed = change(rows)
            # The rows are views of the message, so they are changed in place.
            for field in fields(rows):
                getattr(rows, field.name)[:] = getattr(changed, field.name)
        original(publisher)

    return _wrap("ros.nodes.driver:FrequenciesPublisher", "publish", publish)


def _change_stress(change: Callable[[StressRows], StressRows]) -> Patch:
    """Change the rows of each message of stress."""

    def publish(original: Any, publisher: Any, rows: StressRows, *header: Any) -> None:
        original(publisher, change(rows), *header)

    return _wrap("ros.nodes.stress_publisher:StressPublisher", "publish", publish)


def _make_column_change(**changes: Callable[[Any], Any]) -> Callable[[Rows], Rows]:
    """Change columns of rows, each by a function of its old values."""

    def change(rows: Rows) -> Rows:
        columns = {}
        for name, make in changes.items():
            # A copy, because the change may be in place, and others still need the old values.
            columns[name] = make(np.array(getattr(rows, name)))
        return replace(rows, **columns)

    return change


def _change_frequency_columns(**changes: Callable[[Any], Any]) -> Patch:
    """Change columns of each message of frequencies."""
    return _change_frequencies(_make_column_change(**changes))


def _change_stress_columns(**changes: Callable[[Any], Any]) -> Patch:
    """Change columns of each message of stress."""
    return _change_stress(_make_column_change(**changes))


def _make_stale(name: str) -> Callable[[Rows], Rows]:
    """Give one of `MESSAGES_PER_CHANGE` messages a column of the message before."""
    numbers = count()
    last: list[Any] = []

    def change(rows: Rows) -> Rows:
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
    # A message may have rows of one of the cubes only.
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
    """Let every frame have the right checksum."""
    checksum = SimpleNamespace(crc32=lambda _: decoder._CRC_RESIDUE)
    _replace("device.wire.decoder", "zlib", lambda _: checksum)()
    # Only the decoder in Python has a checksum that can be replaced.
    _replace("device.links.link", "Decoder", lambda _: decoder.PythonDecoder)()


def _leave_thread(original: Any, *arguments: Any) -> None:
    # A daemon, so that the process can still end.
    threading.Thread(target=threading.Event().wait, daemon=True).start()
    original(*arguments)


def _swap_open_and_short(status: Any) -> Any:
    swapped = status & ~np.uint16(OPEN | SHORT)
    swapped |= np.where(status & OPEN, SHORT, 0).astype(np.uint16)
    return swapped | np.where(status & SHORT, OPEN, 0).astype(np.uint16)


def _transpose(gradient: Any) -> Any:
    matrices = gradient.reshape(-1, 3, 3)
    return matrices.transpose(0, 2, 1).reshape(-1, 9)


def _flag_sound_pad(
    original: Any,
    health: Any,
    rows: FrequencyRows,
) -> tuple[Any, Any]:
    left_out, status = original(health, rows)
    flagged = rows.cube == NOISY_CUBE
    return left_out | flagged.astype(np.uint32), status | (flagged * np.uint16(NOISY))


def _never_release(
    original: Any,
    conditions: Any,
    found: Any,
    came: Any,
) -> None:
    # `_recent` holds the conditions of the last windows, the newest first. They must not age.
    kept = conditions._recent[0] | found
    original(conditions, found, came)
    conditions._recent[0] |= kept


def _use_bad_pads(
    original: Any,
    pipeline: Any,
    rows: FrequencyRows,
    left_out: Any = None,
) -> Any:
    wrong = original(pipeline, rows, np.zeros(len(rows), np.uint32))
    # Only the components are wrong: the row still states that pads are left out.
    right = original(pipeline, rows, left_out)
    return replace(right, stress=wrong.stress, gradient=wrong.gradient)


def _undo_tare(original: Any, reconstructor: Any, *arguments: Any) -> Any:
    before = reconstructor.rest_frequency, reconstructor.rest_changes
    rest = original(reconstructor, *arguments)
    reconstructor.rest_frequency, reconstructor.rest_changes = before
    return rest


def _lose_silently() -> None:
    """Make the queues short, and let nobody count what they drop."""
    _replace("ros.qos", "MAX_PAUSE_S", lambda _: 0.1)()
    _skip("ros.diagnostics.reconstruction:LostMessages", "note_arrival")()


DRIVER: dict[str, tuple[str, Patch]] = {
    "lost row": (
        "a row is dropped inside a message but counted as published",
        _drop_last_row(),
    ),
    "lost scan": (
        "1 of 200 messages is not sent",
        _repeat("ros.nodes.driver:FrequenciesPublisher", 0),
    ),
    "scan twice": (
        "1 of 200 messages is sent twice",
        _repeat("ros.nodes.driver:FrequenciesPublisher", 2),
    ),
    "swapped pads": (
        "two pads of each cube are swapped",
        _change_frequency_columns(frequency=_swap_pads),
    ),
    "swapped cubes": (
        "the readings of two cubes are swapped",
        _change_frequencies(_swap_cubes),
    ),
    "swapped hubs": (
        "the cubes of two hubs are swapped",
        _change_frequency_columns(cube=_swap_hubs),
    ),
    "scaled": (
        "frequencies are 1 ppm too high",
        _change_frequency_columns(frequency=lambda f: f * np.float32(1 + 1e-6)),
    ),
    "millihertz": (
        "frequencies are in mHz",
        _change_frequency_columns(frequency=lambda f: 1000 * f),
    ),
    "rounded": ("frequencies are rounded to 1 Hz", _change_frequency_columns(frequency=np.rint)),
    "stale": (
        "1 of 200 messages has the frequencies of the one before",
        _change_frequencies(_make_stale("frequency")),
    ),
    "zero": (
        "a pad that was not measured reads 0 Hz",
        _change_frequency_columns(frequency=np.nan_to_num),
    ),
    "late stamps": (
        "stamps are 0.8 ms late",
        _change_frequency_columns(stamp_ns=lambda t: t + 800_000),
    ),
    "early stamps": (
        "stamps are 1 ms early",
        _change_frequency_columns(stamp_ns=lambda t: t - 1_000_000),
    ),
    "arrival stamps": (
        "stamps are the time of sending",
        _change_frequency_columns(stamp_ns=lambda t: np.full_like(t, time.time_ns())),
    ),
    "sequence": (
        "sequence numbers are one too high",
        _change_frequency_columns(sequence=lambda sequence: sequence + np.uint32(1)),
    ),
    "warm": (
        "the temperature is 10 °C too high",
        _change_frequency_columns(temperature=lambda celsius: celsius + np.float32(10)),
    ),
    "no temperature": (
        "the temperature is unknown",
        _change_frequency_columns(temperature=lambda celsius: np.full_like(celsius, np.nan)),
    ),
    "no pad fault": (
        "the faults of pads that the hub reports are omitted",
        _change_frequency_columns(pad_fault=np.zeros_like),
    ),
    "other pad fault": (
        "the faults of pads that the hub reports are given to the next cube",
        _change_frequency_columns(pad_fault=lambda bits: np.roll(bits, 1)),
    ),
    "duplicates": (
        "samples that came twice are delivered twice",
        _treat_as(Arrival.DUPLICATE, Arrival.NEW),
    ),
    "late lost": (
        "samples out of order are treated as duplicates",
        _treat_as(Arrival.LATE, Arrival.DUPLICATE),
    ),
    "losses uncounted": (
        "samples lost on the way are not counted",
        _change_result(
            "device.scans.sequence:SampleAccount",
            "counters",
            lambda counters: {**counters, "lost_on_the_way": 0},
        ),
    ),
    "checksum": ("checksums are not checked", _ignore_checksums),
    "rate ignored": ("a new rate is not requested", _skip("device.chain:LiveLinks", "set_rate")),
    "threads": (
        "each change of a link's state leaves a thread",
        _wrap("device.chain:LiveLinks", "_on_state", _leave_thread),
    ),
}
"""Errors of the driver: description and patch by name."""

RECONSTRUCTION: dict[str, tuple[str, Patch]] = {
    "lost stress": (
        "1 of 200 messages of stress is not sent",
        _repeat("ros.nodes.stress_publisher:StressPublisher", 0),
    ),
    "stress twice": (
        "1 of 200 messages of stress is sent twice",
        _repeat("ros.nodes.stress_publisher:StressPublisher", 2),
    ),
    "losses unseen": ("queues hold 0.1 s, and nobody counts what they drop", _lose_silently),
    "blind": (
        "health finds and flags nothing",
        _change_result(
            "core.health.health:Health", "update", lambda flags: tuple(map(np.zeros_like, flags))
        ),
    ),
    "ghosts": (
        "health flags a sound pad",
        _wrap("core.health.health:Health", "update", _flag_sound_pad),
    ),
    "never stuck": (
        "stuck pads are not found",
        _change_result("core.health.diagnosis:PadDiagnosis", "_find_stuck", np.zeros_like),
    ),
    "never noisy": (
        "noisy pads are not found",
        _change_result("core.health.diagnosis:PadDiagnosis", "_find_noisy", np.zeros_like),
    ),
    "no stuck bit": (
        "the status does not state that a pad is stuck",
        _change_stress_columns(status=lambda status: status & ~np.uint16(STUCK)),
    ),
    "open is short": (
        "the status states short for open, and open for short",
        _change_stress_columns(status=_swap_open_and_short),
    ),
    "for ever": (
        "a pad is never used again",
        _wrap("core.health.diagnosis:Conditions", "end_window", _never_release),
    ),
    "slow": (
        "windows of statistics last 2 s",
        _replace("core.health.health", "WINDOW_NS", lambda _: 2_000_000_000),
    ),
    "no mask": ("left_out is 0", _change_stress_columns(left_out=np.zeros_like)),
    "other mask": (
        "left_out names the next pad",
        _change_stress_columns(left_out=lambda mask: mask << np.uint32(1)),
    ),
    "mask unused": (
        "left-out pads are used",
        _wrap("core.pipeline:Pipeline", "process", _use_bad_pads),
    ),
    "no residual": ("the residual is 0", _change_stress_columns(residual=np.zeros_like)),
    "residual doubled": (
        "the residual is doubled",
        _change_stress_columns(residual=lambda value: 2 * value),
    ),
    "no residual bit": (
        "the status states nothing about residuals",
        _change_stress_columns(status=lambda status: status & ~np.uint16(RESIDUAL)),
    ),
    "swapped components": (
        "xx and zz are swapped",
        _change_stress_columns(stress=lambda stress: stress[:, [2, 1, 0, 3, 4, 5]]),
    ),
    "shear sign": (
        "zx has the other sign",
        _change_stress_columns(stress=lambda stress: stress * [1, 1, 1, 1, -1, 1]),
    ),
    "pressure positive": (
        "compression is positive",
        _change_stress_columns(stress=np.negative, gradient=np.negative),
    ),
    "kilopascal": ("stress is in kPa", _change_stress_columns(stress=lambda stress: stress / 1e3)),
    "per millimetre": (
        "gradients are in Pa/mm",
        _change_stress_columns(gradient=lambda value: value / 1e3),
    ),
    "gradient transposed": (
        "gradients have columns for rows",
        _change_stress_columns(gradient=_transpose),
    ),
    "unknown is zero": (
        "components that are not observed are 0",
        _change_stress_columns(stress=np.nan_to_num, gradient=np.nan_to_num),
    ),
    "stale stress": (
        "1 of 200 messages has the stress of the one before",
        _change_stress(_make_stale("stress")),
    ),
    "swapped tensors": (
        "the tensors of neighbours are swapped",
        _change_stress_columns(stress=lambda stress: stress[::-1]),
    ),
    "stress stamps": (
        "stress has stamps 1 ms later than its frequencies",
        _change_stress_columns(stamp_ns=lambda stamp_ns: stamp_ns + 1_000_000),
    ),
    "stress sequence": (
        "stress has sequence numbers one higher",
        _change_stress_columns(sequence=lambda sequence: sequence + np.uint32(1)),
    ),
    "observed": (
        "a component that is observed is marked as not observed",
        _change_stress_columns(observed=lambda observed: observed & ~np.uint16(1)),
    ),
    "wrong tare": (
        "a tare gives rest frequencies 100 ppm too high",
        _change_result(
            "core.reconstructor:Reconstructor", "measure_rest", lambda rest: (1 + 1e-4) * rest
        ),
    ),
    "tare of others": (
        "a tare takes the frequencies of the next cube",
        _change_result(
            "core.reconstructor:Reconstructor",
            "measure_rest",
            lambda rest: np.roll(rest, 1, axis=0),
        ),
    ),
    "no tare": (
        "a tare changes nothing",
        _wrap("core.reconstructor:Reconstructor", "tare", _undo_tare),
    ),
    "no clear": (
        "clearing the tare changes nothing",
        _skip("core.reconstructor:Reconstructor", "clear_tare"),
    ),
    "covariance": (
        "the covariance of single cubes is doubled",
        _change_result(
            "ros.nodes.stress_publisher:CubeTopics",
            "_covariance",
            lambda covariance: 2 * covariance,
        ),
    ),
    "other cube": (
        "the topic of a cube has the tensor of another one",
        _wrap(
            "ros.nodes.stress_publisher",
            "tensor_message",
            lambda original, header, rows, row, *others: original(header, rows, row - 1, *others),
        ),
    ),
}
"""Errors of the reconstruction: description and patch by name."""

RESTARTED: dict[str, tuple[str, Patch]] = {
    "tare not restored": (
        "a tare is not restored at the start",
        _skip("ros.nodes.taring:Taring", "_restore_tare"),
    ),
}
"""Errors of the reconstruction that show only when it starts again."""

MUTATIONS: dict[str, Mutation] = {
    **{name: Mutation("driver", *rest) for name, rest in DRIVER.items()},
    **{name: Mutation("reconstruction", *rest) for name, rest in RECONSTRUCTION.items()},
    **{name: Mutation("reconstruction", *rest, True) for name, rest in RESTARTED.items()},
}
"""All mutations by name."""


def main() -> None:
    """Run a node with a mutation: `python -m workshop.torture.mutations NAME --ros-args …`."""
    mutation = MUTATIONS[sys.argv.pop(1)]
    mutation.patch()
    resolve_name(f"cube_tensor_driver.ros.nodes.{mutation.node}").main()


if __name__ == "__main__":
    main()
