"""Apply a yard file to a measurement (encoders, poses, map and sigma); refuse one of another rig or crane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from barsight.calibration.geometry.rig import StereoRig
from barsight.core.arrays import Float64
from barsight.core.errors import InputError
from barsight.core.json_values import json_digest, json_value
from barsight.core.pose import Pose, skew
from barsight.core.records.sensor_samples import CraneSamples, LaserProfile
from barsight.core.records.trajectory import Trajectory
from barsight.recording.base import Recording
from barsight.recording.sensor_samples import make_laser
from barsight.recording.wrapper import RecordingProxy
from barsight.registration.bending import CraneBend, bend_carry, bend_heights
from barsight.registration.yard_file import YardFrame, read_yard_file
from barsight.result_folder import open_folder
from barsight.yard.identity import ID_DIGITS

MAX_TURN_DEG, MAX_PLACE_M = 1.0, 0.5
"""Largest sigma of a frame on its worst axis, in degrees and metres, with which it may place anything."""


@dataclass(frozen=True, eq=False)
class RecordingInYard(RecordingProxy):
    """`whole` with its encoder readings and laser profiles in the surveyed yard."""

    frame: YardFrame

    def crane(self) -> CraneSamples | None:
        """Return the readings, transformed to the yard or with the calibrated attitude."""
        crane = self.whole.crane()
        return None if crane is None else crane_in_yard(crane, self.frame)

    def laser(self) -> tuple[LaserProfile, ...]:
        """Return the profiles, transformed like the encoder readings that placed them."""
        pose = self.frame.yard_from
        if pose.source != "encoders":
            return self.whole.laser()
        return tuple(
            make_laser(
                self.whole.path, np.full(one.x_m.size, one.profile),
                pose.apply(np.column_stack([one.x_m, one.y_m, one.z_m])), one.range_std_m,
            )[0]
            for one in self.whole.laser()
        )  # fmt: skip


def in_yard(
    recording: Recording, yard: Path | None, known: Recording | None = None, *, is_awaited: bool = False
) -> Recording:
    """View a recording through the yard file; return the recording itself without a yard file.

    If the recording's own readings are yet to come, the file must fit `known`; if is_awaited, `expect_fits`
    must be called once they are there.

    Raises CalibrationError for an invalid file, InputError for one of another rig, crane or recording.
    """
    if yard is None:
        return recording
    frame = read_yard_file(yard)
    _expect_sure(frame)
    placed = RecordingInYard(recording, frame)
    if not is_awaited:
        expect_fits(placed, known)
    return placed


def expect_fits(recording: Recording, known: Recording | None = None) -> None:
    """Raise InputError if a recording's yard file belongs to another rig, crane or recording.

    known: the recording that the file must fit; the recording itself if None.
    """
    if isinstance(recording, RecordingInYard):
        _expect_fits(recording.frame, known or recording.whole)


def frame_of(recording: Recording) -> YardFrame | None:
    """Return the yard file through which a recording is viewed."""
    return recording.frame if isinstance(recording, RecordingInYard) else None


def calibration_id(rig: StereoRig) -> str:
    """Compute the digest of a rig that is stored in results."""
    return json_digest(json_value(rig))[:ID_DIGITS]


def mounting_id(crane: CraneSamples) -> str:
    """Compute the digest of the mounting of the body on the crane."""
    hung = {"crane_to_body_m": crane.crane_to_body_m, "yard_from_body": crane.yard_from_body_nominal}
    return json_digest(json_value(hung))[:ID_DIGITS]


def recording_id(inputs: Mapping[str, str]) -> str:
    """Compute the digest of a recording's inputs."""
    return json_digest(dict(inputs))[:ID_DIGITS]


def measured_owners(folder: Path) -> dict[str, str | None]:
    """Read the rig, crane and recording of a result folder.

    Raises InputError for a map measured with a yard file, or in several passes.
    """
    said, path = open_folder(folder)[0], folder / "result.json"
    if said["configuration"].get("yard") is not None:
        raise InputError(path, "was measured with --yard", "measure the targets in a map without it")
    if said.get("passes"):
        raise InputError(path, "is of several passes", "measure the targets in a map of one pass")
    by_encoders = said["reference"] == "yard"
    return {
        "calibration_id": said["calibration_id"],
        "mounting_id": said["yard_frame_id"] if by_encoders else None,
        "recording_id": None if by_encoders else recording_id(said["hashes"]["inputs"]),
    }


def yard_frame_id(recording: Recording, trajectory: Trajectory) -> str | None:
    """Compute a digest of what places the map in the yard; None if the map isn't in the yard."""
    return placing_id(recording) if trajectory.reference == "yard" else None


def placing_id(recording: Recording) -> str | None:
    """Compute a digest of what can place a recording in the yard; None if nothing can."""
    crane, frame = recording.crane(), frame_of(recording)
    mounted = None if crane is None else mounting_id(crane)
    return mounted if frame is None else json_digest([mounted, frame.digest])[:ID_DIGITS]


def frame_name(recording: Recording, trajectory: Trajectory, inputs: Mapping[str, str]) -> str:
    """Name a trajectory's frame: `yard:` and the digest of what places it there, or `world:` and that of the
    recording's inputs, as no other recording shares its world.
    """
    placed = yard_frame_id(recording, trajectory)
    return f"world:{recording_id(inputs)}" if placed is None else f"yard:{placed}"


def crane_in_yard(crane: CraneSamples, frame: YardFrame) -> CraneSamples:
    """Transform encoder readings to the surveyed yard, or give the body the calibrated attitude."""
    pose = frame.yard_from
    if pose.source == "encoders":
        crane = crane if frame.bend is None else bent_crane(crane, frame.bend)
        return replace(
            crane, position_m=pose.apply(crane.position_m),
            crane_to_body_m=pose.rotation @ crane.crane_to_body_m,
            yard_from_body_nominal=pose.rotation @ crane.yard_from_body_nominal,
        )  # fmt: skip
    return crane if frame.attitude is None else replace(crane, yard_from_body_nominal=frame.attitude)


def bent_crane(crane: CraneSamples, bend: CraneBend) -> CraneSamples:
    """Move readings to the true positions of a bending crane, and turn the body by the mean tilt there."""
    place = crane.position_m
    return replace(
        crane, position_m=bend.moved(place, crane.crane_to_body_m),
        yard_from_body_nominal=bend.turn(place) @ crane.yard_from_body_nominal,
    )  # fmt: skip


def placed_in_yard(trajectory: Trajectory, frame: YardFrame | None) -> Trajectory:
    """Transform a trajectory from `world` to the yard, each pose only with its own covariance."""
    if frame is None or trajectory.reference != "world" or frame.yard_from.source != "world":
        return trajectory
    turn = np.kron(np.eye(2), frame.yard_from.rotation)
    frames = tuple(
        replace(
            one, reference_from_body=frame.yard_from @ one.reference_from_body,
            covariance=turn @ one.covariance @ turn.T,
        )
        for one in trajectory.frames
    )  # fmt: skip
    return replace(trajectory, reference="yard", frames=frames)


def with_shared(trajectory: Trajectory, frame: YardFrame | None) -> Trajectory:
    """Add the uncertainty of the yard frame to each pose's covariance; it is common to all poses."""
    if frame is None or trajectory.reference != "yard":
        return trajectory
    frames = tuple(
        replace(one, covariance=one.covariance + shared_covariance(one.reference_from_body, frame))
        for one in trajectory.frames
    )
    return replace(trajectory, frames=frames)


def shared_covariance(yard_from_body: Pose, frame: YardFrame) -> Float64:
    """Compute the covariance (6, 6) that the yard frame adds to a pose, rotation first, in the yard."""
    carry, covariance = np.eye(6), frame.covariance
    if frame.yard_from.source == "body" or frame.attitude is not None:
        carry[3:] = 0.0  # only the attitude is used; the encoders give the body's position
    else:
        carry[3:, :3] = -skew(yard_from_body.translation - frame.yard_from.translation)
    if frame.bend is not None:
        here = frame.yard_from.inverse().apply(yard_from_body.translation[None])[0]
        carry = np.hstack([carry, bend_carry(frame.bend, frame.yard_from.rotation, here)])
        covariance = frame.bend.covariance
    added: Float64 = carry @ covariance @ carry.T
    return added


def shared_height_sigma_m(frame: YardFrame, x_m: Float64, y_m: Float64, body_m: Float64) -> Float64:
    """Compute the sigma (m) that the yard frame adds to heights at places (N,).

    body_m: (3,) position of the body that saw them.
    """
    about = body_m if frame.attitude is not None else frame.yard_from.translation
    lifted = 0.0 if frame.attitude is not None else 1.0
    row = np.zeros((x_m.size, 6))
    row[:, 0], row[:, 1], row[:, 5] = y_m - about[1], -(x_m - about[0]), lifted
    covariance = frame.covariance
    if frame.bend is not None:
        back = frame.yard_from.inverse()
        points = back.apply(np.column_stack([x_m, y_m, np.zeros(x_m.size)]))
        row = np.hstack([row, bend_heights(frame.bend, back.apply(body_m[None])[0], points)])
        covariance = frame.bend.covariance
    sigma: Float64 = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", row, covariance, row), 0))
    return sigma


def _expect_sure(frame: YardFrame) -> None:
    turn, place = (
        float(np.sqrt(max(np.linalg.eigvalsh(part)[-1], 0)))
        for part in (frame.covariance[:3, :3], frame.covariance[3:, 3:])
    )
    if np.degrees(turn) > MAX_TURN_DEG or place > MAX_PLACE_M:
        raise InputError(
            frame.path, f"is too unsure to place anything: turned to ± {np.degrees(turn):.3g} deg, placed to "
            f"± {place:.3g} m", "calibrate with more targets, well apart",
        )  # fmt: skip


def _expect_fits(frame: YardFrame, recording: Recording) -> None:
    """Raise InputError if the frame belongs to another rig, crane or recording, or can't be used here."""
    crane, path, source = recording.crane(), frame.path, frame.yard_from.source
    own = calibration_id(recording.rig)
    if frame.calibration_id not in (None, own):
        problem = (
            f"belongs to another rig or calibration ({frame.calibration_id}; {recording.path} has {own})"
        )
        raise InputError(path, problem, "calibrate the yard again with this rig")
    if crane is None:
        if source != "world":
            problem = f"says where the {source} lies, but {recording.path} has no encoders that are used"
            raise InputError(path, problem, "give a yard file of this recording's world")
        if frame.recording_id not in (None, recording_id(recording.digests())):
            problem = f"is of another recording's world, which {recording.path} doesn't share"
            raise InputError(path, problem, "measure the targets in this recording's map")
        return
    if source == "world" and frame.attitude is None:
        problem = f"is of a world without encoders; {recording.path} has encoders"
        raise InputError(path, problem, "measure the targets in a map by encoders (--frame encoders)")
    if frame.mounting_id not in (None, mounting_id(crane)):
        problem = (
            f"belongs to another crane, or the rig was mounted anew since (not as {recording.path} says)"
        )
        raise InputError(path, problem, "calibrate the yard again")


def frame_notes(frame: YardFrame | None) -> tuple[str, ...]:
    """List the assumptions made about the yard frame."""
    if frame is None:
        return ()
    notes = [f"yard frame {frame.path.name}: {doubt}" for doubt in frame.doubts]
    if frame.calibration_id is None:
        notes.append(f"{frame.path.name} doesn't say which rig it is of: taken to be this one's")
    return tuple(notes)
