"""Parse the seeds of a benchmark."""

from __future__ import annotations

import re

from barsight.core.errors import ConfigError


def parse_seeds(seeds: str, bench: str) -> range:
    """Parse `first:last`, the last not included. Raises ConfigError, naming the benchmark."""
    match = re.fullmatch(r"(\d+):(\d+)", seeds)
    if match is None or int(match[2]) <= int(match[1]):
        raise ConfigError(f"{bench}: seeds {seeds!r} is not like 500:560, the last not included")
    return range(int(match[1]), int(match[2]))
