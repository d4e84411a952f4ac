"""Whether a hub's clock is one: not if it stands still, or jumps again and again."""

from __future__ import annotations

from collections import deque

FROZEN_NS = 200_000_000
FROZEN_CALLS = 3
"""A clock that has not moved for so long, and for so many calls, stands still."""
LIES, LIES_NS = 3, 10_000_000_000
"""A clock that was wrong so often within so long is not believed until that is over."""
STANDS_STILL = "the hub's clock stands still: rows are stamped by their arrival"
LYING = (
    f"the hub's clock jumped {LIES} times within {LIES_NS / 1e9:g} s: "
    "rows are stamped by their arrival"
)


class HubClockWatch:
    """Looks at the device times of one hub.

    is_still: the clock did not move in the last call.
    """

    def __init__(self) -> None:
        self._last_us = -1  # device time of the last call
        self._moved_ns = 0  # when that came first
        self._calls_still = 0  # since then
        self._wrong_ns: deque[int] = deque(maxlen=LIES)  # arrivals where the clock was wrong

    @property
    def is_still(self) -> bool:
        return self._calls_still > 0

    @property
    def is_sound(self) -> bool:
        """Whether nothing speaks against the clock."""
        return not self._calls_still and len(self._wrong_ns) < LIES

    def add_wrong(self, arrival_ns: int) -> None:
        """The clock was set, or the hub restarted, before this arrival."""
        self._wrong_ns.append(arrival_ns)

    def moves_again(self, device_us: int, arrival_ns: int) -> bool:
        """Whether the clock stood still until these device times."""
        return device_us != self._last_us and self._stands_still(arrival_ns)

    def look(self, device_us: int, arrival_ns: int) -> str:
        """Why device times are not to be believed now; empty if they are."""
        if device_us != self._last_us:
            self.move(device_us, arrival_ns)
        else:
            self._calls_still += 1
        wrong = self._wrong_ns
        if wrong and arrival_ns - wrong[0] > LIES_NS:
            wrong.popleft()
        if self._stands_still(arrival_ns):
            return STANDS_STILL
        return LYING if len(wrong) == LIES else ""

    def move(self, device_us: int, arrival_ns: int) -> None:
        """The clock was read and had moved."""
        self._last_us, self._moved_ns, self._calls_still = device_us, arrival_ns, 0

    def shift(self, step_ns: int) -> None:
        """The host's clock was set by step_ns."""
        self._moved_ns += step_ns
        self._wrong_ns = deque((at + step_ns for at in self._wrong_ns), LIES)

    def _stands_still(self, arrival_ns: int) -> bool:
        return self._calls_still >= FROZEN_CALLS and arrival_ns - self._moved_ns > FROZEN_NS
