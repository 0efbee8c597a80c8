"""Stamps: exact to the nanosecond, paired as a brute-force search pairs them."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from barsight.core.errors import InputError
from barsight.core.stamps import (
    expect_increasing,
    format_seconds,
    interpolate_at,
    pair_stamps,
    parse_seconds,
    seconds_to_ns,
)

EPOCH_NS = 1_700_000_000_603_500_001
stamp_lists = st.lists(st.integers(0, 200), unique=True, max_size=12).map(
    lambda stamps: np.array(sorted(stamps), dtype=np.int64) + EPOCH_NS
)


@given(st.integers(-(2**63), 2**63 - 1))
def test_text_round_trip(stamp_ns: int) -> None:
    assert parse_seconds(format_seconds(stamp_ns)) == stamp_ns


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1700000000.603500001", EPOCH_NS),
        ("-0.5", -500_000_000),
        ("+2", 2_000_000_000),
        ("3.", 3_000_000_000),
        (".25", 250_000_000),
        ("1.9999999999", 1_999_999_999),
        ("-1.9999999999", -1_999_999_999),
        ("1.403636579763555527e+09", 1_403_636_579_763_555_527),
    ],
)
def test_parse_seconds(text: str, stamp_ns: int) -> None:
    assert parse_seconds(text) == stamp_ns


@pytest.mark.parametrize("text", ["", ".", "-", "abc", "1.-5", "--5", "nan", "inf", "1.2.3"])
def test_what_is_no_number_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="seconds"):
        parse_seconds(text)


def test_format_seconds() -> None:
    assert format_seconds(EPOCH_NS) == "1700000000.603500001"
    assert format_seconds(-1) == "-0.000000001"
    assert seconds_to_ns(-0.0035) == -3_500_000


def paired_by_brute_force(left: np.ndarray, right: np.ndarray, tolerance: int) -> list[tuple[int, int]]:
    """Each other's nearest, the earlier of two equally near ones."""
    pairs = []
    for i, stamp in enumerate(left):
        if right.size:
            j = min(range(right.size), key=lambda k: (abs(right[k] - stamp), k))
            back = min(range(left.size), key=lambda k: (abs(left[k] - right[j]), k))
            if back == i and abs(right[j] - stamp) <= tolerance:
                pairs.append((i, j))
    return pairs


@given(stamp_lists, stamp_lists, st.integers(0, 60))
def test_pairs_are_mutual_nearest(left: np.ndarray, right: np.ndarray, tolerance: int) -> None:
    pairing = pair_stamps(left, right, tolerance)
    pairs = paired_by_brute_force(left, right, tolerance)
    assert list(zip(pairing.left.tolist(), pairing.right.tolist(), strict=True)) == pairs
    assert sorted([*pairing.left, *pairing.left_only]) == list(range(left.size))
    assert sorted([*pairing.right, *pairing.right_only]) == list(range(right.size))


def test_a_frame_on_one_side_only() -> None:
    left = EPOCH_NS + np.array([0, 50, 100, 150])
    pairing = pair_stamps(left, left[[0, 1, 3]] + 2, tolerance_ns=2)
    assert pairing.left.tolist() == [0, 1, 3]
    assert pairing.left_only.tolist() == [2]
    assert pair_stamps(left, left + 2, tolerance_ns=1).left.size == 0


def test_stamps_out_of_order_are_named() -> None:
    path = Path("cam0/data.csv")
    expect_increasing(np.array([EPOCH_NS, EPOCH_NS + 1]), path)
    expect_increasing(np.empty(0, np.int64), path)
    with pytest.raises(InputError, match=r"cam0/data.csv: line 4: stamp 3 goes back in time \(2 .*; sort"):
        expect_increasing(np.array([2, 5, 3, 4, 4]), path)
    with pytest.raises(InputError, match="line 2: stamp 7 is the same as the one before"):
        expect_increasing(np.array([7, 7]), path, first_line=1)
    expect_increasing(np.array([-(2**62) - 5, 2**62 + 5]), path)
    with pytest.raises(InputError, match="goes back in time"):
        expect_increasing(np.array([2**63 - 1, -(2**63)]), path)


def test_interpolation_loses_no_nanosecond() -> None:
    stamps = EPOCH_NS + np.array([0, 10, 1_000_000_007, 5_000_000_000])
    query = EPOCH_NS + np.array([0, 1, 2, 9, 10, 11, 999_999_999, 4_999_999_999, 5_000_000_000])
    slope = np.array([1.0, -2.0])
    values = (stamps - EPOCH_NS)[:, None] * slope
    expected = (query - EPOCH_NS)[:, None] * slope
    np.testing.assert_allclose(interpolate_at(query, stamps, values), expected, rtol=1e-15, atol=1e-6)


def test_interpolation_ends_where_the_stamps_end() -> None:
    stamps = EPOCH_NS + np.array([0, 10])
    query = EPOCH_NS + np.array([-1, 0, 10, 11])
    found = interpolate_at(query, stamps, np.array([3.0, 4.0]))
    np.testing.assert_array_equal(found, [np.nan, 3, 4, np.nan])
    one = interpolate_at(query, stamps[:1], np.array([3.0]))
    np.testing.assert_array_equal(one, [np.nan, 3, np.nan, np.nan])
    assert np.isnan(interpolate_at(query, stamps[:0], np.empty((0, 2)))).all()
