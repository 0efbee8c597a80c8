"""Notice that this computer's clock was set back: ages by it can't be told then."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from barsight.core.stamps import NS_PER_S

MAX_STEP_NS = NS_PER_S
"""Maximum time (ns) by which the clock may go back between two looks, as it does when it is disciplined."""


def _ahead_ns() -> int:
    return time.time_ns() - time.monotonic_ns()


@dataclass
class WallClock:
    """Compares this computer's clock with its monotonic one. set_back_s: by how much it was set back since
    `settle` was last called, otherwise 0.
    """

    set_back_s: float = 0.0
    _last_ns: int = field(default_factory=_ahead_ns)

    def look(self) -> float:
        """Return by how many seconds the clock was set back, 0 if it wasn't."""
        before_ns, self._last_ns = self._last_ns, _ahead_ns()
        if before_ns - self._last_ns > MAX_STEP_NS:
            self.set_back_s += (before_ns - self._last_ns) / NS_PER_S
        return self.set_back_s

    def settle(self) -> None:
        """Forget that the clock was set back: what was older has ended."""
        self.set_back_s = 0.0
