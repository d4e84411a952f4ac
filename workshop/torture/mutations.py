"""Faults of the program that the judge of torture must find. Each is put into a node's process when
it starts, and into nothing else: the nodes know nothing of them.

A mutation wraps or replaces one function. Most change the rows of a message just before it is sent.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace as with_fields
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from cube_tensor_driver.core.health import health
from cube_tensor_driver.core.health.diagnosis import Conditions, PadDiagnosis
from cube_tensor_driver.core.health.health import Health
from cube_tensor_driver.core.pipeline import Pipeline
from cube_tensor_driver.core.reconstructor import Reconstructor
from cube_tensor_driver.core.rows import FrequencyRows, StressRows
from cube_tensor_driver.core.status import NOISY, OPEN, RESIDUAL, SHORT, STUCK
from cube_tensor_driver.device.chain import LiveLinks
from cube_tensor_driver.device.links import link
from cube_tensor_driver.device.scans.sequence import Arrival, SampleAccount
from cube_tensor_driver.device.wire import decoder
from cube_tensor_driver.processes.skin_processes import Process
from cube_tensor_driver.ros import qos
from cube_tensor_driver.ros.diagnostics.reconstruction import LostMessages
from cube_tensor_driver.ros.nodes import stress_publisher
from cube_tensor_driver.ros.nodes.driver import FrequenciesPublisher
from cube_tensor_driver.ros.nodes.stress_publisher import CubeTopics, StressPublisher
from cube_tensor_driver.ros.nodes.taring import Taring

Patch = Callable[[], None]
SELDOM = 200
"""Of so many messages one is changed, where a mutation does not change all."""
EACH = 8
"""Cubes of a hub."""


class Mutation(NamedTuple):
    """node: whose process is patched; what: it does wrong; needs_restart: it shows only when the
    reconstruction starts again."""

    node: str
    what: str
    patch: Patch
    needs_restart: bool = False


def mutated(process: Process, name: str) -> Process:
    """A process with a mutation, if it is of this process; else the process as it is."""
    if not name or MUTATIONS[name].node != process.executable:
        return process
    module = "workshop.torture.mutated_node"
    return Process(process.executable, module, True, process.parameters, (name,))


def _around(owner: Any, name: str, mutate: Callable[..., Any]) -> Patch:
    """Call mutate(original, self, ...) where owner.name(self, ...) was called."""

    def patch() -> None:
        original = getattr(owner, name)

        def mutant(*arguments: Any, **options: Any) -> Any:
            return mutate(original, *arguments, **options)

        setattr(owner, name, mutant)

    return patch


def _frequencies(change: Callable[[FrequencyRows, int], None]) -> Patch:
    """Change the rows of each message of frequencies in place; change(rows, message number)."""
    numbers = count()

    def publish(original: Any, publisher: Any) -> None:
        if publisher._next is not None:
            change(publisher._next.rows, next(numbers))
        original(publisher)

    return _around(FrequenciesPublisher, "publish", publish)


def _stress(change: Callable[[StressRows, int], StressRows]) -> Patch:
    """Publish other rows of stress; change(rows, message number)."""
    numbers = count()

    def publish(original: Any, publisher: Any, rows: StressRows, *header: Any) -> None:
        original(publisher, change(rows, next(numbers)), *header)

    return _around(StressPublisher, "publish", publish)


def _repeated(owner: Any, times: int) -> Patch:
    """Publish one of SELDOM messages so many times."""
    numbers = count(1)

    def publish(original: Any, *arguments: Any) -> None:
        for _ in range(1 if next(numbers) % SELDOM else times):
            original(*arguments)

    return _around(owner, "publish", publish)


def _drop_last_row(original: Any, publisher: Any, numbers: Any = count(1)) -> None:  # noqa: B008
    """Publish one of SELDOM messages without its last row; the driver counts it all the same."""
    message = publisher._next
    if message is not None and next(numbers) % SELDOM == 0 and len(message.rows) > 1:
        whole = message.rows
        part = whole.select(slice(len(whole) - 1))
        smaller = publisher._make_buffer(len(part), part.frequency.shape[1])
        smaller.fill(part)
        publisher._next = smaller
    original(publisher)


def _swap_pads(rows: FrequencyRows, _: int) -> None:
    rows.frequency[:, [0, 1]] = rows.frequency[:, [1, 0]]


def _swap_cubes(rows: FrequencyRows, _: int) -> None:
    one, other = np.flatnonzero(rows.cube == 1), np.flatnonzero(rows.cube == 2)
    if len(one) == len(other):
        rows.frequency[np.r_[one, other]] = rows.frequency[np.r_[other, one]]


def _swap_hubs(rows: FrequencyRows, _: int) -> None:
    swapped = rows.cube < 2 * EACH
    rows.cube[swapped] = (rows.cube[swapped] + EACH) % (2 * EACH)


def _scale(rows: FrequencyRows, _: int) -> None:
    rows.frequency[:] *= np.float32(1 + 1e-6)


def _to_millihertz(rows: FrequencyRows, _: int) -> None:
    rows.frequency[:] *= np.float32(1e3)


def _round(rows: FrequencyRows, _: int) -> None:
    np.rint(rows.frequency, out=rows.frequency)


def _stale_frequencies() -> Callable[[FrequencyRows, int], None]:
    before: list[np.ndarray] = []

    def change(rows: FrequencyRows, number: int) -> None:
        now = rows.frequency.copy()
        if number % SELDOM == 0 and before and before[0].shape == now.shape:
            rows.frequency[:] = before[0]
        before[:] = [now]

    return change


def _zero_for_nothing(rows: FrequencyRows, _: int) -> None:
    rows.frequency[np.isnan(rows.frequency)] = 0.0


def _late(milliseconds: float) -> Callable[[FrequencyRows, int], None]:
    def change(rows: FrequencyRows, _: int) -> None:
        rows.stamp_ns[:] += round(1e6 * milliseconds)

    return change


def _stamp_arrival(rows: FrequencyRows, _: int) -> None:
    rows.stamp_ns[:] = time.time_ns()


def _next_sequence(rows: FrequencyRows, _: int) -> None:
    rows.sequence[:] += np.uint32(1)


def _warmer(rows: FrequencyRows, _: int) -> None:
    rows.temperature[:] += np.float32(10)


def _no_temperature(rows: FrequencyRows, _: int) -> None:
    rows.temperature[:] = np.nan


def _no_pad_fault(rows: FrequencyRows, _: int) -> None:
    rows.pad_fault[:] = 0


def _next_pad_fault(rows: FrequencyRows, _: int) -> None:
    rows.pad_fault[:] = np.roll(rows.pad_fault, 1)


def _take_as(found: Arrival, instead: Arrival) -> Patch:
    """Samples of one kind are taken for another kind."""

    def sample(original: Any, account: Any, frame: Any) -> Arrival:
        arrival: Arrival = original(account, frame)
        return instead if arrival is found else arrival

    return _around(SampleAccount, "sample", sample)


def _no_losses(original: Any, account: Any) -> dict[str, int]:
    return {**original(account), "lost_on_the_way": 0}


def _believe_checksums() -> None:
    class Zlib:
        @staticmethod
        def crc32(_: bytes) -> int:
            return decoder._CRC_RESIDUE

    decoder.zlib = Zlib  # type: ignore[assignment]
    link.Decoder = decoder.PythonDecoder  # type: ignore[assignment]


def _leave_threads(original: Any, *arguments: Any) -> None:
    threading.Thread(target=threading.Event().wait, daemon=True).start()
    original(*arguments)


def _columns(**change: Callable[[Any], Any]) -> Callable[[StressRows, int], StressRows]:
    """Change fields of rows of stress, by name."""

    def changed(rows: StressRows, _: int) -> StressRows:
        fields = {name: make(np.array(getattr(rows, name))) for name, make in change.items()}
        return with_fields(rows, **fields)

    return changed


def _stale_stress() -> Callable[[StressRows, int], StressRows]:
    before: list[np.ndarray] = []

    def change(rows: StressRows, number: int) -> StressRows:
        now = np.array(rows.stress)
        old = before[0] if before else now
        before[:] = [now]
        return (
            with_fields(rows, stress=old) if number % SELDOM == 0 and len(old) == len(now) else rows
        )

    return change


def _swap_bits(status: np.ndarray, one: int, other: int) -> np.ndarray:
    swapped = status & ~np.uint16(one | other)
    swapped |= np.where(status & one, other, 0).astype(np.uint16)
    return swapped | np.where(status & other, one, 0).astype(np.uint16)


def _see_nothing(original: Any, self: Any, rows: FrequencyRows) -> tuple[Any, Any]:
    original(self, rows)
    return np.zeros(len(rows), np.uint32), np.zeros(len(rows), np.uint16)


def _see_ghosts(original: Any, self: Any, rows: FrequencyRows) -> tuple[Any, Any]:
    left_out, status = original(self, rows)
    ghost = rows.cube == 5
    return left_out | ghost.astype(np.uint32), status | (ghost * np.uint16(NOISY))


def _never_found(original: Any, self: Any, *arguments: Any) -> Any:
    return np.zeros_like(original(self, *arguments))


def _keep_for_ever(original: Any, self: Any, found: np.ndarray, came: np.ndarray) -> None:
    kept = self._recent[0] | found
    original(self, found, came)
    self._recent[0] |= kept


def _slow_windows() -> None:
    health.WINDOW_NS = 2_000_000_000


def _use_bad_pads(original: Any, self: Any, rows: FrequencyRows, left_out: Any = None) -> Any:
    wrong = original(self, rows, np.zeros(len(rows), np.uint32))
    right = original(self, rows, left_out)
    return with_fields(right, stress=wrong.stress, gradient=wrong.gradient)


def _no_tare(original: Any, self: Any, *arguments: Any) -> Any:
    before, changes = self.rest_frequency, self.rest_changes
    rest = original(self, *arguments)
    self.rest_frequency, self.rest_changes = before, changes
    return rest


def _short_queue() -> None:
    qos.MAX_PAUSE_S = 0.1
    _around(LostMessages, "note_arrival", _nothing)()


def _nothing(*_: Any) -> None:
    """Instead of what should be done."""


DRIVER: dict[str, tuple[str, Patch]] = {
    "lost row": (
        "a row is dropped inside a message but counted as published",
        _around(FrequenciesPublisher, "publish", _drop_last_row),
    ),
    "lost scan": ("1 of 200 messages is not sent", _repeated(FrequenciesPublisher, 0)),
    "scan twice": ("1 of 200 messages is sent twice", _repeated(FrequenciesPublisher, 2)),
    "swapped pads": ("two pads of each cube are swapped", _frequencies(_swap_pads)),
    "swapped cubes": ("the readings of two cubes are swapped", _frequencies(_swap_cubes)),
    "swapped hubs": ("the cubes of two hubs are swapped", _frequencies(_swap_hubs)),
    "scaled": ("frequencies are 1 ppm too high", _frequencies(_scale)),
    "millihertz": ("frequencies are in mHz", _frequencies(_to_millihertz)),
    "rounded": ("frequencies are rounded to 1 Hz", _frequencies(_round)),
    "stale": (
        "1 of 200 messages has the frequencies of the one before",
        _frequencies(_stale_frequencies()),
    ),
    "zero": ("a pad that was not measured reads 0 Hz", _frequencies(_zero_for_nothing)),
    "late stamps": ("stamps are 0.8 ms late", _frequencies(_late(0.8))),
    "early stamps": ("stamps are 1 ms early", _frequencies(_late(-1.0))),
    "arrival stamps": ("stamps are the time of sending", _frequencies(_stamp_arrival)),
    "sequence": ("sequence numbers are one too high", _frequencies(_next_sequence)),
    "warm": ("the temperature is 10 °C too high", _frequencies(_warmer)),
    "no temperature": ("the temperature is unknown", _frequencies(_no_temperature)),
    "no pad fault": ("what the hub reports of pads is left out", _frequencies(_no_pad_fault)),
    "other pad fault": (
        "what the hub reports of pads goes to the next cube",
        _frequencies(_next_pad_fault),
    ),
    "duplicates": (
        "samples that came twice are delivered twice",
        _take_as(Arrival.DUPLICATE, Arrival.NEW),
    ),
    "late lost": (
        "samples out of order are taken for duplicates",
        _take_as(Arrival.LATE, Arrival.DUPLICATE),
    ),
    "losses uncounted": (
        "samples lost on the way are not counted",
        _around(SampleAccount, "counters", _no_losses),
    ),
    "checksum": ("checksums are not looked at", _believe_checksums),
    "rate ignored": ("a new rate is not asked for", _around(LiveLinks, "set_rate", _nothing)),
    "threads": (
        "each change of a link's state leaves a thread",
        _around(LiveLinks, "_on_state", _leave_threads),
    ),
}
RECONSTRUCTION: dict[str, tuple[str, Patch]] = {
    "lost stress": ("1 of 200 messages of stress is not sent", _repeated(StressPublisher, 0)),
    "stress twice": ("1 of 200 messages of stress is sent twice", _repeated(StressPublisher, 2)),
    "losses unseen": ("queues hold 0.1 s, and nobody counts what they drop", _short_queue),
    "blind": ("health finds and flags nothing", _around(Health, "update", _see_nothing)),
    "ghosts": ("health flags a sound pad", _around(Health, "update", _see_ghosts)),
    "never stuck": ("stuck pads are not found", _around(PadDiagnosis, "_find_stuck", _never_found)),
    "never noisy": ("noisy pads are not found", _around(PadDiagnosis, "_find_noisy", _never_found)),
    "no stuck bit": (
        "the status does not say that a pad is stuck",
        _stress(_columns(status=lambda status: status & ~np.uint16(STUCK))),
    ),
    "open is short": (
        "the status says short for open, and open for short",
        _stress(_columns(status=lambda status: _swap_bits(status, OPEN, SHORT))),
    ),
    "for ever": ("a pad is never taken back", _around(Conditions, "end_window", _keep_for_ever)),
    "slow": ("windows of statistics last 2 s", _slow_windows),
    "no mask": ("left_out is 0", _stress(_columns(left_out=np.zeros_like))),
    "other mask": (
        "left_out names the next pad",
        _stress(_columns(left_out=lambda mask: mask << np.uint32(1))),
    ),
    "mask unused": ("left-out pads are used", _around(Pipeline, "process", _use_bad_pads)),
    "no residual": ("the residual is 0", _stress(_columns(residual=np.zeros_like))),
    "residual doubled": (
        "the residual is doubled",
        _stress(_columns(residual=lambda residual: 2 * residual)),
    ),
    "no residual bit": (
        "the status says nothing of residuals",
        _stress(_columns(status=lambda status: status & ~np.uint16(RESIDUAL))),
    ),
    "swapped components": (
        "xx and zz are swapped",
        _stress(_columns(stress=lambda stress: stress[:, [2, 1, 0, 3, 4, 5]])),
    ),
    "shear sign": (
        "zx has the other sign",
        _stress(_columns(stress=lambda stress: stress * [1, 1, 1, 1, -1, 1])),
    ),
    "pressure positive": (
        "compression is positive",
        _stress(_columns(stress=np.negative, gradient=np.negative)),
    ),
    "kilopascal": ("stress is in kPa", _stress(_columns(stress=lambda stress: stress / 1e3))),
    "per millimetre": (
        "gradients are in Pa/mm",
        _stress(_columns(gradient=lambda gradient: gradient / 1e3)),
    ),
    "gradient transposed": (
        "gradients have columns for rows",
        _stress(_columns(gradient=lambda g: g.reshape(-1, 3, 3).transpose(0, 2, 1).reshape(-1, 9))),
    ),
    "unknown is zero": (
        "components that are not observed are 0",
        _stress(_columns(stress=np.nan_to_num, gradient=np.nan_to_num)),
    ),
    "stale stress": (
        "1 of 200 messages has the stress of the one before",
        _stress(_stale_stress()),
    ),
    "swapped tensors": (
        "the tensors of neighbours are swapped",
        _stress(_columns(stress=lambda stress: stress[::-1])),
    ),
    "stress stamps": (
        "stress has stamps 1 ms later than its frequencies",
        _stress(_columns(stamp_ns=lambda stamp_ns: stamp_ns + 1_000_000)),
    ),
    "stress sequence": (
        "stress has sequence numbers one higher",
        _stress(_columns(sequence=lambda sequence: sequence + np.uint32(1))),
    ),
    "observed": (
        "a component that is observed is marked as not observed",
        _stress(_columns(observed=lambda observed: observed & ~np.uint16(1))),
    ),
    "wrong tare": (
        "a tare gives rest frequencies 100 ppm too high",
        _around(
            Reconstructor,
            "measure_rest",
            lambda original, *arguments: (1 + 1e-4) * original(*arguments),
        ),
    ),
    "tare of others": (
        "a tare takes the frequencies of the next cube",
        _around(
            Reconstructor,
            "measure_rest",
            lambda original, *arguments: np.roll(original(*arguments), 1, axis=0),
        ),
    ),
    "no tare": ("a tare changes nothing", _around(Reconstructor, "tare", _no_tare)),
    "no clear": (
        "clearing the tare changes nothing",
        _around(Reconstructor, "clear_tare", _nothing),
    ),
    "covariance": (
        "the covariance of single cubes is doubled",
        _around(CubeTopics, "_covariance", lambda original, *arguments: 2 * original(*arguments)),
    ),
    "other cube": (
        "the topic of a cube has the tensor of another one",
        _around(
            stress_publisher,
            "tensor_message",
            lambda original, header, rows, row, covariance: original(
                header, rows, row - 1, covariance
            ),
        ),
    ),
}
RESTARTED: dict[str, tuple[str, Patch]] = {
    "tare not restored": (
        "a tare is not restored at the start",
        _around(Taring, "_restore_tare", _nothing),
    ),
}
MUTATIONS: dict[str, Mutation] = {
    **{name: Mutation("driver", *rest) for name, rest in DRIVER.items()},
    **{name: Mutation("reconstruction", *rest) for name, rest in RECONSTRUCTION.items()},
    **{name: Mutation("reconstruction", *rest, True) for name, rest in RESTARTED.items()},
}
"""By name."""
