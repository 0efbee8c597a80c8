"""Write the result files (docs/reference/results.md), each completely or not at all."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from barsight.core.files import atomic_path
from barsight.mapping.free_space import FreeSpace
from barsight.mapping.passes.changes import PlaceHistory
from barsight.mapping.surface.surface import Surface
from barsight.mapping.top_photo import TopPhoto
from barsight.measurement import Measurement, Preview
from barsight.report.files.cloud import write_cloud
from barsight.report.files.height_rasters import write_free, write_height
from barsight.report.files.orthophoto import write_orthophoto, write_passes, write_top_photo
from barsight.report.files.tables import write_contours, write_laser_csv, write_trajectory
from barsight.yard.events import write_events
from barsight.yard.identity import MapIdentity
from barsight.yard.inventory.bundle_file import write_bundles
from barsight.yard.lifting.lift_file import write_lifts

RESULT_FILES = (
    "trajectory.tum", "cloud.ply", "height.tif", "free.tif", "tops.tif", "passes.tif", "contour.csv",
    "laser.csv", "bundles.json", "lifts.json", "events.csv", "ortho.tif", "ortho.png", "preview.png",
    "result.json", "report.html",
)  # fmt: skip
"""All files that a run may leave in its folder."""


def write_surface(
    surface: Surface, free: FreeSpace, tops: TopPhoto, folder: Path, frame_id: str,
    history: PlaceHistory | None = None,
) -> None:  # fmt: skip
    """Write the files of the map into an existing folder: cloud, heights, free space, photos, and for several
    passes the last to see each cell; each file names the frame of its coordinates.
    """
    write_height(surface, folder / "height.tif", frame_id)
    write_free(surface, free, folder / "free.tif", frame_id)
    write_orthophoto(surface, folder, frame_id)
    write_top_photo(surface, tops, folder / "tops.tif", frame_id)
    write_cloud(surface, folder / "cloud.ply", frame_id)
    if history is not None:
        write_passes(surface, history, folder / "passes.tif", frame_id)


def write_tables(measurement: Measurement, folder: Path) -> None:
    """Write trajectory, contours and the laser's profiles into an existing folder."""
    frame_id = measurement.frame_id
    write_trajectory(measurement.trajectory, folder / "trajectory.tum", frame_id)
    write_contours(measurement.contours, folder / "contour.csv")
    if measurement.laser:
        write_laser_csv(measurement.laser, folder / "laser.csv")


def write_results(measurement: Measurement, identity: MapIdentity, folder: Path) -> None:
    """Write all other files of a measurement except result.json into an existing folder."""
    reference = measurement.trajectory.reference
    path = folder / "bundles.json"
    digest = write_bundles(measurement.bundles, measurement.stock, reference, identity, path)
    write_lifts(measurement.lifts, reference, identity, digest, folder / "lifts.json")
    if measurement.lifts.events:
        write_events(measurement.lifts.events, folder / "events.csv")
    if measurement.preview is not None:
        write_preview(measurement.preview, folder / "preview.png")


def write_preview(preview: Preview, target: Path) -> None:
    """Write the rectified left picture beside its coloured disparity; black without a disparity."""
    known = np.isfinite(preview.disparity_px)
    low, high = np.percentile(preview.disparity_px[known], (1, 99)) if known.any() else (0.0, 1.0)
    scaled = (preview.disparity_px - low) / max(high - low, 1e-6) * 255
    levels = np.where(known, np.nan_to_num(scaled).clip(0, 255), 0).astype(np.uint8)
    colours = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)
    colours[~known] = 0
    picture = np.hstack([cv2.cvtColor(preview.left, cv2.COLOR_GRAY2BGR), colours])
    scale = min(1.0, 1600 / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    encoded = cv2.imencode(".png", small)[1]
    with atomic_path(target) as path:
        path.write_bytes(encoded.tobytes())
