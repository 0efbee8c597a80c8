"""A release note is its version's part of the changelog, and nothing else."""

from pathlib import Path

import pytest

from release_note import release_note

CHANGELOG = """# Changelog

## [Unreleased]

- Not yet.

## [1.2.0] - 2026-11-23

### Added

- A thing.

## [1.1.0] - 2026-10-01

## [1.0.0]

- The first.
"""


def test_a_versions_part_is_cut_out() -> None:
    assert release_note("1.2.0", CHANGELOG, "1.2.0") == "# Barsight 1.2.0\n\n### Added\n\n- A thing.\n"


@pytest.mark.parametrize(
    ("version", "packaged", "expected"),
    [
        ("1.2", "1.2", "no semantic version"),
        ("01.2.0", "01.2.0", "no semantic version"),
        ("1.2.0", "1.1.0", "has version 1.1.0, not 1.2.0"),
        ("1.3.0", "1.3.0", r"no line '## \[1.3.0\]"),
        ("1.0.0", "1.0.0", r"no line '## \[1.0.0\] - YYYY"),
        ("1.1.0", "1.1.0", "says nothing"),
    ],
)
def test_what_cant_be_released(version: str, packaged: str, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        release_note(version, CHANGELOG, packaged)


def test_our_changelog_has_the_form() -> None:
    text = (Path(__file__).parents[1] / "CHANGELOG.md").read_text(encoding="utf-8")
    dated = text.replace("## [Unreleased]", "## [9.9.9] - 2030-01-01")
    assert "### " in release_note("9.9.9", dated, "9.9.9")
