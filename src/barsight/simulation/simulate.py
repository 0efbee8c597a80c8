"""Simulate a recording on disk: stack a yard, drive over it, render it, and write the truth alongside."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from barsight.calibration.geometry.camera import Camera
from barsight.core.arrays import Float32, Float64, Int64, UInt8
from barsight.core.files import atomic_directory
from barsight.core.pose import Pose
from barsight.core.records.sensor_samples import CraneSamples, LaserProfile
from barsight.core.stamps import seconds_to_ns
from barsight.simulation import euroc_files
from barsight.simulation.effects.faults import SpoiledLens, exposure_gain
from barsight.simulation.hanging_plate import paint_plate, plate_at
from barsight.simulation.lighting import Lamps, bake, hall_lamps
from barsight.simulation.optics import MountedRig, expose, mount_rig, sample_rays, vignette
from barsight.simulation.path_tracing import PathTracer
from barsight.simulation.render import NO_CODES, Shading, render_view
from barsight.simulation.scene import Scene, build_scene, select_primitives
from barsight.simulation.sensors import EPOCH_NS, ImuRecord, record_encoders, record_imu, seconds, stamps
from barsight.simulation.settings.recording import SimulationSettings
from barsight.simulation.stock import Stock, stack_yard
from barsight.simulation.textures import label_codes, surface_tile
from barsight.simulation.trajectory import CRANE_TO_BODY_M, SimulatedTrajectory
from barsight.simulation.truth import SurfaceTruth, bundle_rows, label_rows, true_depth, write_rig_truth

GROUND_TRUTH_HZ = 200
REST_BEFORE_FRAME_S = 0.6
STACK_M = 0.4
STEP_NS = 1_000_000
SUNK_M = 5.0


@dataclass(frozen=True, eq=False)
class LaidYard:
    """Everything in the yard. truth: JSON values by their files' names in `truth`. codes: see `Shading`."""

    scene: Scene
    truth: Mapping[str, Any]
    codes: UInt8 = field(default_factory=lambda: NO_CODES)


@dataclass(frozen=True, eq=False)
class World:
    """Everything that is fixed before the first image: yard, rig, path of the crane, frame stamps.

    number: of the pass over the yard, from 0; noise and sway are drawn anew for each pass.
    """

    settings: SimulationSettings
    laid: LaidYard
    mounted: MountedRig
    trajectory: SimulatedTrajectory
    frame_stamp_ns: Int64
    number: int = 0

    @classmethod
    def build(cls, settings: SimulationSettings) -> World:
        """Draw everything from the seed; each part has its own random stream."""
        return cls.over(laid_stock(settings), settings)

    @classmethod
    def over(cls, laid: LaidYard, settings: SimulationSettings, number: int = 0) -> World:
        """Draw rig and path over a given yard, which may come from elsewhere."""
        mounted = mount_rig(settings, stream(settings, 2))
        trajectory = SimulatedTrajectory.plan(
            settings.length_m, settings.camera, settings.motion, mounted.nominal_yard_from_body,
            stream(settings, 3), stream(settings, 3, number) if number else None,
            settings.girder,
        )  # fmt: skip
        return cls(settings, laid, mounted, trajectory, frame_stamps(settings, trajectory), number)

    def stream(self, *number: int) -> np.random.Generator:
        """Create a random stream for what is drawn anew in each pass."""
        return stream(self.settings, *number, *((self.number,) if self.number else ()))

    @property
    def scene(self) -> Scene:
        """Return the geometry of everything in the yard."""
        return self.laid.scene

    def yard_from_body(self, camera_stamp_ns: int) -> Pose:
        """Compute the exact pose at a camera stamp: t_imu = t_cam + timeshift."""
        imu_stamp = camera_stamp_ns + self.mounted.rig.timeshift_cam_imu_ns
        motion = self.trajectory.at(seconds(np.array([imu_stamp], dtype=np.int64)))
        return Pose("yard", "body", motion.yard_from_body[0], motion.position_m[0])

    def image_velocity(self, camera_stamp_ns: int, camera: Camera, mounting: Pose) -> Float64:
        """Compute the image centre's velocity, right and down, px/s, for a point STACK_M above the floor."""
        now = self.yard_from_body(camera_stamp_ns) @ mounting
        ray = now.rotation[:, 2]
        point = now.translation + ray * (STACK_M - now.translation[2]) / ray[2]
        around = [
            camera.project(
                (self.yard_from_body(camera_stamp_ns + by) @ mounting).inverse().apply(point[None])
            )[0]
            for by in (-STEP_NS, STEP_NS)
        ]
        velocity: Float64 = (around[1] - around[0]) / (2e-9 * STEP_NS)
        return velocity


def simulate(
    out: Path,
    settings: SimulationSettings,
    progress: Callable[[int, int], None] | None = None,
    laid: LaidYard | None = None,
    number: int = 0,
) -> None:
    """Write a simulated recording with its truth to the new folder `out`.

    progress: called with (pairs written, total pairs). laid: a yard to use instead of a stock drawn from the
    seed. number: of the pass over it, see `World`. Raises OutputError if `out` can't be written; no partial
    output is left then, nor after an interruption.
    """
    with atomic_directory(out) as folder:
        world = World.build(settings) if laid is None else World.over(laid, settings, number)
        truth_folder = folder / "truth"
        truth_folder.mkdir()
        surface = SurfaceTruth(world.scene, settings)
        imu = _write_slow_sensors(folder / "mav0", world, surface)
        _write_pictures(folder, world, surface, progress)
        surface.write(truth_folder)
        for name, content in world.laid.truth.items():
            (truth_folder / name).write_text(json.dumps(content, indent=1), encoding="utf-8")
        write_rig_truth(
            world.mounted.rig, imu.gyro_bias_radps, imu.accel_bias_mps2, np.array(CRANE_TO_BODY_M), settings,
            truth_folder,
        )  # fmt: skip


def frame_stamps(settings: SimulationSettings, trajectory: SimulatedTrajectory) -> Int64:
    """Compute stamps (frames,) on the camera's clock: first and last at rest, others evenly along X."""
    distance = settings.length_m + 2 * settings.motion.overrun_m
    inner = trajectory.begin_x_m + distance * np.arange(1, settings.frames - 1) / (settings.frames - 1)
    inner = inner[::-1] if settings.motion.backward else inner
    times = [trajectory.start_s - REST_BEFORE_FRAME_S]
    times += [trajectory.time_at_x(float(x)) for x in inner]
    times.append(trajectory.settled_s + REST_BEFORE_FRAME_S)
    shift = seconds_to_ns(settings.sensors.timeshift_cam_imu_s)
    return np.array([EPOCH_NS + seconds_to_ns(t) - shift for t in times], dtype=np.int64)


def _write_slow_sensors(mav0: Path, world: World, surface: SurfaceTruth) -> ImuRecord:
    settings, trajectory, rig = world.settings, world.trajectory, world.mounted.rig
    sensors, lever = settings.sensors, np.array(CRANE_TO_BODY_M)
    euroc_files.write_cameras(mav0, rig, world.frame_stamp_ns)
    euroc_files.write_body(mav0)
    imu = record_imu(trajectory, sensors, world.stream(4))
    euroc_files.write_imu(mav0 / "imu0", imu, sensors)
    stamp_ns, place = record_encoders(trajectory, sensors, lever, world.stream(5))
    nominal = world.mounted.nominal_yard_from_body
    std_m = round(float(np.hypot(sensors.encoder_std_m, sensors.encoder_step_m / 12**0.5)), 6)
    euroc_files.write_crane(mav0 / "crane0", CraneSamples(stamp_ns, place, lever, nominal, std_m))
    if sensors.laser_y_m:
        noise = world.stream(6).normal(0, 1, surface.profile_z_m.shape) * sensors.laser_std_m
        x_m, z_m = surface.profile_x_m, surface.profile_z_m + noise
        profiles = tuple(
            LaserProfile(k, x_m, np.full(x_m.size, y), z_m[k], sensors.laser_std_m)
            for k, y in enumerate(surface.profile_y_m)
        )
        euroc_files.write_laser(mav0 / "laser0", profiles)
    truth_ns = stamps(trajectory, GROUND_TRUTH_HZ)
    motion = trajectory.at(seconds(truth_ns))
    euroc_files.write_ground_truth(
        mav0 / "state_groundtruth_estimate0", truth_ns, motion.position_m, _quaternions(motion.yard_from_body)
    )
    return imu


def _write_pictures(
    folder: Path, world: World, surface: SurfaceTruth, progress: Callable[[int, int], None] | None
) -> None:
    settings, rig = world.settings, world.mounted.rig
    lamps = hall_lamps(settings.camera.above_floor_m, settings.light)
    footprint_m = settings.camera.above_floor_m / settings.camera.focal_px
    tile = surface_tile(stream(settings, 7), footprint_m, settings.yard.texture_ratio)
    side = settings.camera.samples_per_side
    cameras = (
        ("cam0", rig.cam0, rig.body_from_cam0, 1.0),
        ("cam1", rig.cam1, rig.body_from_cam1, settings.camera.cam1_gain),
    )
    rays = [sample_rays(camera, side) for _, camera, _, _ in cameras]
    render = _renderer(world, lamps, tile, rays)
    shares = [vignette(camera, settings.camera.vignetting) for _, camera, _, _ in cameras]
    shape = (settings.camera.height_px, settings.camera.width_px)
    lenses = [SpoiledLens.draw(settings.faults, shape, stream(settings, 10, k)) for k in range(2)]
    deep = depth_views(settings)
    for number, stamp in enumerate(world.frame_stamp_ns.tolist()):
        yard_from_body = world.yard_from_body(stamp)
        plate = plate_at(settings.magnet, number / settings.frames, yard_from_body)
        surface.count_frame(rig, yard_from_body, plate)
        for k, (name, camera, mounting, exposure) in enumerate(cameras):
            yard_from_cam = yard_from_body @ mounting
            radiance = render(k, yard_from_cam, 2 * number + k)
            if plate is not None:
                paint_plate(radiance, plate, rays[k], side, yard_from_cam, tile)
            step = float(world.stream(11, number).normal())
            phase = float(world.stream(12, 2 * number + k).uniform(0, 2 * np.pi))
            gain = exposure_gain(settings.faults, step, phase) * exposure
            radiance = lenses[k].spoil(
                radiance, settings.faults, world.image_velocity(stamp, camera, mounting)
            )
            image = expose(radiance, shares[k], gain, settings.camera, world.stream(9, 2 * number + k))
            lenses[k].kill(image)
            euroc_files.write_png(folder / "mav0" / name / "data" / f"{stamp}.png", image)
            if number in deep:
                depth = true_depth(world.scene, camera, yard_from_cam, plate)
                np.savez_compressed(folder / "truth" / f"depth_{name}_{stamp}.npz", z=depth)
        if progress is not None:
            progress(number + 1, settings.frames)


def _renderer(
    world: World, lamps: Lamps, tile: Float32, rays: Sequence[Float32]
) -> Callable[[int, Pose, int], Float32]:
    """Prepare the renderer: a function of the camera's number, its pose and the picture's number."""
    settings = world.settings
    side = settings.camera.samples_per_side
    if settings.renderer == "mitsuba":
        tracer = PathTracer(world.scene.primitives, lamps, tile, settings.paths, settings.seed)
        return lambda k, pose, number: tracer.render(rays[k], side, pose, number)
    look = Shading(lamps, bake(world.scene, lamps, stream(settings, 8)), tile, world.laid.codes)
    return lambda k, pose, _: render_view(world.scene, look, rays[k], side, pose)


def depth_views(settings: SimulationSettings) -> set[int]:
    """Choose the frames whose true depth is stored, evenly spaced."""
    views = (np.arange(settings.depth_views) + 0.5) / max(settings.depth_views, 1) * settings.frames
    return {int(v) for v in views}


def _quaternions(rotations: Float64) -> Float64:
    """Convert to quaternions (N, 4) w x y z, without sign changes between successive ones."""
    q = Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]]
    flips = np.cumprod(np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1, 1))
    q[1:] *= flips[:, None]
    return q


def lay_stock(stock: Stock, settings: SimulationSettings, gone: Collection[int] = ()) -> LaidYard:
    """Lay a stock without the bundles in `gone`, which doesn't alter the appearance of the others."""
    sunk = np.array([0.0, 0.0, -SUNK_M])
    bundles = [
        replace(b, centre_m=b.centre_m + sunk) if k in gone else b for k, b in enumerate(stock.bundles)
    ]
    scene = build_scene(replace(stock, bundles=tuple(bundles)), settings, stream(settings, 1))
    if gone:
        kept = scene.primitives.shape[:, 2] > -SUNK_M / 2
        scene = select_primitives(scene, kept)
    there = tuple(b for k, b in enumerate(stock.bundles) if k not in gone)
    rows = bundle_rows(there)
    if max(settings.yard.label_m) == 0:
        return LaidYard(scene, {"bundles.json": rows})
    truth = {"bundles.json": rows, "labels.json": label_rows(scene, settings.seed)}
    return LaidYard(scene, truth, label_codes(settings.seed, len(stock.bundles)))


def laid_stock(settings: SimulationSettings) -> LaidYard:
    """Lay the stock drawn from the seed."""
    return lay_stock(stack_yard(settings, stream(settings, 0)), settings)


def stream(settings: SimulationSettings, *number: int) -> np.random.Generator:
    """Create the random stream of one drawn quantity."""
    return np.random.default_rng((settings.seed, *number))
