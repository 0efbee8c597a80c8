"""Read true trajectories, for evaluation only: no reader and no measuring stage imports this file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from barsight.core.arrays import Float64, Int64
from barsight.core.errors import InputError
from barsight.core.pose import Pose
from barsight.core.reading.bounded_reading import MAX_PICTURES, expect_lines, in_range, read_lines
from barsight.core.stamps import expect_increasing, parse_seconds
from barsight.recording.base import Recording
from barsight.recording.formats.euroc_tables import COPY, read_table
from barsight.recording.own_files import leads_outside

EUROC_FOLDER = "state_groundtruth_estimate0"
EUROC_HEADER = "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
EUROC_COLUMNS = ("timestamp", "p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z")


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """stamp_ns: (N,) int64 increasing. poses: `reference_from_body`, the reference is `yard` or `world`."""

    stamp_ns: Int64
    poses: tuple[Pose, ...]


def find_ground_truth(recording: Path) -> Path | None:
    """Find the ground truth stored with a recording of any format, or None."""
    candidates = (
        recording / "mav0" / EUROC_FOLDER / "data.csv",
        recording / EUROC_FOLDER / "data.csv",
        recording.parent / EUROC_FOLDER / "data.csv" if recording.is_file() else None,
        recording / "poses.txt",
    )
    found = next((path for path in candidates if path and path.is_file()), None)
    root = recording if recording.is_dir() else recording.parent
    return None if found is None or leads_outside(found, root) else found


def read_ground_truth(path: Path, stamp_ns: Int64 | None = None, *, reference: str = "world") -> GroundTruth:
    """Read a trajectory file: EuRoC's `data.csv`, TUM's lines of eight, or KITTI's `poses.txt` of twelve.

    path: the file, or a recording that contains one. stamp_ns: the frames' stamps, for KITTI's file without
    times. reference: the name of the poses' reference frame. The body is the IMU (KITTI: cam0).
    Raises `InputError` if it can't be read.
    """
    file = find_ground_truth(path) if path.is_dir() else path
    if file is None:
        raise InputError(path, "holds no true trajectory", "give a file with one")
    expect_lines(file, MAX_PICTURES, COPY)
    if file.suffix == ".csv":
        table = read_table(file, EUROC_COLUMNS, extra_allowed=True)
        table.expect_finite("remove the line")
        table.expect_increasing()
        xyzw = table.rest[:, [4, 5, 6, 3]]
        return _truth(file, table.first, table.rest[:, :3], xyzw, reference)
    lines = _lines(file)
    if len(lines[0]) == 12:
        return _kitti(file, lines, stamp_ns, reference)
    if len(lines[0]) != 8:
        raise InputError(file, f"line 1: {len(lines[0])} columns; TUM has 8, KITTI 12", "give another file")
    stamps = np.array([parse_seconds(line[0]) for line in lines], dtype=np.int64)
    expect_increasing(stamps, file, 1)
    numbers = np.array([[float(field) for field in line[1:]] for line in lines])
    return _truth(file, stamps, numbers[:, :3], numbers[:, 3:], reference)


def truth_of(recording: Recording) -> GroundTruth | None:
    """Read the true trajectory stored with a recording, None if there is none."""
    if find_ground_truth(recording.path) is None:
        return None
    return read_ground_truth(recording.path, np.array(recording.index.stamps_ns, np.int64))


def truth_as_euroc(path: Path, stamp_ns: Int64) -> str:
    """Format a trajectory as EuRoC's `data.csv`, one pose per stamp for KITTI's."""
    truth = read_ground_truth(path, stamp_ns)
    lines = [EUROC_HEADER]
    for stamp, pose in zip(truth.stamp_ns.tolist(), truth.poses, strict=True):
        x, y, z, w = pose.quaternion_xyzw.tolist()
        lines.append(",".join([str(stamp), *map(repr, [*pose.translation.tolist(), w, x, y, z])]))
    return "\n".join(lines) + "\n"


def _truth(path: Path, stamp_ns: Int64, place: Float64, xyzw: Float64, reference: str) -> GroundTruth:
    norm = np.linalg.norm(xyzw, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > 1e-2)
    if bad.size:
        raise InputError(
            path, f"row {int(bad[0]) + 1}: the quaternion's length is {norm[bad[0]]:.3f}", "correct the file"
        )
    poses = tuple(
        Pose.from_quaternion_xyzw(reference, "body", q, p) for q, p in zip(xyzw, place, strict=True)
    )
    return GroundTruth(stamp_ns, poses)


def _kitti(path: Path, lines: list[list[str]], stamp_ns: Int64 | None, reference: str) -> GroundTruth:
    if stamp_ns is None or len(stamp_ns) != len(lines):
        have = "no" if stamp_ns is None else str(len(stamp_ns))
        raise InputError(
            path, f"has {len(lines)} poses for {have} frames' times", "give the whole recording's"
        )
    matrices = np.array([[float(field) for field in line] for line in lines]).reshape(-1, 3, 4)
    poses = tuple(Pose.from_matrix(reference, "body", matrix) for matrix in matrices)
    return GroundTruth(np.asarray(stamp_ns, dtype=np.int64), poses)


def _lines(path: Path) -> list[list[str]]:
    lines: list[list[str]] = []
    for number, text in enumerate(read_lines(path), 1):
        fields = text.partition("#")[0].replace(",", " ").split()
        if not fields:
            continue
        try:
            finite = bool(in_range([float(field) for field in fields]).all())
        except ValueError:
            finite = False
        if not finite or (lines and len(fields) != len(lines[0])):
            raise InputError(
                path, f"line {number}: expected {len(lines[0]) if lines else 8} numbers", "mend it"
            )
        lines.append(fields)
    if not lines:
        raise InputError(path, "has no rows", "give a file with a trajectory")
    return lines
