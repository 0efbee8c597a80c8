"""Read and write `bundles.json`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from barsight.core.arrays import Float64
from barsight.core.errors import MEASURE_AGAIN, InputError
from barsight.core.json_values import DIGITS, json_value
from barsight.core.reading.bounded_reading import MAX_MAGNITUDE
from barsight.core.reading.json_schema import expect_schema, package_schema
from barsight.core.reading.sealed_json import read_sealed, write_sealed
from barsight.yard.identity import MapIdentity
from barsight.yard.inventory.stock_list import MatchedEntry, StockMatch
from barsight.yard.types import Bar, Bundle, BundleLabel, BundleSigma, Doubt, FitSigma
from barsight.yard.weight import bundle_mass, bundle_section

SCHEMA_VERSION = 2


def write_bundles(
    bundles: tuple[Bundle, ...], stock: StockMatch | None, reference: str, identity: MapIdentity,
    target: Path, sequence: int = 1,
) -> str:  # fmt: skip
    """Write bundles.json completely or not at all; return its digest. reference: `yard` or `world` frame."""
    content = {
        "schema_version": SCHEMA_VERSION,
        **identity.header(sequence),
        "reference": reference,
        "bundles": [_record(bundle) for bundle in bundles],
        "stock": json_value(stock, DIGITS),
    }
    return write_sealed(content, target)


def bundles_content(path: Path) -> dict[str, Any]:
    """Read the content of bundles.json. Raises InputError as `read_bundles` does."""
    content = read_sealed(path, SCHEMA_VERSION, MEASURE_AGAIN)
    expect_schema(content, package_schema("barsight.yard", "bundles"), path, MEASURE_AGAIN)
    return content


def read_bundles(path: Path) -> tuple[Bundle, ...]:
    """Read bundles.json. Raises InputError where it is missing, truncated, altered, of another version or
    doesn't match its schema.
    """
    content = bundles_content(path)
    try:
        return tuple(bundle_of(record) for record in content["bundles"])
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise InputError(path, f"is damaged ({type(error).__name__}: {error})", MEASURE_AGAIN) from error


def read_match(path: Path) -> StockMatch | None:
    """Read from bundles.json, as `read_bundles` does, how it matches the stock list; None without a list."""
    stock = bundles_content(path)["stock"]
    if stock is None:
        return None
    try:
        matched = tuple(
            MatchedEntry(one["name"], one["bundle"], tuple(one["moved_m"]), tuple(one["disagrees"]))
            for one in stock["matched"]
        )
        return StockMatch(matched, *(tuple(stock[name]) for name in ("moved", "missing", "hidden", "extra")))
    except (KeyError, TypeError) as error:
        raise InputError(path, f"is damaged ({type(error).__name__}: {error})", MEASURE_AGAIN) from error


def _record(bundle: Bundle) -> dict[str, Any]:
    sigma, mass = bundle.sigma, bundle_mass(bundle)
    section, section_sigma = bundle_section(bundle)
    record = {
        "id": bundle.id,
        "axis_centre_m": bundle.centre_m,
        "direction": bundle.direction,
        "yaw_deg": float(np.degrees(bundle.yaw_rad)),
        "pitch_deg": float(np.degrees(bundle.pitch_rad)),
        "length_m": bundle.length_m,
        "ends_m": bundle.ends_m,
        "ends_open": list(bundle.ends_open),
        "ends_sigma_m": list(bundle.ends_sigma_m),
        "width_m": bundle.width_m,
        "top_z_m": bundle.top_z_m,
        "bar_diameter_m": bundle.bar_diameter_m,
        "visible_bars": bundle.visible_bars,
        "bars": bundle.bars,
        "section_m2": section,
        "mass_kg": mass.kg,
        "layer": bundle.layer,
        "on_top": bundle.on_top,
        "cover_doubts": [doubt.sentence for doubt in bundle.cover_doubts],
        "neighbours": list(bundle.neighbours),
        "sigma": {
            "lateral_m": sigma.lateral_m,
            "along_m": sigma.along_m,
            "yaw_deg": float(np.degrees(sigma.yaw_rad)),
            "length_m": sigma.length_m,
            "width_m": sigma.width_m,
            "top_z_m": sigma.top_z_m,
            "bar_diameter_m": sigma.bar_diameter_m,
            "section_m2": section_sigma,
            "mass_kg": mass.sigma_kg,
        },
        "fit_sigma": _fit_record(bundle.fit_sigma),
        "map_sigma_z_m": bundle.map_sigma_z_m,
        "known_share": bundle.known_share,
        "confidence": bundle.confidence,
        "reasons": [doubt.sentence for doubt in bundle.reasons],
        "label": bundle.label,
        "straps_m": list(bundle.straps_m),
        "bar_axes": [
            {
                "centre_m": bar.centre_m,
                "direction": bar.direction,
                "diameter_m": bar.diameter_m,
                "length_m": bar.length_m,
                "covariance": bar.covariance,
            }
            for bar in bundle.bar_axes
        ],
    }
    plain: dict[str, Any] = json_value(record, DIGITS)
    return plain


def _fit_record(sigma: FitSigma | None) -> dict[str, Any] | None:
    if sigma is None:
        return None
    record = asdict(sigma)
    record["yaw_deg"] = float(np.degrees(record.pop("yaw_rad")))
    return record


def bundle_of(record: dict[str, Any]) -> Bundle:
    """Build a bundle from its record in bundles.json; without bars where the record has no `bar_axes`.

    Raises ValueError for a number over MAX_MAGNITUDE.
    """

    def figure(value: float | None) -> float:
        return float("nan") if value is None else float(figures_of(value))

    def figures_of(values: ArrayLike) -> Float64:
        found = np.array(values, np.float64)
        if (np.abs(found) > MAX_MAGNITUDE).any():
            raise ValueError("a number is out of range")
        return found

    figures = {name: figure(value) for name, value in record["sigma"].items()}
    yaw_rad = float(np.radians(figures.pop("yaw_deg")))
    figures.pop("mass_kg", None)
    fit = {name: figure(value) for name, value in (record.get("fit_sigma") or {}).items()}
    return Bundle(
        id=record["id"],
        centre_m=figures_of(record["axis_centre_m"]),
        yaw_rad=float(np.radians(figure(record["yaw_deg"]))),
        pitch_rad=float(np.radians(figure(record["pitch_deg"]))),
        length_m=figure(record["length_m"]),
        ends_m=figures_of(record["ends_m"]),
        ends_open=(record["ends_open"][0], record["ends_open"][1]),
        width_m=figure(record["width_m"]),
        top_z_m=figure(record["top_z_m"]),
        bar_diameter_m=figure(record["bar_diameter_m"]),
        visible_bars=record["visible_bars"],
        bars=record["bars"] or None,
        layer=record["layer"],
        on_top=record["on_top"],
        cover_doubts=tuple(map(Doubt.read, record["cover_doubts"])),
        neighbours=tuple(record["neighbours"]),
        sigma=BundleSigma(yaw_rad=yaw_rad, **figures),
        known_share=figure(record["known_share"]),
        confidence=figure(record["confidence"]),
        reasons=tuple(map(Doubt.read, record["reasons"])),
        section_m2=figure(record.get("section_m2")),
        label=BundleLabel(**record["label"]) if record.get("label") else None,
        fit_sigma=FitSigma(yaw_rad=float(np.radians(fit.pop("yaw_deg"))), **fit) if fit else None,
        map_sigma_z_m=figure(record.get("map_sigma_z_m")),
        straps_m=tuple(figures_of(record.get("straps_m", [])).tolist()),
        ends_sigma_m=(figure(record["ends_sigma_m"][0]), figure(record["ends_sigma_m"][1])),
        bar_axes=tuple(
            Bar(
                figures_of(bar["centre_m"]), figures_of(bar["direction"]), figure(bar["diameter_m"]),
                figure(bar["length_m"]), figures_of(bar["covariance"]),
            )
            for bar in record.get("bar_axes", ())
        ),
    )  # fmt: skip
