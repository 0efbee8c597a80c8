"""Export a measured cloud or map to other programs' formats, chosen by the file name.

All keep metres and the reference frame, which LAS (system identifier), PCD (a comment) and E57 (the scan's
name) also state; a comment in a CSV breaks its readers. LAS, PCD and CSV store sigma and view count in fields
of their own; E57 can't store them.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from barsight.core.errors import MEASURE_AGAIN, BarsightError, ConfigError, InputError, OutputError
from barsight.core.extras import extra
from barsight.core.files import atomic_path
from barsight.result_folder import Cloud, open_folder, read_cloud

_LAS_STEP_M = 1e-4


def export(folder: Path, target: Path) -> int:
    """Write `target` from the files of a measured folder; return the points written (0 for raster or copy).

    .ply and .tif are the folder's own files, .csv needs nothing else, the others the extra `export`. Raises
    ConfigError for another suffix or without the extra, InputError if the folder's file is missing or was
    changed, OutputError if `target` can't be written.
    """
    frame_id = ""
    if (folder / "result.json").is_file():
        frame_id = str(open_folder(folder, lifts=False, cloud=True)[0].get("frame_id") or "")
    kind = target.suffix.lower()
    copies = {".ply": "cloud.ply", ".tif": "height.tif", ".tiff": "height.tif"}
    source = folder / copies.get(kind, "cloud.ply")
    if kind in {*copies, *_WRITERS} and not source.is_file():
        raise InputError(source, "no such file", "name a folder that `barsight measure` wrote")
    if kind in copies:
        with atomic_path(target) as path:
            shutil.copyfile(source, path)
        return 0
    if kind not in _WRITERS:
        known = " ".join(sorted([*copies, *_WRITERS]))
        raise ConfigError(f"{target}: can't tell the format from {kind or 'no suffix'!r}; end it in {known}")
    cloud = read_cloud(folder / "cloud.ply")
    with atomic_path(target) as path:
        try:
            _WRITERS[kind](cloud, path, frame_id)
        except (OverflowError, ValueError) as error:
            raise InputError(
                folder / "cloud.ply", f"doesn't fit a {kind} file ({error})", MEASURE_AGAIN
            ) from error
        except (OSError, BarsightError):
            raise
        except Exception as error:  # errors of the libraries, if the system refuses to write
            reason = str(error).strip().partition("\n")[0][:200]
            raise OutputError(
                f"{target}: could not be written completely ({reason}); free some space"
            ) from error
    return cloud.total


def _write_las(cloud: Cloud, path: Path, frame_id: str, *, compress: bool) -> None:
    with extra("export"):
        import laspy
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.add_extra_dims(
        [laspy.ExtraBytesParams("sigma_z", "float32"), laspy.ExtraBytesParams("views", "uint16")]
    )
    header.system_identifier = frame_id or "OTHER"
    header.global_encoding.wkt = True  # as LAS requires of this point format, without a system too
    header.scales = np.full(3, _LAS_STEP_M)
    header.offsets = np.floor(cloud.xyz_m.min(axis=0)).astype(np.float64)
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.xyz_m.T.astype(np.float64)
    # LAS requires the full range of 16 bits.
    las.intensity = (cloud.intensity * 257).astype(np.uint16)
    las.return_number = las.number_of_returns = np.ones(len(las), np.uint8)  # filters drop return 0
    las.sigma_z = cloud.sigma_m
    las.views = cloud.views.astype(np.uint16)
    with path.open("wb") as file:
        las.write(file, do_compress=compress)


def _write_pcd(cloud: Cloud, path: Path, frame_id: str) -> None:
    with extra("export"):
        from pypcd4 import PointCloud
    columns = np.column_stack([cloud.xyz_m, cloud.intensity, cloud.sigma_m, cloud.views])
    fields = ("x", "y", "z", "intensity", "sigma_z", "views")
    PointCloud.from_points(columns.astype(np.float32), fields, (np.float32,) * 6).save(path)
    if frame_id:
        path.write_bytes(f"# frame {frame_id}\n".encode() + path.read_bytes())


def _write_e57(cloud: Cloud, path: Path, frame_id: str) -> None:
    with extra("export"):
        import pye57
    x, y, z = cloud.xyz_m.T.astype(np.float64)
    file = pye57.E57(str(path), mode="w")
    try:
        values = {"cartesianX": x, "cartesianY": y, "cartesianZ": z, "intensity": cloud.intensity}
        file.write_scan_raw(values, name=frame_id or None)
        file.close()
    except BaseException:
        file.close = lambda: None  # its destructor would fail again and print the error
        raise


def _write_csv(cloud: Cloud, path: Path) -> None:
    columns = np.column_stack([cloud.xyz_m, cloud.intensity, cloud.sigma_m, cloud.views])
    head = "x_m,y_m,z_m,intensity,sigma_m,views"
    np.savetxt(path, columns, "%.4f,%.4f,%.5f,%d,%.5f,%d", header=head, comments="")


_WRITERS: dict[str, Callable[[Cloud, Path, str], None]] = {
    ".las": lambda cloud, path, frame_id: _write_las(cloud, path, frame_id, compress=False),
    ".laz": lambda cloud, path, frame_id: _write_las(cloud, path, frame_id, compress=True),
    ".pcd": _write_pcd,
    ".e57": _write_e57,
    ".csv": lambda cloud, path, _: _write_csv(cloud, path),
}
