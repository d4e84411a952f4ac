"""Compares the stamps of rows with the simulator's clock.

Hubs answer TIME, so what is left is half the difference of the two directions' smallest delays. How
late single samples come does not matter: on a busy host, too, some come in time. Stamps that the
driver says are in doubt are not judged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cube_tensor_driver.core.status import STAMP
from cube_tensor_driver.simulation.sample_log import SampleLog

from .record import NEW_DRIVER, Record
from .samples import NONE, Samples

SETTLE_S = 6.0
"""After a restart of a hub or of the driver, until stamps are judged: drift is known then."""
CLOCK_FAULTS = ("reset", "wrap", "unplug", "rename", "drift")
"""What makes the driver fit a hub's clock from the start."""


def stamp_errors_ms(
    record: Record, log: SampleLog, samples: Samples, sample: NDArray[np.int64]
) -> NDArray[np.float64]:
    """(K,) ms from each sample to its stamp, where the hub's clock has been undisturbed for a
    while. sample: (N,) of each row that came."""
    rows = record.frequencies.rows
    leads = np.isin(rows.cube, [link.members[0] for link in log.links])
    is_sure = rows.status & np.uint16(STAMP) == 0
    chosen = np.flatnonzero(leads & is_sure & (sample != NONE))
    stamp_ns, of = rows.stamp_ns[chosen], sample[chosen]
    error_ms = 1e-6 * (stamp_ns - samples.time_ns[of])
    return np.asarray(error_ms[_settled(record, log, samples)[of]], np.float64)


def _settled(record: Record, log: SampleLog, samples: Samples) -> NDArray[np.bool_]:
    """(S,) samples whose stamps are judged."""
    seconds = 1e-6 * samples.time_us
    begin = 1e-9 * (record.begin_ns - log.start_time_ns)
    settled = seconds > begin + SETTLE_S
    numbers = {link.name: number for number, link in enumerate(log.links)}
    for fault in log.faults:
        if fault.fault.kind in CLOCK_FAULTS:
            near = (seconds >= 1e-6 * fault.start_us - 0.1) & (
                seconds <= 1e-6 * fault.end_us + SETTLE_S
            )
            settled &= ~((samples.link == numbers[fault.fault.link]) & near)
    for deed in record.deeds:
        if deed.kind in NEW_DRIVER:
            end_ns = deed.end_ns + round(1e9 * SETTLE_S)
            settled &= (samples.time_ns < deed.begin_ns) | (samples.time_ns > end_ns)
    return settled
