"""Write a recording as an EuRoC folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from barsight.calibration.files.euroc import write_imu_description, write_rig
from barsight.calibration.files.yaml_document import write_document
from barsight.core.arrays import Float64, Int64
from barsight.core.records.sensor_samples import CraneSamples, LaserProfile
from barsight.recording.formats.ground_truth import EUROC_FOLDER, find_ground_truth, truth_as_euroc
from barsight.recording.stored_images import StoredPictures

IMAGE_HEADER = "#timestamp [ns],filename"
IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
CRANE_HEADER = "#timestamp [ns],bridge_x [m],trolley_y [m],hoist_z [m]"
LASER_HEADER = "#profile,x [m],y [m],z [m]"


def write_euroc(recording: StoredPictures, folder: Path, progress: Callable[[int], None]) -> int:
    """Write `folder/mav0`; return the number of pictures written."""
    mav0 = folder / "mav0"
    stamps = recording.camera_stamps.left_ns
    write_rig(mav0, recording.rig, median_rate(stamps))
    written = _write_images(recording, mav0, progress)
    write_document(mav0 / "body.yaml", {"comment": "body", "is_simulated": recording.is_simulated})
    if (imu := recording.imu()) is not None:
        values = np.hstack([imu.gyro_radps, imu.accel_mps2])
        write_table(mav0 / "imu0" / "data.csv", IMU_HEADER, table_rows(imu.stamp_ns, values))
        write_imu_description(mav0 / "imu0" / "sensor.yaml", recording.imu_noise(), median_rate(imu.stamp_ns))
    if (crane := recording.crane()) is not None:
        rows = table_rows(crane.stamp_ns, crane.position_m)
        write_table(mav0 / "crane0" / "data.csv", CRANE_HEADER, rows)
        write_crane_description(mav0 / "crane0" / "sensor.yaml", crane)
    if laser := recording.laser():
        write_table(mav0 / "laser0" / "data.csv", LASER_HEADER, table_rows(*laser_table(laser)))
        write_laser_description(mav0 / "laser0" / "sensor.yaml", laser)
    copy_truth(recording, mav0)
    return written


def median_rate(stamp_ns: Int64) -> float:
    """Compute samples per second from the median interval; 0 for fewer than two samples."""
    return 1e9 / float(np.median(np.diff(stamp_ns))) if stamp_ns.size > 1 else 0.0


def laser_table(laser: Iterable[LaserProfile]) -> tuple[Int64, Float64]:
    """Flatten all profiles to rows: numbers (N,) and x, y, z (N, 3)."""
    profiles = tuple(laser)
    numbers = np.concatenate([np.full(p.x_m.size, p.profile, dtype=np.int64) for p in profiles])
    return numbers, np.concatenate([np.column_stack([p.x_m, p.y_m, p.z_m]) for p in profiles])


def write_crane_description(path: Path, crane: CraneSamples) -> None:
    """Write the crane's `sensor.yaml` as the contract defines it."""
    write_document(
        path,
        {
            "sensor_type": "crane",
            "p_crane_body": [float(v) for v in crane.crane_to_body_m],
            "R_yard_body": [float(v) for v in crane.yard_from_body_nominal.ravel()],
            "rate_hz": round(median_rate(crane.stamp_ns), 6),
            "position_std_m": crane.position_std_m,
        },
    )


def write_laser_description(path: Path, laser: tuple[LaserProfile, ...]) -> None:
    """Write the laser's `sensor.yaml`."""
    values: dict[str, object] = {"sensor_type": "laser"}
    if np.isfinite(laser[0].range_std_m):
        values["range_std_m"] = laser[0].range_std_m
    write_document(path, values)


def copy_truth(recording: StoredPictures, folder: Path) -> None:
    """Copy ground truth as EuRoC's file; KITTI's `poses.txt` is converted to one."""
    source = find_ground_truth(recording.path)
    if source is None:
        return
    target = folder / EUROC_FOLDER
    target.mkdir(parents=True)
    if source.suffix == ".csv":
        for path in sorted(source.parent.iterdir()):
            if path.is_file() and not path.is_symlink():
                shutil.copyfile(path, target / path.name)
    else:
        (target / "data.csv").write_text(
            truth_as_euroc(source, recording.camera_stamps.left_ns), encoding="utf-8"
        )


def _write_images(recording: StoredPictures, mav0: Path, progress: Callable[[int], None]) -> int:
    done = 0
    with ExitStack() as stack:
        lists = []
        for camera in ("cam0", "cam1"):
            (mav0 / camera / "data").mkdir(parents=True, exist_ok=True)
            file = stack.enter_context((mav0 / camera / "data.csv").open("w", encoding="utf-8", newline="\n"))
            file.write(f"{IMAGE_HEADER}\n")
            lists.append(file)
        for image in recording.stored_images():
            name = f"{image.stamp_ns}.{image.kind}"
            (mav0 / f"cam{image.camera}" / "data" / name).write_bytes(image.data)
            lists[image.camera].write(f"{image.stamp_ns},{name}\n")
            done += 1
            progress(done)
    return done


def write_table(path: Path, header: str, rows: Iterable[str]) -> None:
    """Write one of EuRoC's CSV files, with its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f"{header}\n")
        file.writelines(f"{row}\n" for row in rows)


def table_rows(first: Int64, rest: Float64, number: Callable[[float], str] = repr) -> Iterator[str]:
    """Format rows of stamps or profile numbers (N,) and values (N, K)."""
    for stamp, row in zip(first.tolist(), rest, strict=True):
        yield f"{stamp},{','.join(map(number, row.tolist()))}"
