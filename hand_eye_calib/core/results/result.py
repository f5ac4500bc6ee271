"""Extrinsic and its quality as values."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.option import did_you_mean
from hand_eye_calib.core.base.registry import OUT_OF_REACH
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import (
    sigmas_in_parent,
    sigmas_rpy,
)
from hand_eye_calib.core.results import records
from hand_eye_calib.core.results.parts import all_parts

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

    from hand_eye_calib.core.results.context import Comparison

_FRAMES = (
    "parent_frame",
    "child_frame",
    "base_frame",
)


@dataclass(frozen=True, kw_only=True)
class Result:
    """An extrinsic with its quality, in six parts.

    Estimate

    T_parent_child : (4, 4) array
        Pose of the child sensor in the parent sensor's frame: maps child coordinates (m) into the
        parent frame.
    T_method : (4, 4) array or None
        Solution of the method before priors were added and unobservable directions were set. None
        if the result was read from a file without it.
    status : SolveStatus
    objective : float
        Value of the method's cost at ``T_method``; for dnlo eq. (5), with the cost of outliers.
    proved_global : str
        Whether no transform has a smaller cost over the inliers: "yes" (proved), "no", or "not
        tried" (:mod:`hand_eye_calib.core.solvers.certificate`).
    method, reference, backend : str
        Method, reference and backend of the solve, never ``auto``: if the user set ``auto``, they
        are the chosen method, reference and backend.
    method_reason, reference_reason : str
        Why ``auto`` chose the method and the reference; empty if the user set them.
    time_offset_s, time_offset_sigma_s : float
        Seconds added to the child's stamps, and one standard deviation. The standard deviation is
        0 if the offset was not estimated.
    clock_rate : ClockRate or None
        Change of the offset with time, if it was estimated.
    scale, scale_sigma : float
        Factor applied to the child's translations, and one standard deviation. The standard
        deviation is 0 if the scale was not estimated.

    Uncertainty

    covariance_measured : (6, 6) array
        Covariance of the error xi in ``T_parent_child @ exp(xi)``, xi = (rho, phi), in the child
        sensor's frame, m and rad: the part that is estimated from the recording.
    covariance_allowance : (6, 6) array
        Covariance of the same xi by errors that are constant during the recording, so that the
        recording cannot reveal them (:mod:`hand_eye_calib.core.assessment.covariance`).
        :attr:`covariance` is the sum of both.
    observability_measured : tuple of DofObservability
        x, y, z, roll, pitch, yaw in the parent sensor's frame. The standard deviations are without
        the allowance, unlike those of :attr:`observability`.
    contradictions : mapping
        Axes whose prior contradicts the motion, with the distances in joint standard deviations.

    Data

    measured : {"poses", "rotations", "positions"}
        Quantity that both streams measure together. Rotations (and angular rates) do not determine
        the translation. Positions do not determine the rotation. See :attr:`out_of_reach`.
    exact_streams : tuple of str
        Streams ("parent", "child") that the user declared exact, without constant errors.
    n_poses, n_pairs, n_inliers : int
        Numbers of synchronised pose pairs, of motion pairs, and of motion pairs that are inliers.
    stamp_ns : int
        Stamp of the newest pose used, parent clock.
    motion_residuals : Residuals or None
        Not part of files; see :meth:`residuals`.

    Noise

    noise : Noise or None
        Noise of the trajectories, from the adaptive estimator; None with other methods.

    Checks

    findings : tuple of Finding
        Findings of the stream checks.
    cross_check : CrossCheck or None
        Scatter of other estimates about the result, by axis: from motions over other numbers of
        poses, and from both halves of the recording. None without a cross-check.
    warnings : tuple of str
        Messages for the user of the result.
    recording : object
        Poses and options of the solve, for :meth:`Calibration.report`. They are not part of files.

    Context

    parent_frame, child_frame : str
    base_frame : str
        Frame of the robot in which the child's pose is also stated. May be empty.
    T_base_parent : (4, 4) array or None
        Pose of the parent sensor in ``base_frame``, from the robot's transforms.
    target_translation, target_rotation : float
        Standard deviations (m, rad) that are small enough for the intended use.
    target_axes : mapping
        Targets of single axes, m or rad.
    comparison : Comparison or None
        Comparison with the installed transform.
    parts : mapping
        Records of layers above the core, by name: ``goal``, ``together``, ``rate_bias``,
        ``worlds``. Their values are also attributes of the result
        (:mod:`hand_eye_calib.core.results.parts`).
    """

    T_parent_child: FloatArray
    T_method: FloatArray | None = None
    status: records.SolveStatus
    objective: float
    proved_global: str = "not tried"
    method: str
    reference: str
    backend: str
    method_reason: str = ""
    reference_reason: str = ""
    time_offset_s: float = 0.0
    time_offset_sigma_s: float = 0.0
    clock_rate: records.ClockRate | None = None
    scale: float = 1.0
    scale_sigma: float = 0.0

    covariance_measured: FloatArray
    covariance_allowance: FloatArray = field(
        default_factory=lambda: np.zeros((6, 6))
    )
    observability_measured: tuple[records.DofObservability, ...]
    contradictions: Mapping[str, float] = field(default_factory=dict)

    measured: str = "poses"
    exact_streams: tuple[str, ...] = ()
    n_poses: int
    n_pairs: int
    n_inliers: int
    stamp_ns: int = 0
    motion_residuals: records.Residuals | None = field(
        default=None, repr=False, compare=False
    )

    noise: records.Noise | None = None

    findings: tuple[records.Finding, ...] = ()
    cross_check: records.CrossCheck | None = None
    warnings: tuple[str, ...] = ()
    recording: object = field(default=None, repr=False, compare=False)

    parent_frame: str = "parent"
    child_frame: str = "child"
    base_frame: str = ""
    T_base_parent: FloatArray | None = None
    target_translation: float = CalibratorConfig.target_translation
    target_rotation: float = CalibratorConfig.target_rotation
    target_axes: Mapping[str, float] = field(default_factory=dict)
    comparison: "Comparison | None" = None
    parts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # tf2 refuses the leading slash of ROS 1.
        for name in _FRAMES:
            frame = getattr(self, name)
            # In a file that was changed by hand, values may have other types.
            if isinstance(frame, str):
                object.__setattr__(self, name, frame_name(frame))

    # Type checkers do not see this method, so that they still report misspelt attributes.
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Return an attribute that a part adds."""
            for extra in () if name.startswith("_") else all_parts():
                if name in extra.without:
                    value = self.parts.get(extra.name)
                    return (
                        extra.without[name]
                        if value is None
                        else extra.attribute(value, name)
                    )
            similar = (
                "" if name.startswith("_") else did_you_mean(name, dir(self))
            )
            raise AttributeError(
                f"{type(self).__name__!r} object has no attribute {name!r}{similar}"
            )

    def with_part(self, name: str, value: object) -> Self:
        """Return the result with a part of a layer above the core."""
        return replace(self, parts={**self.parts, name: value})

    @property
    def rotation(self) -> "Rotation":
        """Rotation of ``T_parent_child``, as a ``Rotation`` of SciPy."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_matrix(se3.rotation_of(self.T_parent_child))

    @property
    def translation(self) -> FloatArray:
        """(3,) array: position of the child sensor in the parent sensor's frame, m."""
        return se3.translation_of(self.T_parent_child)

    @property
    def quat_xyzw(self) -> FloatArray:
        """(4,) array: quaternion of the rotation, scalar last."""
        return se3.to_quat_xyzw(self.T_parent_child)

    @property
    def rpy_deg(self) -> FloatArray:
        """(3,) array: roll, pitch and yaw about fixed axes, as in URDF, degrees."""
        rotation = se3.rotation_of(self.T_parent_child)
        return np.degrees(se3.rotation_to_rpy(rotation))

    @property
    def T_child_parent(self) -> FloatArray:
        """(4, 4) array: pose of the parent sensor in the child sensor's frame."""
        return se3.inverse(self.T_parent_child)

    @property
    def T_base_child(self) -> FloatArray | None:
        """(4, 4) array: pose of the child sensor in ``base_frame``; None without one."""
        if self.T_base_parent is None:
            return None
        return self.T_base_parent @ self.T_parent_child

    @property
    def mounting(self) -> tuple[str, FloatArray]:
        """Frame on which the child sensor is mounted, and the child's pose (4, 4) in this frame.

        It is the base frame if there is one, otherwise the frame of the parent sensor.
        """
        if self.T_base_child is not None:
            return self.base_frame, self.T_base_child
        return self.parent_frame, self.T_parent_child

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) array: sum of the measured covariance and the allowance.

        It is the covariance of the error xi in ``T_parent_child @ exp(xi)``, xi = (rho, phi), in
        the child sensor's frame, m and rad.
        """
        return self.covariance_measured + self.covariance_allowance

    @property
    def sigmas(self) -> FloatArray:
        """(6,) array: standard deviations in the parent sensor's frame, with the allowance.

        They are along (m) and about (rad) the axes; infinite for unobservable axes.
        """
        return np.hypot(self.sigmas_measured, self.allowance)

    @property
    def sigmas_measured(self) -> FloatArray:
        """(6,) array: part of :attr:`sigmas` that is estimated from the recording."""
        return np.array([dof.sigma for dof in self.observability_measured])

    @property
    def allowance(self) -> FloatArray:
        """(6,) array: part of :attr:`sigmas` that covers constant errors.

        Constant errors of odometries cannot be estimated from a recording.
        """
        return sigmas_in_parent(
            se3.rotation_of(self.T_parent_child), self.covariance_allowance
        )

    @property
    def observability(self) -> tuple[records.DofObservability, ...]:
        """x, y, z, roll, pitch, yaw in the parent sensor's frame, with their :attr:`sigmas`."""
        return tuple(
            replace(dof, sigma=sigma)
            for dof, sigma in zip(
                self.observability_measured, self.sigmas.tolist(), strict=True
            )
        )

    @property
    def sigmas_rpy(self) -> FloatArray:
        """(3,) array: standard deviations (rad) of roll, pitch and yaw, with the allowance.

        The values are infinite for unknown angles. They differ from ``sigmas``, which has rotations
        about the parent's axes.
        """
        return sigmas_rpy(self.T_parent_child, self.covariance)

    @property
    def sigmas_printed(self) -> FloatArray:
        """(6,) array: standard deviations of x, y, z (m), roll, pitch and yaw (rad).

        They contain the allowance, and are infinite for unknown numbers.
        """
        return np.concatenate([self.sigmas[:3], self.sigmas_rpy])

    def residuals(self) -> records.Residuals:
        """Residuals of the motion pairs of the solve, at ``T_parent_child``.

        Raises
        ------
        InputError
            If the result was read from a file, because files have no residuals.
        """
        if self.motion_residuals is None:
            raise InputError(
                "a result that was read from a file has no residuals; calibrate again to have them"
            )
        return self.motion_residuals

    def unobservable(self) -> list[str]:
        """Names of the degrees of freedom that the motion does not determine."""
        return [
            dof.name
            for dof in self.observability_measured
            if dof.verdict is records.DofVerdict.UNOBSERVABLE
        ]

    @property
    def hidden(self) -> list[str]:
        """Names of the axes that these streams can determine, but this recording does not."""
        return [
            axis
            for axis in self.unobservable()
            if axis not in self.out_of_reach
        ]

    @property
    def out_of_reach(self) -> tuple[str, ...]:
        """Axes that streams of this kind can never determine, and that have no prior."""
        never_observed = OUT_OF_REACH.get(self.measured, ())
        unobservable = self.unobservable()
        return tuple(axis for axis in never_observed if axis in unobservable)
