"""Our results beside the published results of others, on their recordings, by their protocols.

``python -m reproduction.independent --data-folder DIR [--page PAGE]``: DIR contains the recordings
(``independent/``, and ``asl_robot_arm/`` with the arm). Segments of long recordings are drawn anew
at every run.
"""

import hashlib
import random
import re
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from scipy.spatial.transform import Rotation

import hand_eye_calib as hec
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.stops.closed_form import Stops
from hand_eye_calib.extras.stops.robot_world import RobotWorld, solve
from hand_eye_calib.extras.stops.samples import read_arm_samples
from reproduction.coverage.measures import HALF_WIDTH_90
from reproduction.recordings import between
from reproduction.writing import counted, markdown_table, show, study_parser

# Largest time (s) between the stamps of hand and camera at a stop of the arm.
_WITHIN_S = 0.011

# The five published splits of the arm: the first characters of the SHA-256 digest of the names of
# their fitted stops. A split with another digest is not the published split.
_DIGESTS = ("78a5cd77", "f8a9c316", "b028e440", "0aaad5b3", "cb8a6787")

# Fewest stops of a camera and a tag for an estimate of the camera's pose.
_MIN_STOPS = 20

# Mount of Shrimp as measured by hand: translation (m), rotation vector (rad).
_SHRIMP = np.r_[-0.0320, -0.0048, 0.8822, 0.01358, 0.00200, -3.11428]
# Factors from m and rad to m and deg.
_SHRIMP_UNITS = np.repeat([1.0, 180.0 / np.pi], 3)
# Published mean errors by the length of the segments (s): x, y, z (m), about x, y, z (deg).
_SHRIMP_PUBLISHED = {
    50: (0.082, 0.054, 0.112, 0.304, 0.459, 1.128),
    100: (0.072, 0.035, 0.101, 0.288, 0.384, 1.076),
    300: (0.048, 0.021, 0.102, 0.263, 0.314, 1.052),
}


@dataclass(frozen=True)
class Row:
    """A value that we measured, and the best published value."""

    recording: str
    figure: str
    ours: str
    published: str
    source: str


def digest(path: Path) -> str:
    """Return the first characters of the SHA-256 digest of a file."""
    content = path.read_bytes()
    return hashlib.sha256(content).hexdigest()[:12]


def closure(
    Ts_a: FloatArray, X: FloatArray, Z: FloatArray, Ts_b: FloatArray
) -> tuple[float, float]:
    """Return the root mean square angle (deg) and distance (mm) between ``A X`` and ``Z B``.

    ``Ts_a`` and ``Ts_b`` are the stacks A and B (K, 4, 4); X and Z are (4, 4).
    """
    from_left = Ts_a @ X
    from_right = Z @ Ts_b
    turns = se3.relative_rotations(
        se3.rotation_of(from_left), se3.rotation_of(from_right)
    )
    angles = se3.rotation_angle(turns)
    angle_rad = np.sqrt(np.mean(angles**2))
    apart = se3.translation_of(from_left) - se3.translation_of(from_right)
    squares = np.sum(apart**2, axis=1)
    distance_m = np.sqrt(np.mean(squares))
    return float(np.degrees(angle_rad)), 1e3 * float(distance_m)


def closure_of_motions(
    X: FloatArray, Ts_a: FloatArray, Ts_b: FloatArray
) -> tuple[float, float]:
    """Return the closure of A X = X B for the motions between all pairs of poses."""
    later, earlier = np.triu_indices(len(Ts_a), 1)[::-1]
    motions_a = se3.inverse(Ts_a[later]) @ Ts_a[earlier]
    motions_b = se3.inverse(Ts_b[later]) @ Ts_b[earlier]
    return closure(motions_a, X, X, motions_b)


def _matrices(path: Path) -> FloatArray:
    """Read poses (N, 4, 4) from a CSV file with the columns t, x, y, z, qx, qy, qz, qw."""
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    quats = rows[:, 4:8]
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return np.asarray(se3.from_quat_xyzw(rows[:, 1:4], quats))


@dataclass(frozen=True, order=True)
class _Stop:
    """A stop: its name, and its rows in the files of hand and camera."""

    name: str
    hand: int
    eye: int


def _nearest_stops(hand_s: FloatArray, eye_s: FloatArray) -> list[_Stop]:
    """Pair every stamp (s) of the camera with the nearest stamp of the hand.

    A stamp of the hand is used once, with its closest stamp of the camera. Stops are sorted by
    name, as in the published splits.
    """
    best: dict[int, tuple[float, int]] = {}
    for row, stamp_s in enumerate(eye_s):
        distances_s = np.abs(hand_s - stamp_s)
        nearest = int(np.argmin(distances_s))
        distance_s = float(distances_s[nearest])
        closest_s, _ = best.get(nearest, (np.inf, 0))
        if distance_s <= _WITHIN_S and distance_s < closest_s:
            best[nearest] = (distance_s, row)
    stops = []
    for hand, (_, eye) in best.items():
        stops.append(_Stop(f"ethz-absolute-{hand:05d}-{eye:05d}", hand, eye))
    return sorted(stops)


def ethz(folder: Path) -> Iterator[Row]:
    """Calibrate with 32 stops of an arm and test on 16 other stops, for five splits."""
    names = "base_link_sr300_hinge.csv", "target_ir.csv"
    start = "robot_arm_complete_bag_color_and_ir"
    files = [folder / "asl_robot_arm" / f"{start}_{name}" for name in names]
    hand_s, eye_s = (np.loadtxt(file, delimiter=",")[:, 0] for file in files)
    hand, eye = (_matrices(file) for file in files)
    stops = _nearest_stops(hand_s, eye_s)
    motions = []
    poses = []
    seconds = []
    n_same = 0
    for seed, beginning in enumerate(_DIGESTS):
        order = list(range(len(stops)))
        random.Random(seed).shuffle(order)
        held_out = [stops[k] for k in sorted(order[:16])]
        fitted = [stops[k] for k in sorted(order[16:48])]
        names_of_stops = "\n".join(stop.name for stop in fitted)
        name = hashlib.sha256(names_of_stops.encode()).hexdigest()
        n_same += name.startswith(beginning)

        A = hand[[stop.hand for stop in fitted]]
        B = eye[[stop.eye for stop in fitted]]
        started = time.process_time()
        fit = solve(Stops(A, B, has_target=True))
        seconds.append(time.process_time() - started)

        A = hand[[stop.hand for stop in held_out]]
        B = eye[[stop.eye for stop in held_out]]
        X = fit.T_parent_child
        motions.append(closure_of_motions(X, A, B))
        poses.append(closure(A, X, fit.T_world_world, B))

    source = f"{names[0]} {digest(files[0])}, {n_same} of 5 splits"
    text = "{:.4f} deg, {:.3f} mm"
    ours = text.format(*np.mean(motions, axis=0))
    published = text.format(0.8672, 13.821)
    figure = "closure of A X = X B, 16 poses held out, mean of 5"
    yield Row("ETHZ arm", figure, ours, published, source)
    ours = text.format(*np.mean(poses, axis=0))
    published = text.format(0.6247, 10.779)
    yield Row("ETHZ arm", "closure of A X = Z B", ours, published, source)
    ours = f"{1e3 * np.median(seconds):.0f} ms"
    yield Row("ETHZ arm", "time of a solve", ours, "30 ms", source)


def camodocal(folder: Path) -> Iterator[Row]:
    """Calibrate the example of handeye_calib_camodocal: motions between neighbouring stops."""
    path = (
        folder / "independent" / "camodocal_example" / "TransformPairsInput.yml"
    )
    samples = read_arm_samples(path)
    A = samples.robot
    B = samples.tracking
    X = solve(Stops(A, B)).T_parent_child
    motions_a = se3.inverse(A[:-1]) @ A[1:]
    motions_b = se3.inverse(B[:-1]) @ B[1:]
    angle_deg, distance_mm = closure(motions_a, X, X, motions_b)
    figure = "closure between neighbours"
    ours = f"{angle_deg:.2f} deg, {distance_mm:.2f} mm"
    source = f"{path.name} {digest(path)}"
    yield Row("CamOdoCal's example", figure, ours, "7.82 deg, 36.97 mm", source)


def moveit(folder: Path) -> Iterator[Row]:
    """Calibrate the samples of MoveIt's tests: a fixed camera, in the frame of the robot's base."""
    path = folder / "independent" / "moveit_samples" / "pose_samples.json"
    samples = read_arm_samples(path)
    fit = solve(Stops(samples.robot, samples.tracking))
    T_base_camera = fit.T_world_world
    published = Rotation.from_euler("XYZ", [0.230, -2.540, 1.950]).as_matrix()
    turned = published.T @ T_base_camera[:3, :3]
    angle_deg = np.degrees(se3.rotation_angle(turned))
    values = " ".join(f"{value:.4f}" for value in T_base_camera[:3, 3])
    figure = "camera in the robot's base, m"
    ours = f"{values}, {angle_deg:.2f} deg from the published"
    text = "0.659 -0.249 0.830, to 1 %; angles to 0.01 rad: rounding makes 0.29 deg rms"
    yield Row("MoveIt", figure, ours, text, f"{path.name} {digest(path)}")


def _chi_square_per_degree(
    Zs: FloatArray, weights: FloatArray, covariance: FloatArray
) -> float:
    """Return chi-square of poses (K, 4, 4) about their weighted mean, per degree of freedom.

    ``weights`` (K, 6, 6) are the inverse covariances of the poses. ``covariance`` (6, 6) is the
    covariance of the mean.
    """
    errors = se3.log(se3.inverse(Zs[0]) @ Zs)
    errors -= covariance @ np.einsum("kij,kj->i", weights, errors)
    total = float(np.einsum("ki,kij,kj->", errors, weights, errors))
    n_degrees = 6.0 * (len(Zs) - 1)
    return total / n_degrees


def wise(folder: Path) -> Iterator[Row]:
    """Calibrate eight cameras that observe sixteen tags: pose Z of each camera, from each tag."""
    files = sorted((folder / "independent" / "wise_8_cameras").glob("*_A.csv"))
    fits_of_camera: dict[int, list[RobotWorld]] = defaultdict(list)
    n_stops = 0
    started = time.process_time()
    for path in files:
        _, camera = (int(number) for number in re.findall(r"\d+", path.name))
        A = _poses_wxyz(path)
        B = _poses_wxyz(path.with_name(path.name.replace("_A", "_B")))
        n_stops += len(A)
        if len(A) < _MIN_STOPS:
            continue
        fit = solve(Stops(A, B))
        if not fit.undetermined().size:
            fits_of_camera[camera].append(fit)
    seconds = time.process_time() - started

    sigmas_mm = []
    chi2 = []
    for fits in fits_of_camera.values():
        covariances = [fit.covariance[6:, 6:] for fit in fits]
        weights = np.asarray(np.linalg.inv(covariances), dtype=np.float64)
        covariance = np.linalg.inv(weights.sum(axis=0))
        sigmas = np.sqrt(np.diag(covariance))
        sigmas_mm.append(1e3 * sigmas[:3].mean())
        if len(fits) > 1:
            Zs = np.array([fit.T_world_world for fit in fits])
            chi2.append(_chi_square_per_degree(Zs, weights, covariance))

    ours = (
        f"{seconds:.1f} s, sigma {min(sigmas_mm):.1f}-{max(sigmas_mm):.1f} mm"
    )
    figure = f"{n_stops} stops, {len(fits_of_camera)} cameras: mean of the poses from their tags"
    source = f"{len(files)} pairs of files"
    yield Row("Wise et al.", figure, ours, "none readable", source)
    figure = f"poses of a camera from tags of {_MIN_STOPS} stops and more, chi-square per degree"
    ours = f"{np.median(chi2):.1f} ({min(chi2):.1f}-{max(chi2):.1f})"
    yield Row("Wise et al.", figure, ours, "", f"median of {len(chi2)} cameras")


def _poses_wxyz(path: Path) -> FloatArray:
    """Read poses (N, 4, 4) from a CSV file with the columns qw, qx, qy, qz, x, y, z."""
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    quats_xyzw = np.roll(rows[:, :4], -1, axis=1)
    return np.asarray(se3.from_quat_xyzw(rows[:, 4:7], quats_xyzw))


def shrimp_sensors(folder: Path) -> tuple[hec.Trajectory, ...]:
    """Read the trajectories of the farm robot's navigation system and lidar."""
    files = folder / "independent" / "shrimp"
    return tuple(
        _shrimp_trajectory(
            files / f"Shrimp{name}Data.mat", f"{name.lower()}Data"
        )
        for name in ("Nav", "Vel")
    )


def shrimp(folder: Path, n_segments: int) -> Iterator[Row]:
    """Calibrate random segments of a farm robot's drive, as long as those of Taylor and Nieto."""
    nav, velodyne = shrimp_sensors(folder)
    truth = np.eye(4)
    truth[:3, 3] = _SHRIMP[:3]
    truth[:3, :3] = se3.rotation_exp(_SHRIMP[3:])
    # The published mount is the pose of the navigation system in the lidar.
    truth = se3.inverse(truth)
    generator = np.random.default_rng()
    start_ns, end_ns = velodyne.stamps_ns[[0, -1]]
    for seconds, published in _SHRIMP_PUBLISHED.items():
        errors = []
        stated = []
        verdicts = []
        stated_measured = []
        for _ in range(n_segments):
            length_ns = seconds * 10**9
            first_ns = generator.integers(start_ns, end_ns - length_ns)
            last_ns = first_ns + length_ns
            parent = between(nav, first_ns, last_ns)
            child = between(velodyne, first_ns, last_ns)
            result = hec.calibrate(parent, child)
            relative = se3.inverse(truth) @ result.T_parent_child
            rotation_error = se3.rotation_log(relative[:3, :3])
            errors.append(np.r_[relative[:3, 3], np.degrees(rotation_error)])
            sigmas = np.sqrt(np.diag(result.covariance))
            sigmas_measured = np.sqrt(np.diag(result.covariance_measured))
            stated.append(_SHRIMP_UNITS * sigmas)
            stated_measured.append(_SHRIMP_UNITS * sigmas_measured)
            verdicts.append(result.verdict.value)
        # Errors against the truth are compared with whole sigmas, and the scatter of the segments
        # with measured sigmas.
        from_median = errors - np.median(errors, axis=0)
        truth_cover = np.mean(np.abs(errors) < HALF_WIDTH_90 * np.array(stated))
        scatter_cover = np.mean(
            np.abs(from_median) < HALF_WIDTH_90 * np.array(stated_measured)
        )
        figure = f"mean errors, {n_segments} random segments of {seconds} s"
        covers = f"truth {truth_cover:.0%}, scatter {scatter_cover:.0%}"
        ours = _three_decimals(np.mean(np.abs(errors), axis=0))
        yield Row(
            "Shrimp",
            f"{figure} (x y z m, about x y z deg)",
            f"{ours}; 90 % intervals: {covers}",
            _three_decimals(published),
            counted(verdicts),
        )


def _three_decimals(values: Iterable[float]) -> str:
    return " ".join(f"{value:.3f}" for value in values)


def _shrimp_trajectory(path: Path, name: str) -> hec.Trajectory:
    """Read a trajectory of Shrimp; the file contains the motion of every step, and its stamp."""
    data: Any = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)[
        name
    ]
    steps = np.asarray(data.T_Skm1_Sk, dtype=float)
    rotations = se3.rotation_exp(steps[:, 3:])
    moved = se3.inverse(se3.from_rotation_translation(rotations, steps[:, :3]))
    poses = np.broadcast_to(np.eye(4), moved.shape).copy()
    for k in range(1, len(moved)):
        poses[k] = poses[k - 1] @ moved[k]
    poses[:, :3, :3] = se3.nearest_rotation(poses[:, :3, :3])
    stamps_ns = np.asarray(data.time, dtype=np.int64) * 1000
    return hec.Trajectory(stamps_ns, poses)


def ntu_viral(folder: Path) -> Iterator[Row]:
    """Calibrate a prism on a drone in three flights, and compare the flights with each other."""
    data = folder / "independent" / "ntu_viral"
    published = np.loadtxt(data / "trans_B2prism.csv", delimiter=",")
    text = " ".join(f"{value:.4f}" for value in published)
    offsets = []
    precisions = []
    for flight in ("eee_01", "nya_01", "sbs_01"):
        parent = hec.read_trajectory(data / f"{flight}_odometry.csv", "csv")
        prism_file = data / f"{flight}_leica_pose.csv"
        child = hec.read_trajectory(prism_file, "csv", measures="positions")
        result = hec.calibrate(
            parent, child, child_measures="positions", time_offset="estimate"
        )
        offset = result.T_parent_child[:3, 3]
        sigmas = result.sigmas[:3]
        offsets.append(offset)
        precisions.append(1.0 / result.sigmas_measured[:3] ** 2)

        values = " ".join(f"{value:.4f}" for value in offset)
        sigmas_mm = " ".join(f"{1e3 * sigma:.1f}" for sigma in sigmas)
        z = np.max(np.abs(offset - published) / sigmas)
        ours = f"{values} +/- {sigmas_mm} mm, {result.verdict.value}, largest z {z:.1f}"
        yield Row(f"NTU VIRAL {flight}", "prism x y z m", ours, text, "CAD")

    weights = np.stack(precisions)
    mean = np.sum(weights * offsets, axis=0) / weights.sum(axis=0)
    deviations = np.stack(offsets) - mean
    chi2 = float(np.sum(weights * deviations**2)) / 6.0
    figure = "chi-square between flights, per degree of freedom, without the allowance"
    yield Row("NTU VIRAL", figure, f"{chi2:.2f}", "", "3 flights")


def main() -> None:
    """Measure all recordings, and print the table or put it into the page."""
    parser = study_parser("reproduction.independent", __doc__)
    parser.add_argument(
        "--segments",
        type=int,
        default=20,
        help="segments of Shrimp, for each length",
    )
    arguments = parser.parse_args()
    folder = arguments.data_folder or parser.error(
        "name the recordings with --data-folder"
    )
    rows: list[Row] = []
    for study in (ethz, camodocal, moveit, wise, ntu_viral):
        rows += study(folder)
    rows += shrimp(folder, arguments.segments)
    show(arguments.page, {"recordings": markdown_table(map(vars, rows))})


if __name__ == "__main__":
    main()
