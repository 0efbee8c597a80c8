"""Find a bag's Kalibr files and assign topics to sensors."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from barsight.calibration.files.kalibr import CamChain, ImuFile, read_camchain, read_imu_file
from barsight.calibration.files.rig_formats import body_is_cam0, read_rig_file, select_rig
from barsight.core.errors import InputError
from barsight.recording.base import RecordingSettings
from barsight.recording.formats.bag_file import (
    CLOUD_TYPE,
    COMPRESSED_TYPE,
    IMAGE_TYPE,
    IMU_TYPE,
    POINT_TYPE,
    Topic,
)
from barsight.recording.own_files import leads_outside

CRANE_TOPIC = "/crane0/position"
LASER_TOPIC = "/laser0/profiles"


@dataclass(frozen=True, eq=False)
class BagCalibration:
    """Kalibr's files for a bag. imu: None without imu.yaml. files: the files read."""

    chain: CamChain
    imu: ImuFile | None
    files: tuple[Path, ...]


@dataclass(frozen=True)
class BagTopics:
    """The topics to read; None if the bag has no such sensor."""

    cam0: str
    cam1: str
    imu: str | None
    crane: str | None
    laser: str | None


def find_calibration(path: Path, settings: RecordingSettings) -> BagCalibration:
    """Find Kalibr's files, named by the settings or in the bag's folder, then beside it.

    Raises `InputError` if there is no camchain or if it is ambiguous.
    """
    folders = [path, path.parent] if path.is_dir() else [path.parent]
    chain_path = settings.camchain or _find(folders, ("*camchain-imucam*", "*camchain*"), ())
    if chain_path is None and settings.rig is not None:
        rig = read_rig_file(settings.rig)
        return BagCalibration(CamChain(rig, (None, None), not body_is_cam0(rig)), None, (settings.rig,))
    if chain_path is None:
        raise InputError(
            path,
            "there is no calibration in or beside the bag",
            "put Kalibr's camchain-imucam.yaml there or name it (recording.camchain)",
        )
    imu_path = settings.imu_yaml or _find([chain_path.parent], ("imu", "*imu*"), ("camchain", "results"))
    imu = read_imu_file(imu_path) if imu_path else None
    files = (chain_path, imu_path) if imu_path else (chain_path,)
    chain = read_camchain(chain_path)
    chain = replace(chain, rig=select_rig(settings.rig, chain.rig))
    return BagCalibration(chain, imu, files if settings.rig is None else (*files, settings.rig))


def choose_topics(
    path: Path, topics: Sequence[Topic], calibration: BagCalibration, settings: RecordingSettings
) -> BagTopics:
    """Assign topics to sensors: by the settings, otherwise by the camchain, otherwise by the message types.

    Raises `InputError` for a missing topic and for an ambiguous one.
    """
    pictures = [topic for topic in topics if topic.kind in (IMAGE_TYPE, COMPRESSED_TYPE) and topic.count]
    wanted = (settings.cam0_topic, settings.cam1_topic)
    found = [
        _named(path, pictures, ask, f"recording.cam{k}_topic") if ask else _stated(pictures, stated)
        for k, (ask, stated) in enumerate(zip(wanted, calibration.chain.topics, strict=True))
    ]
    if None in found:
        found = _two_cameras(path, pictures)
    if found[0] == found[1]:
        raise InputError(path, f"cam0 and cam1 are both {found[0]}", "name two topics")
    present = {(topic.name, topic.kind) for topic in topics if topic.count}
    return BagTopics(
        str(found[0]),
        str(found[1]),
        _imu_topic(path, topics, calibration, settings),
        CRANE_TOPIC if (CRANE_TOPIC, POINT_TYPE) in present else None,
        LASER_TOPIC if (LASER_TOPIC, CLOUD_TYPE) in present else None,
    )


def _find(folders: Sequence[Path], patterns: tuple[str, ...], without: tuple[str, ...]) -> Path | None:
    """Find the file in the nearest folder by the most specific pattern; several matches are refused."""
    for folder in folders:
        for pattern in patterns:
            found = [
                file
                for suffix in (".yaml", ".yml")
                for file in folder.glob(pattern + suffix)
                if file.is_file() and not any(word in file.name for word in without)
            ]
            exact = [file for file in found if file.stem == pattern.strip("*")]
            if len(exact or found) > 1:
                names = ", ".join(sorted(file.name for file in found))
                raise InputError(
                    folder, f"holds several calibrations: {names}", "name the one to use in the settings"
                )
            if found:
                chosen = (exact or found)[0]
                if leads_outside(chosen, folder):
                    raise InputError(
                        chosen, "is a link out of its folder",
                        "copy the file there or name it (recording.camchain)",
                    )  # fmt: skip
                return chosen
    return None


def _named(path: Path, topics: Sequence[Topic], name: str, setting: str) -> str:
    if name not in {topic.name for topic in topics}:
        raise InputError(
            path, f"{setting} {name} is not a suitable topic of the bag", f"choose one of {_list(topics)}"
        )
    return name


def _stated(topics: Sequence[Topic], name: str | None) -> str | None:
    """Find the camchain's topic, or its compressed copy; the calibration may be of another recording."""
    names = {topic.name for topic in topics}
    return next((n for n in (name, f"{name}/compressed") if n in names), None)


def _two_cameras(path: Path, pictures: Sequence[Topic]) -> list[str | None]:
    """Find the two picture topics of a bag that has exactly two, the left one first."""
    names = {topic.name for topic in pictures}
    bases = sorted(name for name in names if name.removesuffix("/compressed") not in names - {name})
    if len(bases) != 2:
        raise InputError(
            path,
            f"has {len(bases)} picture topics ({_list(pictures)}); the camchain's aren't among them",
            "name both with recording.cam0_topic and recording.cam1_topic",
        )
    left_first = sorted(bases, key=lambda name: ("right" in name.lower(), name))
    if not side_by_side(*left_first):
        raise InputError(
            path, f"has two picture topics, {left_first[0]} and {left_first[1]}, whose names don't say that "
            "they are a left and a right one", "name both with recording.cam0_topic and recording.cam1_topic",
        )  # fmt: skip
    return [left_first[0], left_first[1]]


def side_by_side(left: str, right: str) -> bool:
    """Check whether two names differ only in left and right, l and r, or in a number and the next one."""
    first, second = (re.findall(r"\d+|[a-z]+", name.lower()) for name in (left, right))
    if len(first) != len(second):
        return False
    pairs = {(a, b) for a, b in zip(first, second, strict=True) if a != b}
    return bool(pairs) and all(_is_next(a, b) for a, b in pairs)


def _is_next(a: str, b: str) -> bool:
    if a.isdigit() and b.isdigit():
        return int(b) == int(a) + 1
    sides = (("left", "right"), ("l", "r"))
    return any(a.replace(left, right, 1) == b and a.endswith(left) for left, right in sides)


def _imu_topic(
    path: Path, topics: Sequence[Topic], calibration: BagCalibration, settings: RecordingSettings
) -> str | None:
    """Find the IMU's topic; also None if the camchain does not state the IMU's mounting."""
    imus = [topic for topic in topics if topic.kind == IMU_TYPE and topic.count]
    if settings.imu_topic:
        return _named(path, imus, settings.imu_topic, "recording.imu_topic")
    if not calibration.chain.knows_imu or not imus:
        return None
    stated = _stated(imus, calibration.imu.topic if calibration.imu else None)
    if stated is None and len(imus) > 1:
        raise InputError(path, f"has several IMU topics ({_list(imus)})", "name one with recording.imu_topic")
    return stated or imus[0].name


def _list(topics: Sequence[Topic]) -> str:
    return ", ".join(topic.name for topic in topics) or "none"
