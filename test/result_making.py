"""A calibration with all kinds of values in it."""

import numpy as np

from hand_eye_calib.calibration import Calibration, DofObservability, DofVerdict, SolveStatus
from hand_eye_calib.geometry import se3

NAMES = ("x", "y", "z", "roll", "pitch", "yaw")


def calibration(**changes):
    random = np.random.default_rng(11)
    root = random.normal(size=(6, 6)) * 1e-3
    covariance = root @ root.T
    covariance[2, 2] = np.inf
    verdicts = [DofVerdict.UNOBSERVABLE if name == "z" else DofVerdict.OBSERVED for name in NAMES]
    sigmas = np.where([name == "z" for name in NAMES], np.inf, random.uniform(1e-7, 1e-2, 6))
    values = {
        "T_parent_child": se3.exp(random.normal(size=6)),
        "covariance": covariance,
        "status": SolveStatus.UNOBSERVABLE,
        "observability": tuple(map(DofObservability, NAMES, verdicts, sigmas.tolist())),
        "objective": 1 / 3,
        "method": "dnlo",
        "reference": "B10",
        "backend": "fast",
        "n_poses": 448,
        "n_pairs": 438,
        "n_inliers": 400,
        "time_offset_s": -0.1,
        "scale": 1e-05,
        "stamp_ns": 1317375625661736123,
        "parent_frame": "lidar",
        "child_frame": "caméra: links",
        "warnings": ("z is not observable: 'no'", "second\nline"),
    }
    return Calibration(**(values | changes))
