# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Rest frequencies in force: those of the calibrations, and those of each tare.

A tare of the torture is made while the load of the tared cubes is held, so the frequencies of that
instant are the rest frequencies that it must give. On a busy host it may come so late that the load
was not held all the time. Then nobody knows its result, and tensors of these cubes are not checked
until the next change. A row belongs to the rest frequencies that were in force when its tensor was
sent, which DDS states.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from cube_tensor_driver.core.arrays import Array, Mask, Times

from .record import LATEST_NS, NS_PER_S, RECONSTRUCTION_STOPS, NodeAction, Span
from .run import Run

TRANSPORT_S = 0.1
"""Longest time, in seconds, that a message takes. Within this time before a change of rest
frequencies is requested and after it is answered, the old or the new values may be in force."""

RESTORE_S = 2.0
"""Longest time, in seconds, after a restart of the reconstruction until it has restored the tare,
for which it must have received the cubes of the skin from the driver."""

AVERAGED_S = 2.5
"""Age, in seconds, of the oldest data that a tare (measurement of the rest frequencies) averages.

It is the sum of 1 s that a tare averages, up to 0.5 s because it averages whole windows of 0.5 s,
and 1 s by which the newest data may be late.
"""


@dataclass(frozen=True)
class RestFrequencies:
    """Rest frequencies (of unloaded pads) that the reconstruction may use.

    Attributes:
        values: Frequencies (cubes, P), in Hz.
        is_known: False for cubes whose tare has an unknown result (cubes,).
    """

    values: Array
    is_known: Mask

    def tare(self, cubes: list[int], held: Array | None) -> RestFrequencies:
        """Return the rest frequencies after a tare.

        Args:
            cubes: Indices of the cubes that were tared.
            held: Their readings (len(cubes), P) during the tare, in Hz; None if they are unknown.
        """
        values = self.values.copy()
        is_known = self.is_known.copy()
        is_known[cubes] = held is not None
        if held is not None:
            values[cubes] = held
        return RestFrequencies(values, is_known)


class RestHistory:
    """All rest frequencies that were in force in a run, each with its span of time."""

    def __init__(self, run: Run) -> None:
        self._run = run
        calibrations = run.record.skin.calibrations
        calibrated = np.array([calibration.rest_frequency for calibration in calibrations])
        all_known = np.ones(len(calibrations), bool)
        self._calibrated = RestFrequencies(calibrated, all_known)

        current = self._calibrated
        self._epochs = [(Span(0, LATEST_NS), current)]
        for action in self._find_changes():
            current = self._apply(action, current)
            # Until now the span of the earlier values had no end. The change ends it.
            last, rest = self._epochs[-1]
            shortened = replace(last, end_ns=action.end_ns)
            self._epochs[-1] = (shortened, rest)
            following = Span(action.end_ns, LATEST_NS)
            self._epochs.append((following, current))

    def _find_changes(self) -> list[NodeAction]:
        actions = self._run.record.select_actions("tare", "clear")
        return [action for action in actions if action.succeeded]

    def _apply(
        self,
        action: NodeAction,
        current: RestFrequencies,
    ) -> RestFrequencies:
        if action.kind == "clear":
            return self._calibrated
        # A tare has a known result only if the load was constant in all data that it averages.
        first_ns = action.begin_ns - round(NS_PER_S * AVERAGED_S)
        averaged = Span(first_ns, action.end_ns)
        cubes = list(action.cubes)
        held = self._run.sent.find_held(cubes, averaged)
        return current.tare(cubes, held)

    def select_candidates(
        self,
        sent_ns: Times,
    ) -> Iterator[tuple[Mask, RestFrequencies]]:
        """Yield all rest frequencies of the run, each with the rows (N,) that may result from them.

        Args:
            sent_ns: Wall clock at which the tensor of each row was sent (N,).
        """
        is_unclear = self._is_unclear(sent_ns)
        for span, rest in self._epochs:
            yield is_unclear | span.contains(sent_ns), rest

    def _is_unclear(self, sent_ns: Times) -> Mask:
        """Find the times (N,) at which either the old or the new rest frequencies may be in
        force."""
        record = self._run.record
        is_unclear = record.is_during(
            RECONSTRUCTION_STOPS,
            sent_ns,
            TRANSPORT_S,
            RESTORE_S,
        )
        for action in self._find_changes():
            is_unclear |= action.contains(sent_ns, TRANSPORT_S, TRANSPORT_S)
        return is_unclear
