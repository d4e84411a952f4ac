# Copyright 2026 cube_tensor_driver authors
# SPDX-License-Identifier: Apache-2.0
"""Selection of messages whose mean rate does not exceed a limit."""

from __future__ import annotations


def find_next_due_ns(now_ns: int, due_ns: int, period_ns: int) -> int | None:
    """Return the next due time if something is due now, or None.

    Due times are one period apart. For each of them, the first message is due that comes at most
    half a period earlier. So all messages are due if there is one per period, even if some come too
    early or too late.

    Args:
        now_ns: Stamp of the present message, in ns.
        due_ns: Result of the last call that did not return None; 0 before the first call.
        period_ns: Smallest mean time between two due messages, in ns.
    """
    early_ns = due_ns - now_ns
    # If a message comes more than two periods too early, the stamps have gone back.
    if period_ns < 2 * early_ns <= 4 * period_ns:
        return None
    # After a gap, and after stamps that have gone back, the due times begin again.
    is_on_time = -period_ns <= early_ns <= period_ns
    return (due_ns if is_on_time else now_ns) + period_ns
