"""List the paper's contents, the code that implements each item, and its place on the page."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["equation", "figure", "table", "conclusion"]
MEASURE = "barsight measure R -o OUT --stereo.method paper --motion.estimator paper --map.contours paper"
ODOMETRY = "barsight odometry R --estimator paper --use stereo imu"
PAGE = "barsight paper -o OUT"
CAMERA_IMU = "barsight calibrate camera-imu R -o OUT"


@dataclass(frozen=True)
class PaperEntry:
    """An item of the paper. code: `module:name` of its implementation, below `barsight`; paper: its
    content there; ours: a sentence on our version; command: the command that runs it.
    """

    kind: Kind
    number: int
    code: tuple[str, ...]
    paper: str
    ours: str
    command: str

    @property
    def place(self) -> str:
        """Return the id of its place on the page."""
        return f"{self.kind}-{self.number}"


def find_code(name: str) -> Any:
    """Find the object named `module:name`. Raises ImportError or AttributeError if it doesn't exist."""
    module, _, attributes = name.partition(":")
    found: Any = importlib.import_module(f"barsight.{module}")
    for attribute in attributes.split("."):
        found = getattr(found, attribute)
    return found


def _equation(number: int, code: str, paper: str, ours: str, command: str) -> PaperEntry:
    return PaperEntry("equation", number, tuple(code.split()), paper, ours, command)


_STEREO = "calibration.stereo.bundle_adjustment:adjust"
_RIGID = "registration.rigid:align_rigid"
_SVD = "registration.rigid:align_rigid core.pose:nearest_rotation"
_TREND = "motion.frame_to_frame.motion_trend:MotionTrend"
EQUATIONS = (
    _equation(
        1,
        _STEREO,
        "P_L = R_L P_W + T_L, P_R = R_R P_W + T_R",
        "Each board point is seen so by both cameras; bundle adjustment takes all pictures at once.",
        "barsight calibrate stereo BOARDS -o RIG",
    ),
    _equation(
        2,
        "core.pose:Pose.apply",
        "P_R = R P_L + T",
        "The same; poses name their frames.",
        "barsight calibrate stereo BOARDS -o RIG",
    ),
    _equation(
        3,
        "calibration.stereo.initialization:start_rig",
        "R = R_R R_L^-1, T = T_R - R T_L",
        "The same, for a start; the adjustment then goes on from it.",
        "barsight calibrate stereo BOARDS -o RIG",
    ),
    _equation(
        4,
        "stereo.baselines.winner_takes_all:subpixel_winners",
        "d* by the parabola through 3 costs",
        "The same, in the methods of comparison; ours aligns the pictures themselves below the pixel.",
        "barsight bench subpixel",
    ),
    _equation(
        5,
        "stereo.baselines.paper:iterate_bilateral stereo.baselines.bilateral_filter:bilateral_update",
        "C(x, y, d) = min(eta L, (d - D)^2), filtered bilaterally, again and again",
        "Literally there. It smooths D and adds no evidence from the pictures; ours goes back to them.",
        "barsight disparity LEFT RIGHT --method paper",
    ),
    _equation(
        6,
        "features.matching:hamming_distances features.matching:nearest_neighbours",
        "H(A, B): the bits in which two descriptors differ",
        "The same; --stitching.hamming sets the most bits that a match may differ in.",
        ODOMETRY,
    ),
    _equation(
        7,
        "features.matching:homography_inliers motion.frame_to_frame.stitching:PaperStitching",
        "E_s: the least sum of squared distances of x', y' from H x, y: one homography by RANSAC",
        "Literally there. It is one plane's: true matches off it are lost, so "
        "ours checks matches against a motion in 3D.",
        "barsight bench matching R",
    ),
    _equation(
        8,
        "calibration.camera_imu.calibration:calibrate_camera_imu",
        "the least sum of corner errors over poses, biases, gravity and the clocks' offset",
        "The same, on a spline, with covariance and verdict.",
        CAMERA_IMU,
    ),
    _equation(
        9,
        "inertial.model:BodyState",
        "a~ = a + b_a + n_a",
        "The same, where a is the acceleration minus gravity.",
        CAMERA_IMU,
    ),
    _equation(10, "inertial.model:ImuBias", "w~ = w + b_g + n_g", "The same.", CAMERA_IMU),
    _equation(
        11,
        f"{_TREND} inertial.preintegration:Preintegrator",
        "R, v and p from t to t + dt",
        "Preintegrated on the manifold: only the bias is subtracted, the noise goes into the covariance.",
        ODOMETRY,
    ),
    _equation(
        12,
        f"{_TREND}.predict features.matching:motion_inliers",
        "F(t + dt) = f(R, V, P) F(t)",
        "A match further than --stitching.trend-px from where R, V, P take it is left out; stereo "
        "and IMU suffice.",
        ODOMETRY,
    ),
    _equation(
        13,
        _RIGID,
        "e_i = p_i - (R q_i + t)",
        "The same; each point's covariance counts where one is given, which the paper's stitching does not.",
        ODOMETRY,
    ),
    _equation(14, _RIGID, "E = min 1/2 sum |e_i|^2", "The same.", ODOMETRY),
    _equation(15, _RIGID, "p' = mean of p", "The same; weighted where covariances are given.", ODOMETRY),
    _equation(16, _RIGID, "q' = mean of q", "The same; weighted where covariances are given.", ODOMETRY),
    _equation(17, _RIGID, "E in three parts", "The same; the last part is zero once centred.", ODOMETRY),
    _equation(
        18,
        _RIGID,
        "E_R = 1/2 sum |p'' - R q''|^2 = -tr(R sum q'' p''^T)",
        "The same, but for the terms without R, which the printed equation leaves out.",
        ODOMETRY,
    ),
    _equation(19, _SVD, "W = sum q'' p''^T = U S V^T", "The same.", ODOMETRY),
    _equation(
        20,
        f"{_SVD} paper.checks:printed_rotation",
        "R = U V^T",
        "The printed form is the transpose of the minimiser; ours is V diag(1, 1, det) U^T, which also "
        "guards against a reflection.",
        ODOMETRY,
    ),
)


def _figure(number: int, code: str, paper: str, ours: str, command: str = PAGE) -> PaperEntry:
    return PaperEntry("figure", number, tuple(code.split()), paper, ours, command)


_FEATURES = "paper.features:draw_features"
_MATCHES = "paper.features:draw_pairs"
FIGURES = (
    _figure(
        1,
        "paper.surface:cost_curve",
        "The parabola through three costs.",
        "A real pixel's costs (SAD over 7 x 7) and the parabola through the three lowest.",
    ),
    _figure(
        2,
        "paper.surface:loop_pictures stereo.baselines.paper:iterate_bilateral",
        "The loop: D0, cost space, bilateral filter, sub-pixel, again.",
        "D0 and the disparity after the loop; the shares of whole disparities stand under them.",
        "barsight disparity LEFT RIGHT --method paper",
    ),
    _figure(
        3,
        "paper.surface:relief_pictures",
        "3D at whole pixels has layers; below the pixel it is smooth.",
        "The same view's 3D, lit aslant, from whole disparities, by the paper's loop and by our stereo.",
    ),
    _figure(
        4,
        _FEATURES,
        "SIFT, SURF and ORB features on a stack's side and top.",
        "The same three on drawn pictures of both kinds.",
        "barsight bench features R",
    ),
    _figure(
        5,
        _MATCHES,
        "Initial matches of SIFT, SURF and ORB: many wrong.",
        "Nearest descriptors; lines go from the old place to the new one.",
        "barsight bench matching R",
    ),
    _figure(
        6,
        "motion.frame_to_frame.stitching:StitchedPoses",
        "IMU and cameras hold each other.",
        "Gyro and accelerometer predict; the pictures' pose corrects the velocity. What each part is off by:",
        ODOMETRY,
    ),
    _figure(
        7,
        "motion.frame_to_frame.stitching:PaperStitching",
        "The matching process.",
        "Its steps, with the matches that each leaves on this page's pictures.",
        ODOMETRY,
    ),
    _figure(
        8,
        _MATCHES,
        "Matches on the side after filtering.",
        "Blue: where the trend takes features; green: matches that conform.",
        "barsight bench matching R",
    ),
    _figure(
        9,
        _MATCHES,
        "Matches on the top after filtering.",
        "The same on the top surface.",
        "barsight bench matching R",
    ),
    _figure(
        10,
        "paper.cloud:stitched_pair",
        "Two clouds, in two colours, stitched.",
        "Two views' clouds from above, before and after the paper's stitching.",
        MEASURE,
    ),
    _figure(
        11,
        "paper.cloud:map_picture",
        "The cloud of the whole stack.",
        "The map by the paper's method and by ours.",
        MEASURE,
    ),
    _figure(
        12,
        "paper.cloud:contour_picture mapping.surface.contours:smooth_contour",
        "Contours of vision and laser, both filtered.",
        "Both through median, cubic interpolation and filter, as in the paper.",
        MEASURE,
    ),
)
TABLES = (
    PaperEntry(
        "table",
        1,
        ("benchmarks.stereo.target_size:bench_target_size", "paper.published:recomputed"),
        "A target of 90 mm at eight ranges by SGBM, CSCA and the paper's method.",
        "The printed sizes with recomputed errors, beside ours on a drawn bar of 90 mm.",
        "barsight bench target-size",
    ),
    PaperEntry(
        "table",
        2,
        ("paper.features:feature_rows",),
        "Number and time of features.",
        "The same layout, on this machine.",
        "barsight bench features R",
    ),
    PaperEntry(
        "table",
        3,
        ("paper.features:feature_rows",),
        "Matches before and after filtering.",
        "The same layout, with the share of true ones where truth is known.",
        "barsight bench matching R",
    ),
    PaperEntry(
        "table",
        4,
        ("paper.cloud:contour_scores",),
        "Vision against laser.",
        "Relative errors as in the paper (against 3.77 m) and against the stack's height.",
        "barsight bench yard",
    ),
)
CONCLUSIONS = (
    PaperEntry(
        "conclusion",
        1,
        ("pipeline.mapped_yard:map_yard",),
        "Stereo and IMU give the stack in 3D.",
        "The paper's method runs on stereo and IMU alone; ours beside it, without encoders and with.",
        ODOMETRY,
    ),
    PaperEntry(
        "conclusion",
        2,
        ("paper.surface:relief_pictures",),
        "Sub-pixel matching smooths the surface.",
        "Smooth isn't yet near to truth; Figure 3 shows both.",
        "barsight bench subpixel",
    ),
    PaperEntry(
        "conclusion",
        3,
        ("motion.frame_to_frame.motion_trend:MotionTrend",),
        "The motion trend removes mismatches.",
        "The homography comes first: what is left to the trend is the step between the two.",
        "barsight bench matching R",
    ),
    PaperEntry(
        "conclusion",
        4,
        ("paper.cloud:contour_scores",),
        "Accuracy and speed meet the field's demand.",
        "Table 4 has the whole pipeline's rate, not the camera's, and errors against laser and truth.",
        "barsight bench yard",
    ),
    PaperEntry(
        "conclusion",
        5,
        ("pipeline.lift_choice:find_lifts",),
        "It is a foundation for automatic lifting.",
        "Ours goes on to bundles and, for a magnet, to lifts; each is refused where a check isn't met.",
        "barsight lifts OUT --magnet MAGNET",
    ),
)
ENTRIES = (*EQUATIONS, *FIGURES, *TABLES, *CONCLUSIONS)
FURTHER = (
    (
        "labels on the bars (4.1): codes and plain numbers are read, or said to be illegible",
        "barsight measure R -o OUT --labels.read --labels.numbers",
    ),
    ("more sensors (6): the crane's laser in the map", "barsight measure R -o OUT --map.laser fuse"),
    ("more sensors (6): a second pair on the same body", "barsight measure PAIR1 PAIR2 -o OUT"),
    ("other environments (6)", "barsight simulate R --draw 7"),
)
"""Parts of the paper without a number: name of each, its place here, and its command."""
