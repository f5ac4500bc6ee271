"""Rows measured within this process: from synchronised poses to the answer, and the engine."""

import sys
import time
from dataclasses import replace

import numpy as np

from hand_eye_calib.assessment.covariance import assess
from hand_eye_calib.assessment.metrics import absolute_errors
from hand_eye_calib.assessment.reference_selection import select_reference
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.geometry import se3
from hand_eye_calib.gls import estimator
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers import quadratic_form
from hand_eye_calib.solvers.registry import Method
from suite import opencv
from suite.baseline import FLOOR
from suite.data import LONG, REFERENCE, SHORT
from suite.measuring import measure, measure_in_turn, row_of

# Up to these sizes a row is part of every run, and of a full one.
_USUAL = {"other methods": 10_000, "adaptive": 10_000}
_FULL = {"other methods": 100_000, "adaptive": 100_000}
_JACKKNIFE = 100_000


def solver_rows(drive, is_full):
    """Rows of everything between synchronised poses and the answer, for one drive."""
    poses, pairs = drive.poses, drive.pairs
    size, most = len(pairs), _FULL if is_full else _USUAL

    def row(name, work, answer=None):
        measured, result = measure(name, size, work)
        return (
            measured
            if answer is None
            else judged(measured, answer(result), getattr(result, "objective", None))
        )

    def judged(measured, T_parent_child, objective):
        metres, radians = absolute_errors(T_parent_child, drive.T_parent_child)
        return replace(measured, objective=objective, error_m=metres, error_rad=radians)

    def solved(method, backend="fast"):
        return lambda: Method(method, backend=backend).solve(pairs)

    def extrinsic(result):
        return result.T_parent_child

    yield row(FLOOR, lambda: pairs.Ts_parenti_parentj.sum() + pairs.Ts_childi_childj.sum())
    yield row("pairs", lambda: motion_pairs(poses.Ts_pw_p, poses.Ts_cw_c, REFERENCE))
    yield row("condense", lambda: quadratic_form.condense(pairs))
    for method in ("dnl", "dnlo"):
        fast = (f"{method} fast", solved(method))
        if size in (SHORT, LONG):
            slow = (f"{method} ipopt", solved(method, "ipopt"))
            for measured, solution in measure_in_turn(size, slow, fast):
                yield judged(measured, solution.T_parent_child, solution.objective)
        else:
            yield row(*fast, extrinsic)
    if size <= most["other methods"]:
        for method in ("park", "taylor", "zhuang", "ali"):
            yield row(method, solved(method), extrinsic)
    if size <= _JACKKNIFE:
        method, solution = Method("dnlo"), solved("dnlo")()
        yield row(
            "jackknife and covariance",
            lambda: assess(
                pairs, solution, lambda left_out: method.solve_without(pairs, solution, left_out)
            ),
        )
    if size <= most["adaptive"]:
        yield row(
            "adaptive",
            lambda: estimator.solve(poses.stamps_ns, poses.Ts_pw_p, poses.Ts_cw_c),
            extrinsic,
        )
        yield row("reference auto", lambda: select_reference(poses, Method("dnlo")))


def opencv_rows(drives, all_methods):
    """OpenCV on the short drive, and on the long one with what was fastest there, or with all."""
    cv2 = opencv.load()
    if cv2 is None:
        print(
            "opencv: not installed, its rows are left out; pip install 'opencv-python-headless<5'",
            file=sys.stderr,
        )
        return
    methods, fastest = opencv.METHODS, []
    for size in (SHORT, LONG):
        drive = drives[size]
        found = []
        for method in methods:
            row, T_parent_child = measure(
                f"opencv {method.lower()}",
                size,
                lambda drive=drive, method=method: opencv.calibrate(
                    cv2, method, drive.poses.Ts_pw_p, drive.poses.Ts_cw_c
                ),
            )
            metres, radians = absolute_errors(T_parent_child, drive.T_parent_child)
            found.append(replace(row, error_m=metres, error_rad=radians))
        yield from found
        quickest = min(found, key=lambda row: row.seconds)
        fastest.append(replace(quickest, name="opencv, the fastest"))
        if not all_methods:
            methods = [method for method in methods if quickest.name == f"opencv {method.lower()}"]
    yield from fastest


def engine_rows(n_messages):
    """Time per message of the engine: at the median, and at the 99th percentile."""
    messages = zip(*(column.tolist() for column in _messages(n_messages)), strict=True)
    times = np.array(list(_stopwatch(Calibrator().add_pose, messages)))
    halves = np.array_split(times, 5)
    yield row_of("add_pose, median", n_messages, [np.median(half) for half in halves])
    yield row_of(
        "add_pose, 99th percentile", n_messages, [np.percentile(half, 99) for half in halves]
    )


def _stopwatch(take, messages):
    for message in messages:
        start = time.perf_counter_ns()
        take(*message)
        yield (time.perf_counter_ns() - start) * 1e-9


def _messages(count):
    """Streams, stamps, positions and quaternions of two sensors at 100 Hz, in turn."""
    s = np.arange(count // 2) / 100.0
    turns = np.stack(
        [0.3 * np.sin(0.7 * s), 0.2 * np.sin(0.9 * s + 1.0), 1.2 * np.sin(0.1 * s)], axis=1
    )
    Ts = se3.from_rotation_translation(
        se3.rotation_exp(turns), np.stack([20 * np.sin(0.05 * s), s, np.cos(0.8 * s)], axis=1)
    )
    stamps_ns = np.add.outer((s * 1e9).astype(np.int64), [0, 3_000_000]).ravel()
    names = np.tile(["parent", "child"], len(s))
    return (
        names,
        stamps_ns,
        np.repeat(Ts[:, :3, 3], 2, axis=0),
        np.repeat(se3.to_quat_xyzw(Ts), 2, axis=0),
    )
