"""An extrinsic with all that is known of its quality, as values."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.registry import OUT_OF_REACH
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import sigmas_in_parent, sigmas_rpy
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
        Pose of the child sensor in the parent sensor's frame: maps child coordinates into the
        parent frame, metres.
    T_method : (4, 4) array or None
        The method's own answer, before directions that the motion does not reveal are set and
        priors are added. None in a result read from a file that does not have it.
    status : SolveStatus
    objective : float
        Value of the method's cost at ``T_method``; for dnlo eq. (5), the outliers' share included.
    proved_global : str
        Whether no other transform has a smaller cost over the motion pairs that count: "yes", "no",
        or "not tried" (:mod:`hand_eye_calib.core.solvers.certificate`).
    method, reference, backend : str
        How it was solved; ``method`` and ``reference`` are those that ``auto`` chose.
    method_reason, reference_reason : str
        Why ``auto`` chose them; empty if they were set by the user.
    time_offset_s, time_offset_sigma_s : float
        Seconds added to the child's stamps, and one standard deviation: 0 if the method took the
        offset as set by the user.
    clock_rate : ClockRate or None
        By how much the offset changes with time, if it was estimated.
    scale, scale_sigma : float
        Factor applied to the child's translations, in the same way.

    Uncertainty

    covariance_measured : (6, 6) array
        Covariance of the error xi in ``T_parent_child @ exp(xi)``, xi = (rho, phi), in the child
        sensor's frame, m and rad: the part that the recording shows.
    covariance_allowance : (6, 6) array
        Covariance of the same xi from errors that are constant during the recording, which no
        recording shows (:mod:`hand_eye_calib.core.assessment.covariance`). :attr:`covariance` is
        the sum of both.
    observability_measured : tuple of DofObservability
        x, y, z, roll, pitch, yaw in the parent sensor's frame, with the measured part of their
        standard deviations; :attr:`observability` has the whole.
    contradictions : mapping
        Axis to the distance, in joint standard deviations, of a prior that contradicts the motion.

    Data

    measured : {"poses", "rotations", "positions"}
        What the streams give together. Rotations, or angular rates, say nothing of the translation,
        positions nothing of the rotation: :attr:`out_of_reach`.
    n_poses, n_pairs, n_inliers : int
        Synchronised pose pairs, motion pairs, and motion pairs that count as inliers.
    stamp_ns : int
        Stamp of the newest pose used, parent clock.
    motion_residuals : Residuals or None
        Not part of files; see :meth:`residuals`.

    Noise

    noise : Noise or None
        Of the trajectories, by the adaptive estimator; None with other methods.

    Checks

    findings : tuple of Finding
        What the stream checks found.
    cross_check : CrossCheck or None
        Per axis, the scatter about this one of answers of robust least squares, over other numbers
        of poses and from both halves of the recording; None without a cross-check.
    warnings : tuple of str
        What a person should know before using the result.
    recording : object
        The poses and options that gave it, for :meth:`Calibration.report`. Not part of files.

    Context

    parent_frame, child_frame : str
    base_frame : str
        Frame of the robot in which the child's pose is stated as well; empty for none.
    T_base_parent : (4, 4) array or None
        Pose of the parent sensor in that frame, as the robot's transforms have it.
    target_translation, target_rotation : float
        Standard deviations (m, rad) that are good enough for the use that is made of the result.
    target_axes : mapping
        Axis to a target of its own, m or rad.
    comparison : Comparison or None
        With what is installed.
    parts : mapping
        What layers above the core add, by name: ``goal``, ``together``, ``rate_bias``, ``worlds``.
        A result has their values as attributes, too (:mod:`hand_eye_calib.core.results.parts`).
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
    covariance_allowance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    observability_measured: tuple[records.DofObservability, ...]
    contradictions: Mapping[str, float] = field(default_factory=dict)

    measured: str = "poses"
    n_poses: int
    n_pairs: int
    n_inliers: int
    stamp_ns: int = 0
    motion_residuals: records.Residuals | None = field(default=None, repr=False, compare=False)

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
        for name in _FRAMES:  # tf2 refuses the leading slash of ROS 1
            frame = getattr(self, name)
            if isinstance(frame, str):  # a file that was changed may have anything
                object.__setattr__(self, name, frame_name(frame))

    if not TYPE_CHECKING:  # a misspelt attribute stays an error of types

        def __getattr__(self, name: str) -> Any:
            """Return an attribute of a part."""
            for part in () if name.startswith("_") else all_parts():
                if name in part.without:
                    value = self.parts.get(part.name)
                    return part.without[name] if value is None else part.attribute(value, name)
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def with_part(self, name: str, value: object) -> Self:
        """Return the result with a part that a layer above the core adds."""
        return replace(self, parts={**self.parts, name: value})

    @property
    def rotation(self) -> "Rotation":
        """Rotation of ``T_parent_child``, as SciPy has it."""
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
        return np.degrees(se3.rotation_to_rpy(se3.rotation_of(self.T_parent_child)))

    @property
    def T_child_parent(self) -> FloatArray:
        """(4, 4) array: pose of the parent sensor in the child sensor's frame."""
        return se3.inverse(self.T_parent_child)

    @property
    def T_base_child(self) -> FloatArray | None:
        """(4, 4) array: pose of the child sensor in ``base_frame``; None without one."""
        return None if self.T_base_parent is None else self.T_base_parent @ self.T_parent_child

    @property
    def mounting(self) -> tuple[str, FloatArray]:
        """The frame that the child sensor is mounted on in the robot's description, and its pose
        (4, 4) in it: the base frame if there is one, otherwise the parent sensor's.
        """
        if self.T_base_child is not None:
            return self.base_frame, self.T_base_child
        return self.parent_frame, self.T_parent_child

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) array: covariance of the error xi in ``T_parent_child @ exp(xi)``, xi = (rho,
        phi), in the child sensor's frame, m and rad: the measured part and the allowance.
        """
        return self.covariance_measured + self.covariance_allowance

    @property
    def sigmas(self) -> FloatArray:
        """(6,) array: standard deviations along (m) and about (rad) the axes of the parent sensor's
        frame, with the allowance; infinite if unobservable.
        """
        return np.hypot(self.sigmas_measured, self.allowance)

    @property
    def sigmas_measured(self) -> FloatArray:
        """(6,) array: the part of :attr:`sigmas` that the recording shows."""
        return np.array([dof.sigma for dof in self.observability_measured])

    @property
    def allowance(self) -> FloatArray:
        """(6,) array: the part of :attr:`sigmas` that allows for constant errors of the odometries,
        which no recording shows.
        """
        return sigmas_in_parent(se3.rotation_of(self.T_parent_child), self.covariance_allowance)

    @property
    def observability(self) -> tuple[records.DofObservability, ...]:
        """x, y, z, roll, pitch, yaw in the parent sensor's frame, with their :attr:`sigmas`."""
        return tuple(
            replace(dof, sigma=sigma)
            for dof, sigma in zip(self.observability_measured, self.sigmas.tolist(), strict=True)
        )

    @property
    def sigmas_rpy(self) -> FloatArray:
        """(3,) array: standard deviations, rad, of the roll, pitch and yaw that are printed, with
        the allowance; infinite if one is unknown. Those of ``sigmas`` are of rotations about the
        parent's axes.
        """
        return sigmas_rpy(self.T_parent_child, self.covariance)

    @property
    def sigmas_printed(self) -> FloatArray:
        """(6,) array: standard deviations of the printed x, y, z (m), roll, pitch and yaw (rad),
        with the allowance; infinite if one is unknown.
        """
        return np.concatenate([self.sigmas[:3], self.sigmas_rpy])

    def residuals(self) -> records.Residuals:
        """Residuals of the motion pairs that the result comes from, at ``T_parent_child``.

        Raises
        ------
        InputError
            If the result was read from a file: files do not have them.
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
        """Names of the axes that the recording does not determine, though its streams could."""
        return [axis for axis in self.unobservable() if axis not in self.out_of_reach]

    @property
    def out_of_reach(self) -> tuple[str, ...]:
        """Axes that streams of this kind say nothing about, and no prior either."""
        silent = OUT_OF_REACH.get(self.measured, ())
        unknown = self.unobservable()
        return tuple(axis for axis in silent if axis in unknown)
