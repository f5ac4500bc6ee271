"""The node's results: on topics, on ``/tf_static``, in files and in one line of the log."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from hand_eye_calib.assessment.excitation import Excitation, what_is_missing
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.geometry import se3
from hand_eye_calib.io.results import keep_earlier_results, save_result
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.ros.conversions import to_pose_with_covariance, to_transform
from hand_eye_calib.ros.live_session import output_path

_LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


class ResultTopics:
    """Publishes results on ``~/extrinsic`` and ``~/extrinsic_with_covariance``, latched; those of
    further child sensors on ``~/extrinsic_child2`` and so on.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._others: dict[str, Publisher] = {}
        self._open()

    def publish(self, calibration: Calibration) -> None:
        """Publish a result."""
        self._extrinsic.publish(to_transform(calibration))
        self._with_covariance.publish(to_pose_with_covariance(calibration))

    def publish_other(self, name: str, calibration: Calibration) -> None:
        """Publish a result of a further child sensor, by the name of its input."""
        if name not in self._others:
            topic = f"~/extrinsic_{name}"
            self._others[name] = self._node.create_publisher(TransformStamped, topic, _LATCHED)
        self._others[name].publish(to_transform(calibration))

    def clear(self) -> None:
        """Withdraw the results: who subscribes from now on gets none."""
        for publisher in self._others.values():
            self._node.destroy_publisher(publisher)
        self._others.clear()
        self._node.destroy_publisher(self._extrinsic)
        self._node.destroy_publisher(self._with_covariance)
        self._open()

    def _open(self) -> None:
        self._extrinsic = self._node.create_publisher(TransformStamped, "~/extrinsic", _LATCHED)
        self._with_covariance = self._node.create_publisher(
            PoseWithCovarianceStamped, "~/extrinsic_with_covariance", _LATCHED
        )


class ResultFiles:
    """Saves results; those of an earlier session in the same directory are kept once."""

    def __init__(self) -> None:
        self._earlier_kept_in = ""

    def save(
        self,
        calibration: Calibration | None,
        directory: str,
        inputs: Mapping[str, Any],
    ) -> tuple[bool, str]:
        """Write the result files.

        Parameters
        ----------
        calibration : Calibration or None
        directory : str
            The parameter output_directory.
        inputs : mapping
            Where the poses came from, in plain values.

        Returns
        -------
        success : bool
        text : str
            One line about it.
        """
        if not directory:
            return False, "nowhere to save to: set the parameter output_directory to a directory"
        if calibration is None:
            return False, "nothing to save: there is no result yet"
        try:
            path = output_path(directory)
            if self._earlier_kept_in != directory:
                keep_earlier_results(path)
            self._earlier_kept_in = directory
            save_result(calibration, path, inputs)
        except (OSError, HandEyeCalibError) as error:
            return False, f"cannot save to {directory}: {error}"
        return True, f"result saved to {directory}: {calibration.headline}"


def describe(calibration: Calibration, seen: Excitation | None = None) -> str:
    """One line for a log: whose pose in whose frame, how good, from how much."""
    xyz = ", ".join(f"{value:.4f}" for value in calibration.T_parent_child[:3, 3])
    angles = np.degrees(se3.rotation_to_rpy(calibration.T_parent_child[:3, :3]))
    rpy = ", ".join(f"{value:.3f}" for value in angles)
    sigmas_mm = ", ".join(_sigma(1000 * value, 1) for value in calibration.sigmas[:3])
    sigmas_deg = ", ".join(_sigma(value, 3) for value in np.degrees(calibration.sigmas_rpy))
    backend = " ipopt" * (calibration.backend == "ipopt")
    return (
        f"{calibration.headline}. {calibration.child_frame} in {calibration.parent_frame}: "
        f"xyz = ({xyz}) m +/- ({sigmas_mm}) mm, rpy = ({rpy}) deg +/- ({sigmas_deg}) deg; "
        f"status {status_in_words(calibration, seen)}; "
        f"{calibration.method} {calibration.reference}{backend}: "
        f"{calibration.n_poses} poses, {calibration.n_pairs} pairs, "
        f"{calibration.n_inliers} inliers"
    )


def status_in_words(calibration: Calibration, seen: Excitation | None) -> str:
    """The status, and which axes are not determined yet: what ``/diagnostics`` says too."""
    missing = what_is_missing(seen, calibration) if seen is not None and seen.n_poses else ""
    return "; ".join(filter(None, (calibration.status.value, missing)))


def _sigma(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "unknown"
