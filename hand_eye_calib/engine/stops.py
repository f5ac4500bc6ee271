"""From stops of an arm to a calibration: ``A X = Z B`` solved, judged, and named by its frames."""

from collections.abc import Mapping

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.assessment.covariance import combined
from hand_eye_calib.assessment.prior import fuse
from hand_eye_calib.checks.findings import finding
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import calibration_of
from hand_eye_calib.geometry import se3
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.records import Finding, Residuals
from hand_eye_calib.solvers.robot_world import RobotWorld, Stops, solve

# Poses of one sensor are taken for inverse if so the errors are smaller by this factor.
_CLEARLY = 3.0


def calibrate_stops(
    Ts_world_parent: FloatArray,
    Ts_world_child: FloatArray,
    config: CalibratorConfig | None = None,
) -> Calibration:
    """Solve and assess stops, which are poses without an order.

    Parameters
    ----------
    Ts_world_parent, Ts_world_child : (N, 4, 4) arrays
        Poses of both sensors, each in its own world: of a hand in the base of a robot, and of the
        camera in the hand in the frame of a target.
    config : CalibratorConfig, optional
        Its priors, targets and names of frames count.

    Returns
    -------
    Calibration
        With ``T_world_world``: where the child's world is in the parent's.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than three stops.

    Examples
    --------
    >>> hand, camera = parent.at(child.stamps_ns[10:800:20]), child[10:800:20]
    >>> hec.calibrate_stops(hand, camera.poses).T_world_world.shape
    (4, 4)
    """
    config = config or CalibratorConfig()
    stops = Stops.of_one(Ts_world_parent, Ts_world_child)
    fit, other = solve(stops), solve(Stops.of_one(Ts_world_parent, se3.inverse(Ts_world_child)))
    is_smaller = max(other.level_m / fit.level_m, other.level_rad / fit.level_rad) < 1.0 / _CLEARLY
    findings = [finding("inverse", "child")] if is_smaller and other.converged else []
    frames = ["parent", "child", "parent_world", "child_world"]
    return _assessed(fit, stops, config, frames, *findings)


def calibrate_arm(
    robot: FloatArray,
    tracking: FloatArray,
    config: CalibratorConfig | None = None,
    names: Mapping[str, str] | None = None,
) -> Calibration:
    """Calibrate a camera on a robot's hand, or beside the robot with the target on the hand.

    Which of them it is, is seen from the samples: only one of them leaves small errors.

    Parameters
    ----------
    robot, tracking : (N, 4, 4) arrays
        Transforms between base and hand, and between camera and target. For a camera in the hand
        ``robot`` is the pose of the hand in the base (or the inverse for a camera beside it), and
        ``tracking`` the pose of the target in the camera, as MoveIt and easy_handeye2 have them.
    config : CalibratorConfig, optional
    names : mapping of str to str, optional
        Names of the frames base, hand, camera, target.

    Returns
    -------
    Calibration
        The camera in the hand, and the target in the base; or the camera in the base, and the
        target in the hand.

    Examples
    --------
    >>> samples = hec.read_arm_samples("samples.yaml")
    >>> hec.calibrate_arm(samples.robot, samples.tracking).n_poses
    40
    """
    named = {name: name for name in ("base", "hand", "camera", "target")} | dict(names or {})
    Ts_target_camera = se3.inverse(tracking)
    fits = [
        (solve(stops := Stops.of_one(poses, Ts_target_camera)), stops, parent, world)
        for poses, parent, world in ((robot, "hand", "base"), (se3.inverse(robot), "base", "hand"))
    ]
    fit, stops, parent, world = min(fits, key=lambda each: each[0].objective)
    frames = [named[each] for each in (parent, "camera", world, "target")]
    return _assessed(fit, stops, config or CalibratorConfig(), frames)


def _assessed(
    fit: RobotWorld, stops: Stops, config: CalibratorConfig, frames: list[str], *findings: Finding
) -> Calibration:
    X, Z = fit.Ts_parent_child[0], fit.Ts_world_world[0]
    parent, child, parent_world, child_world = frames
    fused = fuse(combined(X, fit.covariance[:6, :6], None, fit.undetermined()), config.prior())
    errors = se3.log(se3.inverse(Z @ stops.Ts_world_child) @ stops.Ts_world_parent @ X)
    rows = np.arange(len(errors))
    residuals = Residuals(
        translation=errors[:, :3] @ X[:3, :3].T,
        rotation=errors[:, 3:],
        weights=fit.weights,
        start_ns=rows,
        end_ns=rows,
    )
    return calibration_of(
        fit,
        fused,
        residuals,
        rows,
        config,
        T_method=X,
        reference="stops",
        stamp_ns=0,
        findings=findings,
        parent_frame=config.parent_frame or parent,
        child_frame=config.child_frame or child,
        T_world_world=Z,
        cov_world_world=fit.covariance[6:, 6:],
        parent_world_frame=parent_world,
        child_world_frame=child_world,
    )
