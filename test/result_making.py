"""A calibration with all kinds of values in it."""

import numpy as np

from hand_eye_calib.core.assessment.excitation import Excitation
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import (
    Calibration,
    DofObservability,
    DofVerdict,
    SolveStatus,
)
from hand_eye_calib.core.results.records import AS_WRITTEN, Finding

NAMES = ("x", "y", "z", "roll", "pitch", "yaw")


def dofs(sigmas, hidden=()):
    """What is known of six axes: the hidden ones nothing, the others to these sigmas."""
    seen = DofVerdict.OBSERVED
    unseen = DofVerdict.UNOBSERVABLE
    return tuple(
        DofObservability(name, unseen if name in hidden else seen, float(sigma))
        for name, sigma in zip(NAMES, sigmas, strict=True)
    )


def calibration(**changes):
    random = np.random.default_rng(11)
    root = random.normal(size=(6, 6)) * 1e-3
    covariance = root @ root.T
    covariance[2, 2] = np.inf
    sigmas = np.where(
        [name == "z" for name in NAMES], np.inf, random.uniform(1e-7, 1e-2, 6)
    )
    values = {
        "T_parent_child": se3.exp(random.normal(size=6)),
        "covariance_measured": covariance,
        "status": SolveStatus.UNOBSERVABLE,
        "observability_measured": dofs(sigmas, "z"),
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


SIGMAS = np.r_[np.full(3, 0.002), np.full(3, np.radians(0.02))]
SHIFTED_FROM = se3.exp(np.array([0.4, -0.3, 0.2, 1.1, -0.7, 0.5]))


def shifted(shift=(0,) * 6, hidden="", sigmas=SIGMAS, seed=None, **fields):
    """A result whose axes along and about the parent's are off by a shift, and by noise."""
    noise = np.zeros(6)
    if seed is not None:
        random = np.random.default_rng(seed)
        noise = random.normal(size=6) * sigmas
    off = np.asarray(shift, dtype=float) + noise
    T = SHIFTED_FROM.copy()
    T[:3, :3] = se3.rotation_exp(off[3:]) @ T[:3, :3]
    T[:3, 3] += off[:3]

    to_child = np.kron(np.eye(2), T[:3, :3].T)
    variances = np.diag(sigmas**2)
    covariance = to_child @ variances @ to_child.T
    fields.setdefault("status", SolveStatus.OK)
    fields.setdefault("observability_measured", dofs(sigmas, [hidden]))
    return calibration(
        T_parent_child=T, covariance_measured=covariance, **fields
    )


def shift(axis, size):
    vector = np.zeros(6)
    vector[NAMES.index(axis)] = size
    return vector


def good_calibration(**changes):
    """One with nothing against it."""
    sigmas = [0.003] * 3 + [0.001] * 3
    values = {
        "status": SolveStatus.OK,
        "observability_measured": dofs(sigmas),
        "covariance_measured": np.diag(np.square(sigmas)),
    }
    return calibration(**(values | changes))


def seen(motion_s, rotation_deg=(40.0, 30.0, 60.0)):
    """A motion that shows much."""
    rotation = np.radians(rotation_deg)
    cross_terms = np.zeros((3, 3))
    return Excitation(100, rotation, cross_terms, 10.0, motion_s)


def written_finding(code, severity, what, advice="convert them", **fields):
    """Return a finding with these sentences, as from a document without values."""
    values = {"what": what, "advice": advice, "cause": ""}
    return Finding(
        code=code, key=AS_WRITTEN, severity=severity, values=values, **fields
    )
