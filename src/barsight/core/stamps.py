"""Handle time stamps: integers in nanoseconds, never floats. TUM files carry seconds with nine decimals."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.errors import InputError

NS_PER_S = 1_000_000_000
BEFORE_ALL_NS = -(2**63)
"""A stamp before all others: a clock may count from any moment, so stamps may be 0 or negative."""


def seconds_to_ns(seconds: float) -> int:
    """Convert a duration in seconds to whole nanoseconds.

    Not for absolute stamps, which a float can't hold.
    """
    return round(seconds * NS_PER_S)


def format_seconds(stamp_ns: int) -> str:
    """Format `1700000000603500000` as `"1700000000.603500000"`, exact."""
    sign = "-" if stamp_ns < 0 else ""
    whole, rest = divmod(abs(stamp_ns), NS_PER_S)
    return f"{sign}{whole}.{rest:09d}"


def parse_seconds(text: str) -> int:
    """Parse what `format_seconds` writes; decimals beyond the ninth are cut.

    Exponents are read too (`1.4e+09`, as `numpy.savetxt` writes). Raises ValueError if it isn't a number.
    """
    return int(_stamp(text))


def seconds_in_ns(text: str) -> int:
    """Parse seconds as `parse_seconds`, rounded to the nearest nanosecond."""
    return int(_stamp(text).to_integral_value())


def _stamp(text: str) -> Decimal:
    """Parse seconds to nanoseconds that fit into 64 bits; a large exponent would take forever as an
    integer.
    """
    try:
        stamp = Decimal(text) * NS_PER_S
        if not -(2**63) <= stamp < 2**63:
            raise ValueError
    except (ArithmeticError, ValueError):
        raise ValueError(f"{text[:40]!r} is not a time in seconds") from None
    return stamp


def rows_not_later(stamps_ns: Int64) -> Int64:
    """Find the rows k whose successor k + 1 isn't later; compared, as a difference may exceed 64 bits."""
    return np.flatnonzero(stamps_ns[1:] <= stamps_ns[:-1])


def expect_increasing(stamps_ns: Int64, path: Path, first_line: int = 2) -> None:
    """Raise `InputError` naming the file's line where stamps repeat or go back."""
    bad = rows_not_later(stamps_ns)
    if bad.size:
        k = int(bad[0]) + 1
        what = "is the same as the one before" if stamps_ns[k] == stamps_ns[k - 1] else "goes back in time"
        raise InputError(
            path,
            f"line {first_line + k}: stamp {int(stamps_ns[k])} {what} ({bad.size} such lines)",
            "sort the file by time and drop doubled lines",
        )


@dataclass(frozen=True)
class Pairing:
    """Pairs of left and right stamps.

    left, right: (N,) indices into the two inputs, increasing. left_only, right_only: indices without partner.
    """

    left: Int64
    right: Int64
    left_only: Int64
    right_only: Int64


def pair_stamps(left_ns: Int64, right_ns: Int64, tolerance_ns: int) -> Pairing:
    """Pair two increasing stamp lists: mutual nearest neighbours no further apart than the tolerance."""
    if left_ns.size == 0 or right_ns.size == 0:
        none = np.empty(0, dtype=np.int64)
        return Pairing(none, none, np.arange(left_ns.size), np.arange(right_ns.size))
    to_right = _nearest(left_ns, right_ns)
    to_left = _nearest(right_ns, left_ns)
    left = np.arange(left_ns.size)
    paired = (to_left[to_right] == left) & (np.abs(left_ns - right_ns[to_right]) <= tolerance_ns)
    right = to_right[paired]
    return Pairing(
        left[paired], right, left[~paired], np.setdiff1d(np.arange(right_ns.size), right, assume_unique=True)
    )


def _nearest(query_ns: Int64, among_ns: Int64) -> Int64:
    after = np.clip(np.searchsorted(among_ns, query_ns), 1, max(among_ns.size - 1, 1))
    before = after - 1
    after = np.minimum(after, among_ns.size - 1)
    nearer_before = np.abs(query_ns - among_ns[before]) <= np.abs(among_ns[after] - query_ns)
    return np.where(nearer_before, before, after)


def interpolate_at(query_ns: Int64, stamps_ns: Int64, values: Float64) -> Float64:
    """Interpolate `values` (N, ...) given at increasing `stamps_ns` (N,) linearly at `query_ns` (M,).

    Returns (M, ...); NaN outside the stamps' span. Integer differences first, so that no nanosecond is lost.
    """
    if stamps_ns.size == 0:
        return np.full((query_ns.size, *values.shape[1:]), np.nan)
    k = np.clip(np.searchsorted(stamps_ns, query_ns, side="right") - 1, 0, max(stamps_ns.size - 2, 0))
    following = np.minimum(k + 1, stamps_ns.size - 1)
    span = np.maximum(stamps_ns[following] - stamps_ns[k], 1)
    share = (query_ns - stamps_ns[k]) / span
    share = share.reshape(share.shape + (1,) * (values.ndim - 1))
    result: Float64 = values[k] * (1 - share) + values[following] * share
    outside = (query_ns < stamps_ns[0]) | (query_ns > stamps_ns[-1])
    result[outside] = np.nan
    return result
