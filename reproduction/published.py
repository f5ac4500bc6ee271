"""Trajectories and results published with Välimäki et al. 2023
(github.com/tau-alma/trajectory_calibration_experiments, MIT licence).

The folder of the data is a clone of this repository. ``kitti_tests`` and ``simulation_tests``
contain trajectories in TUM format. ``calib`` (or ``published``) contains a CSV file of results for
each data set.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs, motion_pairs
from hand_eye_calib.core.solvers import all_pairs
from hand_eye_calib.formats.trajectory_files.reading import read_trajectory
from reproduction.metrics import Errors

METHODS = ("ali", "dnl", "dnlo", "park", "taylor", "zhuang")
REFERENCES = ("A", "B1", "B5", "B10", "C5", "C10")
N_RUNS = 38

# Levels of each simulated data set, by the names of their folders.
_LEVELS: dict[str, dict[str, float | None]] = {
    "noise": {
        f"noise_{level:.6f}": level
        for level in (0.0, 0.002, 0.004, 0.006, 0.008, 0.01)
    },
    "outliers": {
        f"outliers_{level:.0f}": level
        for level in (0.0, 2.0, 4.0, 6.0, 8.0, 10.0)
    },
    "drift": {
        f"drift_{level:.6f}": level
        for level in (0.0, 0.01, 0.02, 0.03, 0.04, 0.05)
    },
    "mixture": {".": None},
}
# Column of the level in the CSV file of each data set.
_LEVEL_COLUMNS: dict[str, str | None] = {
    "noise": "noise_var",
    "outliers": "outliers",
    "drift": "drift_rate",
    "mixture": None,
}
SIMULATED = tuple(_LEVELS)
KITTI = ("kitti_short", "kitti_long")
LEVELS = {
    dataset: tuple(folders.values()) for dataset, folders in _LEVELS.items()
}
KEYFRAMES = "KeyFrameTrajectory_TUM_Format.txt"
KITTI_DRIVES = ("2011_09_30_drive_0027", "2011_10_03_drive_0027")

# Largest difference of two matrices (m or 1) that are the same answer, printed with eight digits.
_SAME_ANSWER = 1e-6


# The published ground truth of both KITTI drives is the pose of the unrectified cameras. The
# trajectories were computed from rectified images, whose cameras have a common orientation. The
# true poses of the rectified cameras follow from the calibration files of the drives.
# P_rect_02 in calib_cam_to_cam.txt of 2011_10_03: projection matrix of the left colour camera. Its
# last column is -K times the camera's position in the frame of camera 0, the left grey camera.
_P_RECT_02 = np.array(
    [
        [718.856, 0.0, 607.1928, 45.38225],
        [0.0, 718.856, 185.2157, -0.1130887],
        [0.0, 0.0, 1.0, 0.003779761],
    ]
)

# Pose of the rectified camera 0 in the lidar's frame, from calib_velo_to_cam.txt and R_rect_00 in
# calib_cam_to_cam.txt of 2011_09_30.
_T_LIDAR_CAMERA = se3.from_quat_xyzw(
    (0.3335, -0.0048, -0.0756), (-0.499146, 0.504085, -0.496817, 0.499924)
)

RECTIFIED = {
    "kitti_short": _T_LIDAR_CAMERA,
    "kitti_long": se3.from_rotation_translation(
        np.eye(3), -np.linalg.solve(_P_RECT_02[:, :3], _P_RECT_02[:, 3])
    ),
}


@dataclass(frozen=True)
class PublishedResult:
    """A row of the published results: the extrinsic with eight digits, and its errors (m, rad)
    with all digits.
    """

    T_parent_child: FloatArray
    errors: Errors


@dataclass(frozen=True)
class Case:
    """A pair of synchronised trajectories with ground truth and published results."""

    # noise, outliers, drift, mixture, kitti_short or kitti_long.
    dataset: str
    # noise: standard deviation per pose, m (twice that in rad). outliers: per cent of the poses.
    # drift: m per m. None for the others.
    level: float | None
    # Name of the trajectory within its data set.
    run: str
    # Poses at the same stamps.
    parent: Trajectory
    child: Trajectory
    # Ground truth as published, metres; (4, 4) array.
    T_parent_child: FloatArray
    # (method, reference) to :class:`PublishedResult`.
    results: Mapping[tuple[str, str], PublishedResult]

    @property
    def name(self) -> str:
        """Name of the case, such as noise/0.002/run_12."""
        folders = path_to(self.dataset, self.level)
        return "/".join([*folders, self.run])

    @property
    def stamps_ns(self) -> IntArray:
        """(N,) int64 array: stamps of both trajectories."""
        return self.child.stamps_ns

    def pairs(self, reference: str) -> MotionPairs:
        """Return the motion pairs of a reference."""
        return motion_pairs(self.parent.poses, self.child.poses, reference)


def path_to(dataset: str, level: float | None) -> list[str]:
    """Return the name of the data set and, if there is a level, its text."""
    if level is None:
        return [dataset]
    return [dataset, f"{level:g}"]


# Name, parent, child, truth.
Run = tuple[str, Trajectory, Trajectory, FloatArray]
# Results by level (None without levels), then by method and reference, in the order of the file.
PublishedResults = dict[
    float | None, dict[tuple[str, str], list[PublishedResult]]
]


def find_folder(folder: str | Path) -> str:
    """Return the folder of the published data: ``folder``, or the folder valimaki2023 in it.

    Raises InputError if it does not contain the published data.
    """
    inside = Path(folder) / "valimaki2023"
    data_folder = inside if inside.is_dir() else Path(folder)
    results_name = results_folder(data_folder).name
    names = ["kitti_tests", "simulation_tests", results_name]
    missing = [name for name in names if not (data_folder / name).is_dir()]
    if missing:
        raise InputError(
            f"{data_folder}: expected the published data, a clone of "
            f"github.com/tau-alma/trajectory_calibration_experiments; it has no {missing[0]}"
        )
    return str(data_folder.resolve())


def results_folder(folder: Path) -> Path:
    """Return the folder of the CSV files of results, in the folder of the data."""
    inside = folder / "published"
    return inside if inside.is_dir() else folder / "calib"


def load_kitti_short(folder: str | Path) -> Case:
    """Load drive 2011_09_30_drive_0027: parent lidar, child grey stereo camera.

    The first pose of the camera is dropped: it is older than the first pose of the lidar. Raises
    InputError if a file is missing or cannot be used.
    """
    return _kitti_case(
        Path(folder),
        dataset="kitti_short",
        name=KITTI_DRIVES[0],
        streams=("LIDAR_HDL64E/traj_HDL_aft_opt.csv", f"cam01/{KEYFRAMES}"),
        truth="camera_gray_left_in_velo_link.txt",
        results_file="kitti_tests_keyframe.csv",
        first=1,
    )


def load_kitti_long(folder: str | Path) -> Case:
    """Load drive 2011_10_03_drive_0027: parent grey stereo camera, child colour stereo camera.

    Raises InputError if a file is missing or cannot be used.
    """
    return _kitti_case(
        Path(folder),
        dataset="kitti_long",
        name=KITTI_DRIVES[1],
        streams=(f"cam01/{KEYFRAMES}", f"cam23/{KEYFRAMES}"),
        truth="camera_color_left_in_camera_gray_left.txt",
        results_file="kitti_tests_long_cam.csv",
    )


def _kitti_case(
    folder: Path,
    dataset: str,
    name: str,
    streams: Sequence[str],
    truth: str,
    results_file: str,
    first: int = 0,
) -> Case:
    """Load a drive from its files; the child's poses before pose ``first`` are dropped."""
    drive = folder / "kitti_tests" / name
    parent, child = (read_trajectory(drive / stream) for stream in streams)
    child = child[first:]
    # The paper interpolates the parent at the child's stamps. Outside of the parent's stamps, the
    # first and last segments are extrapolated.
    parent_poses = parent.at(child.stamps_ns, extrapolate=True, straight=True)
    parent_at_child = Trajectory(child.stamps_ns, parent_poses)
    T_parent_child = read_trajectory(drive / truth).poses[0]
    published = _read_results(results_folder(folder) / results_file, None)[None]
    results = {key: rows[0] for key, rows in published.items()}
    return Case(
        dataset=dataset,
        level=None,
        run=name,
        parent=parent_at_child,
        child=child,
        T_parent_child=T_parent_child,
        results=results,
    )


def load_simulated(
    folder: str | Path,
    datasets: Sequence[str] = SIMULATED,
    levels: Sequence[float] | None = None,
) -> list[Case]:
    """Load the simulated cases by data set and level, in the order of the published results.

    Each level has 38 trajectories. Noise, outliers and drift have six levels, of which ``levels``
    are loaded (all by default). The mixture has no levels. Raises InputError if a file is missing
    or cannot be used.
    """
    folder = Path(folder)
    cases = []
    for dataset in datasets:
        file = results_folder(folder) / f"simulation_tests_{dataset}.csv"
        results = _read_results(file, _LEVEL_COLUMNS[dataset])
        for level_folder, level in _LEVELS[dataset].items():
            if levels is None or level is None or level in levels:
                runs = _read_runs(
                    folder / "simulation_tests" / dataset / level_folder
                )
                cases += _match_runs(
                    dataset, level, runs, results.get(level, {})
                )
    return cases


def _read_runs(folder: Path) -> list[Run]:
    """Read (name, parent, child, truth) of every run."""
    runs = []
    for run in sorted(folder.glob("run_*")):
        parent = read_trajectory(run / "T_S1_W1.txt")
        child = read_trajectory(run / "T_S2_W2.txt")
        truth = read_trajectory(run / "T_S2_S1.txt").poses[0]
        runs.append((run.name, parent, child, truth))
    return runs


def _match_runs(
    dataset: str,
    level: float | None,
    runs: Sequence[Run],
    results: Mapping[tuple[str, str], Sequence[PublishedResult]],
) -> list[Case]:
    """Return the cases in the order of the published rows, which do not name their trajectory.

    Every (method, reference) block lists the same trajectories in the same order. Park's method has
    a unique answer, so its block identifies the trajectories.
    """
    order = _order_of_runs(runs, results)
    if order is None:
        where = dataset if level is None else f"{dataset} at level {level:g}"
        raise InputError(
            f"the trajectories of {where} do not match the published results: expected "
            f"{N_RUNS} runs (found {len(runs)}) and {N_RUNS} rows of every method and "
            "reference, one for each run; get the data again"
        )
    cases = []
    for position, index in enumerate(order):
        run, parent, child, truth = runs[index]
        results_of_run = {key: rows[position] for key, rows in results.items()}
        cases.append(
            Case(dataset, level, run, parent, child, truth, results_of_run)
        )
    return cases


def _order_of_runs(
    runs: Sequence[Run],
    results: Mapping[tuple[str, str], Sequence[PublishedResult]],
) -> list[int] | None:
    """Return the index of the run of each published row; None if runs and rows do not match."""
    if len(runs) != N_RUNS:
        return None
    for key in product(METHODS, REFERENCES):
        if len(results.get(key, ())) != N_RUNS:
            return None
    published = np.array([row.T_parent_child for row in results["park", "B1"]])
    answers = []
    for _, parent, child, _ in runs:
        pairs = motion_pairs(parent.poses, child.poses, "B1")
        answers.append(all_pairs.solve_park(pairs).T_parent_child)
    differences = np.abs(published[:, None] - np.array(answers))
    distances = differences.max(axis=(2, 3))
    order = distances.argmin(axis=1).tolist()
    is_same = distances.min(axis=1).max() < _SAME_ANSWER
    return order if is_same and len(set(order)) == N_RUNS else None


def _read_results(path: Path, level_column: str | None) -> PublishedResults:
    """Read a file of results; without a column of levels, all results have the level None."""
    results: PublishedResults = {}
    with open(path, newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            level = float(row[level_column]) if level_column else None
            method = row["algorithm"].lower()
            # The file's column "method" contains the reference.
            reference = row["method"].replace("A1", "A")
            results_of_level = results.setdefault(level, {})
            rows_of_method = results_of_level.setdefault(
                (method, reference), []
            )
            rows_of_method.append(_result(row))
    return results


def _result(row: Mapping[str, str]) -> PublishedResult:
    words = row["T"].replace("[", " ").replace("]", " ").split()
    T_parent_child = np.array(words, dtype=float).reshape(4, 4)
    e_rt = float(row["err_tr"])
    e_rR = float(np.radians(float(row["err_R"])))
    e_at = float(row["abs_tr"])
    e_aR = float(np.radians(float(row["abs_R"])))
    return PublishedResult(T_parent_child, Errors(e_rt, e_rR, e_at, e_aR))
