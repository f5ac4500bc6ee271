"""Recordings of a fleet, and workers that die: importable by processes of a pool."""

import os
import signal
import threading
from pathlib import Path

import numpy as np
from result_making import calibration, dofs

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import SolveStatus
from hand_eye_calib.extras.fleet.work import Outcome, Task

DAY_NS = 86_400_000_000_000


def dies_once(task):
    """Work whose process dies if the task names a file that does not exist yet."""
    marker = Path(task.options.get("marker", __file__))
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome.of(task, "done")


def always_dies(task):
    """Work whose process dies of the task called bad."""
    if task.name == "bad":
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome.of(task, "done")


def never_ends(task):
    """Work that writes the number of its process into a pipe and then waits."""
    path = task.options["pipe"]
    with open(path, "w") as pipe:
        print(os.getpid(), file=pipe)
    forever = threading.Event()
    forever.wait()


def recordings_of(seed, count, unknown_z=False):
    """Extrinsics (N, 4, 4) of one rig as a calibration finds them, and covariances (N, 6, 6)."""
    random = np.random.default_rng(seed)
    X = se3.exp(np.array([0.4, -0.2, 0.7, 0.3, -1.2, 0.6]))
    sizes = np.repeat([0.003, 0.001], 3)
    least_variances = np.diag(np.repeat([1e-6, 1e-8], 3))
    Ts = []
    covariances = []
    for _ in range(count):
        root = random.normal(size=(6, 6)) * sizes
        covariance = root @ root.T + least_variances
        error = random.multivariate_normal(np.zeros(6), covariance)
        T = X @ se3.exp(error)
        if unknown_z:
            # The upward axis of the parent, in the child.
            up = T[2, :3].copy()
            covariance[:3, :3] += 9.0 * np.outer(up, up)
            T[2, 3] = 0.0
        Ts.append(T)
        covariances.append(covariance)
    return np.array(Ts), np.array(covariances)


def outcome(name, vehicle, T, covariance, day=0):
    """What a batch keeps of a recording."""
    sigmas = np.sqrt(np.diag(covariance)).tolist()
    result = calibration(
        T_parent_child=T,
        covariance_measured=covariance,
        status=SolveStatus.OK,
        observability_measured=dofs(sigmas),
        warnings=(),
        child_frame="camera",
    )
    stamps = {
        "first_stamp_ns": day * DAY_NS + 1,
        "last_stamp_ns": day * DAY_NS + 10**10 + 1,
    }
    task = Task(name=name, bags=(f"bags/{name}",), vehicle=vehicle)
    return Outcome.of(task, None, result, {"parent": stamps, "child": stamps})
