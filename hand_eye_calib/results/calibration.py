"""The result of a calibration: the extrinsic, its covariance, and what to know before using it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from hand_eye_calib.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.printed_angles import (
    inverse_covariance,
    is_near_gimbal_lock,
    printed_rotation,
    sigmas_rpy,
    sigmas_translation,
)
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.plain import plain
from hand_eye_calib.results.document import (
    PLAIN,
    PLAIN_LATER,
    base_parent,
    check_values,
    covariance_of,
    floor_of,
    numbers,
    transform_of,
)
from hand_eye_calib.results.status import (
    ROTATIONS,
    TRANSLATIONS,
    DofObservability,
    DofVerdict,
    SolveStatus,
    by_hand,
)
from hand_eye_calib.results.tables import data_frame, html_table
from hand_eye_calib.results.verdict import Reason, Verdict, headline, reasons, verdict_of

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "Calibration",
    "DofObservability",
    "DofVerdict",
    "Reason",
    "Residuals",
    "SolveStatus",
    "Verdict",
]

# Format and version of to_dict. A change that an older reader cannot understand raises the version.
_FORMAT = "hand_eye_calib/extrinsic"
_VERSION = 1

# Motion pairs with more weight than this count as inliers.
INLIER_WEIGHT = 0.5

# An axis with more than this share (a cosine) of an unobservable direction is unknown, too.
_SHARED = 0.02

# With a direction unobservable, a larger standard deviation (m) of the inverse comes from that.
_UNKNOWN_M = 0.9


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """Residuals of K motion pairs at the result.

    A pair of the adaptive estimator runs from one pose to the next.

    Attributes
    ----------
    translation : (K, 3) array
        Residuals of eq. (6) of Välimäki et al. 2023, m, in the axes of the parent sensor at the
        start of each pair.
    rotation : (K, 3) array
        Rotation vectors of the residual rotations, whose angles are those of eq. (7), rad, in the
        axes of the child sensor at the end of each pair.
    weights : (K,) array
        Weights of the pairs in the solution, 0 to 1.
    start_ns, end_ns : (K,) int64 arrays
        Stamps of both ends of each pair, parent clock.
    """

    translation: FloatArray
    rotation: FloatArray
    weights: FloatArray
    start_ns: IntArray
    end_ns: IntArray

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def translation_m(self) -> FloatArray:
        """Lengths (K,) of the translation residuals, m."""
        return np.linalg.norm(self.translation, axis=1)

    @property
    def rotation_rad(self) -> FloatArray:
        """Angles (K,) of the rotation residuals, rad."""
        return np.linalg.norm(self.rotation, axis=1)

    @property
    def is_inlier(self) -> BoolArray:
        """Whether (K,) each pair counts as an inlier."""
        return self.weights > INLIER_WEIGHT


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """An extrinsic with its quality.

    :attr:`verdict` says whether it may be used, and :attr:`reasons` why not.

    Attributes
    ----------
    T_parent_child : (4, 4) array
        Pose of the child sensor in the parent sensor's frame: maps child coordinates into the
        parent frame, metres.
    covariance : (6, 6) array
        Covariance of the error xi in ``T_parent_child @ exp(xi)``, xi = (rho, phi), in the child
        sensor's frame, m and rad.
    status : SolveStatus
    observability : tuple of DofObservability
        x, y, z, roll, pitch, yaw in the parent sensor's frame.
    measured : {"poses", "rotations", "positions"}
        What the streams give together. Rotations, or angular rates, say nothing of the translation,
        positions nothing of the rotation: :attr:`out_of_reach`.
    T_method : (4, 4) array or None
        The method's own answer, before directions that the motion does not reveal are set and
        priors are added. None in a result read from a file that does not have it.
    objective : float
        Value of the method's cost at ``T_method``; for dnlo eq. (5), the outliers' share included.
    proved_global : str
        Whether no other transform has a smaller cost over the motion pairs that count: "yes", "no",
        or "not tried" (:mod:`hand_eye_calib.solvers.certificate`).
    method, reference, backend : str
        How it was solved; ``method`` and ``reference`` are those that ``auto`` chose.
    floor : (6, 6) array or None
        Covariance, of the same xi, of errors that are the same in every part of the recording, so
        that nothing in it shows them (:mod:`hand_eye_calib.assessment.floor`). ``covariance`` does
        not contain it. None in a result read from a file that does not have it.
    n_poses, n_pairs, n_inliers : int
        Synchronised pose pairs, motion pairs, and motion pairs that count as inliers.
    time_offset_s, time_offset_sigma_s : float
        Seconds added to the child's stamps, and one standard deviation: 0 if the method took the
        offset as given.
    scale, scale_sigma : float
        Factor applied to the child's translations, and one standard deviation: 0 if the method took
        the scale as given.
    rate_bias : dict or None
        Bias of the angular rates: ``of`` which sensor, ``rad_per_s`` and ``sigma`` along its axes;
        None if neither stream is one of rates.
    method_reason, reference_reason : str
        Why ``auto`` chose the method, the reference; empty if it was given.
    noise : dict or None
        Noise of the trajectories as the adaptive estimator found it; None with other methods.
    cross_check : dict or None
        Per axis, the scatter of the answers of other methods and references and of both halves of
        the recording about this one (:class:`~hand_eye_calib.engine.scatter.CrossCheck`); None
        without that cross-check.
    findings : tuple of dict
        What the stream checks found, in plain values
        (:meth:`~hand_eye_calib.checks.findings.Finding.to_dict`).
    contradictions : dict
        Axis to the distance, in joint standard deviations, of a prior that contradicts the motion.
    target_translation, target_rotation : float
        Standard deviations (m, rad) that are good enough for the use that is made of the result.
    target_axes : dict
        Axis to a target of its own, m or rad.
    comparison : dict or None
        Comparison with what is installed, in plain values
        (:meth:`~hand_eye_calib.session.compare.Comparison.to_dict`); None without one.
    goal : dict or None
        How far the session was from its goal when the result was saved, in plain values
        (:meth:`~hand_eye_calib.session.goal.Progress.to_dict`); None without a session.
    base_frame : str
        Frame of the robot in which the child's pose is stated as well; empty for none.
    T_base_parent : (4, 4) array or None
        Pose of the parent sensor in that frame, as the robot's transforms have it.
    stamp_ns : int
        Stamp of the newest pose used, parent clock.
    parent_frame, child_frame : str
    warnings : tuple of str
        What a person should know before using the result.
    motion_residuals : Residuals or None
        Not part of files; see :meth:`residuals`.
    other_answer : ((4, 4) array, (6, 6) array) or None
        T_parent_child and covariance under other assumptions on the noise: of the adaptive
        estimator beside DNLO, or the reverse. Not part of files.
    """

    T_parent_child: FloatArray
    covariance: FloatArray
    status: SolveStatus
    observability: tuple[DofObservability, ...]
    measured: str = "poses"
    T_method: FloatArray | None = None
    floor: FloatArray | None = None
    objective: float
    method: str
    reference: str
    backend: str
    n_poses: int
    n_pairs: int
    n_inliers: int
    time_offset_s: float = 0.0
    time_offset_sigma_s: float = 0.0
    scale: float = 1.0
    scale_sigma: float = 0.0
    rate_bias: dict[str, Any] | None = None
    proved_global: str = "not tried"
    method_reason: str = ""
    reference_reason: str = ""
    noise: dict[str, Any] | None = None
    cross_check: dict[str, Any] | None = None
    findings: tuple[Mapping[str, Any], ...] = ()
    contradictions: dict[str, float] = field(default_factory=dict)
    target_translation: float = CalibratorConfig.target_translation
    target_rotation: float = CalibratorConfig.target_rotation
    target_axes: dict[str, float] = field(default_factory=dict)
    comparison: dict[str, Any] | None = None
    goal: dict[str, Any] | None = None
    base_frame: str = ""
    T_base_parent: FloatArray | None = None
    stamp_ns: int = 0
    parent_frame: str = "parent"
    child_frame: str = "child"
    warnings: tuple[str, ...] = ()
    motion_residuals: Residuals | None = field(default=None, repr=False, compare=False)
    other_answer: tuple[FloatArray, FloatArray] | None = field(
        default=None, repr=False, compare=False
    )

    def __repr__(self) -> str:
        frames = f"{self.child_frame} in {self.parent_frame}"
        values = ", ".join(
            f"{dof.name} {value:.6g} +/- {dof.sigma:.2g}"
            for dof, value in zip(self.observability, self._printed(), strict=True)
        )
        return (
            f"<Calibration: {self.headline}\n {frames}: {values} (m, rad), "
            f"{self.method} {self.reference}, {self.n_poses} poses>"
        )

    def _repr_html_(self) -> str:
        """What a notebook shows: verdict, a row per axis, frames."""
        rows = [
            {
                "": name,
                "value": f"{row['value'] * factor:.4f}",
                "sigma": f"{row['sigma'] * factor:.2g}",
                "unit": unit,
                "verdict": row["verdict"],
            }
            for name, row in self.rows().items()
            for factor, unit in [(1.0, "m") if row["unit"] == "m" else (180 / np.pi, "deg")]
        ]
        frames = f"pose of {self.child_frame} in {self.parent_frame}"
        return html_table(f"{self.headline} ({frames})", rows)

    def to_frame(self) -> "pd.DataFrame":
        """DataFrame with a row for each of x, y, z, roll, pitch, yaw: value, sigma (m, rad) and
        verdict.

        Raises
        ------
        MissingDependencyError
            Without pandas.
        """
        return data_frame([{"axis": name, **row} for name, row in self.rows().items()], "axis")

    def rows(self) -> dict[str, dict[str, Any]]:
        """By axis the printed number, ``value`` and ``sigma`` in ``unit`` (m, rad), and the
        ``verdict``.
        """
        sigmas = [*self.sigmas[:3].tolist(), *self.sigmas_rpy.tolist()]
        return {
            dof.name: {
                "value": value,
                "sigma": sigma,
                "unit": unit,
                "verdict": dof.verdict.value,
            }
            for dof, value, sigma, unit in zip(
                self.observability, self._printed(), sigmas, 3 * ["m"] + 3 * ["rad"], strict=True
            )
        }

    def child_as_parent(self, child: Trajectory) -> Trajectory:
        """The trajectory that the parent sensor has according to the child's: with the time offset
        and the scale of this result, each pose moved by ``T_child_parent``.

        It and the parent's own trajectory are of one body, so that tools that compare trajectories
        (evo: ``evo_ape tum parent.tum moved.tum --align``) see their errors rather than the mount.

        Parameters
        ----------
        child : Trajectory
            Poses of the child sensor in its own world.

        Returns
        -------
        Trajectory
            Poses of the parent sensor in the child's world, at the child's stamps on the parent's
            clock.
        """
        scaled = child.scaled(self.scale).shifted(self.time_offset_s)
        poses = scaled.poses @ self.T_child_parent
        return Trajectory(scaled.stamps_ns, poses, self.parent_frame, child.world_frame)

    def _printed(self) -> list[float]:
        angles = se3.rotation_to_rpy(self.T_parent_child[:3, :3])
        return [*self.T_parent_child[:3, 3].tolist(), *angles.tolist()]

    @property
    def verdict(self) -> Verdict:
        """Whether the result may be used: ``Verdict.USE``, ``USE_WITH_CARE`` or ``DO_NOT_USE``."""
        return verdict_of(self.reasons)

    @cached_property
    def reasons(self) -> tuple[Reason, ...]:
        """Why the result may not be used as it is, the gravest first; empty if it may. The rules
        are :data:`hand_eye_calib.results.verdict.RULES`.
        """
        return reasons(self)

    @property
    def headline(self) -> str:
        """The verdict with its gravest reason, or with what is known, in one line."""
        return headline(self, self.reasons)

    @property
    def out_of_reach(self) -> tuple[str, ...]:
        """Axes that streams of this kind say nothing about, and no prior either."""
        silent = {"rotations": TRANSLATIONS, "positions": ROTATIONS}.get(self.measured, ())
        unknown = self.unobservable()
        return tuple(axis for axis in silent if axis in unknown)

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
    def sigmas(self) -> FloatArray:
        """(6,) array: standard deviations along (m) and about (rad) the axes of the parent sensor's
        frame; infinite if unobservable.
        """
        return np.array([dof.sigma for dof in self.observability])

    @property
    def sigmas_rpy(self) -> FloatArray:
        """(3,) array: standard deviations, rad, of the roll, pitch and yaw that are printed;
        infinite if one is unknown. Those of ``sigmas`` are of rotations about the parent's axes.
        """
        return sigmas_rpy(self.T_parent_child, self.covariance)

    @property
    def covariance_with_floor(self) -> FloatArray:
        """(6, 6) array: covariance and common-mode floor together."""
        return self.covariance + (np.zeros((6, 6)) if self.floor is None else self.floor)

    @property
    def sigmas_of_floor(self) -> FloatArray:
        """(6,) array: standard deviations of the common-mode floor along (m) and about (rad) the
        axes of the parent sensor's frame.
        """
        if self.floor is None:
            return np.zeros(6)
        to_parent = np.kron(np.eye(2), self.T_parent_child[:3, :3])
        variances = np.diag(to_parent @ self.floor @ to_parent.T)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    @property
    def sigmas_with_floor(self) -> FloatArray:
        """(6,) array: :attr:`sigmas` and common-mode floor together."""
        return np.hypot(self.sigmas, self.sigmas_of_floor)

    @property
    def weights(self) -> FloatArray:
        """(K,) array: weight of each motion pair in the solution, 0 to 1; see :meth:`residuals`."""
        return self.residuals().weights

    def residuals(self) -> Residuals:
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
        """Names of the degrees of freedom that the motion does not reveal."""
        return [dof.name for dof in self.observability if dof.verdict is DofVerdict.UNOBSERVABLE]

    def usable_numbers(self) -> dict[str, float | str]:
        """The numbers of :attr:`mounting` for commands and files that others read.

        Returns
        -------
        dict
            x, y, z in m and qx, qy, qz, qw; if an angle is unknown, roll, pitch and yaw in rad
            instead of the quaternion. An axis that cannot be determined is a text that no
            parser takes, such as MEASURE_Z_BY_HAND. Empty under DO NOT USE.
        """
        if self.verdict is Verdict.DO_NOT_USE:
            return {}
        T = self.mounting[1]
        numbers: dict[str, float | str] = {
            axis: by_hand(axis) if is_unknown else float(value)
            for axis, value, is_unknown in zip(
                TRANSLATIONS, T[:3, 3], self._unknown_translations(), strict=True
            )
        }
        if set(self.unobservable()).intersection(ROTATIONS):
            return numbers | self.usable_angles()
        return numbers | dict(zip(("qx", "qy", "qz", "qw"), se3.to_quat_xyzw(T), strict=True))

    def usable_angles(self) -> dict[str, float | str]:
        """Roll, pitch and yaw of :attr:`mounting`, rad, about fixed axes, as in URDF; a text for an
        angle that cannot be determined.
        """
        T = self.mounting[1]
        known = np.full(3, True)  # near gimbal lock roll and yaw have no sigma and are known
        if set(self.unobservable()).intersection(ROTATIONS):
            known = np.isfinite(sigmas_rpy(T, self.covariance))
        angles = se3.rotation_to_rpy(T[:3, :3]).tolist()
        return {
            name: angle if is_known else by_hand(name)
            for name, angle, is_known in zip(ROTATIONS, angles, known, strict=True)
        }

    def _unknown_translations(self) -> BoolArray:
        """Which axes (3,) of the mounting's frame share a direction that the motion hides."""
        hidden = np.array(
            [dof.verdict is DofVerdict.UNOBSERVABLE for dof in self.observability[:3]]
        )
        if self.T_base_parent is None:
            return hidden
        return np.abs(self.T_base_parent[:3, :3][:, hidden]).max(axis=1, initial=0.0) > _SHARED

    def to_dict(self) -> dict[str, Any]:
        """Everything but the residuals as plain numbers, strings, lists and mappings, ready for
        JSON or YAML. None for what is infinite, and for each printed number of an axis that is
        not known; only a ``matrix`` has a number there, so that it can be read back.
        """
        document: dict[str, Any] = {
            "verdict": self.verdict.value,
            "headline": self.headline,
            "reasons": [reason.to_dict() for reason in self.reasons],
            "format": _FORMAT,
            "version": _VERSION,
            "parent_frame": self.parent_frame,
            "child_frame": self.child_frame,
            "T_parent_child": self._transform_dict(),
            "T_child_parent": self._inverse_dict(),
            "status": self.status.value,
            "covariance": {
                "of": "error xi in T_parent_child @ exp(xi)",
                "order": ["rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z"],
                "frame": self.child_frame,
                "units": "m, rad",
                "matrix": self.covariance,
            },
            "observability": [
                {
                    "name": dof.name,
                    "frame": self.parent_frame,
                    "verdict": dof.verdict.value,
                    "sigma": dof.sigma,
                }
                for dof in self.observability
            ],
        }
        if self.T_base_child is not None:
            document["base_frame"] = self.base_frame
            document["T_base_child"] = self._base_dict(self.T_base_child)
        if self.T_method is not None:
            document["T_method"] = {
                "of": "T_parent_child as the method solved it: nothing set, no prior added",
                "matrix": self.T_method,
            }
        if self.floor is not None:
            document["floor"] = {
                "of": "errors of a whole recording, the same in every part; not in the covariance",
                "frame": self.child_frame,
                "units": "m, rad",
                "matrix": self.floor,
            }
        document |= {
            name: getattr(self, name)
            for name in self.__dataclass_fields__
            if name in PLAIN or name in PLAIN_LATER
        }
        document |= {"findings": self.findings, "warnings": self.warnings}
        return cast(dict[str, Any], plain(document))

    def _transform_dict(self) -> dict[str, Any]:
        frames = self.parent_frame, self.child_frame
        return self._printed_dict(self.T_parent_child, *frames, self.sigmas[:3], self.covariance)

    def _base_dict(self, T_base_child: FloatArray) -> dict[str, Any]:
        sigmas_m = sigmas_translation(T_base_child, self.covariance)
        if self.unobservable():
            sigmas_m = np.where(sigmas_m > _UNKNOWN_M, np.inf, sigmas_m)
        frames = self.base_frame, self.child_frame
        return self._printed_dict(T_base_child, *frames, sigmas_m, self.covariance)

    def _inverse_dict(self) -> dict[str, Any]:
        covariance = inverse_covariance(self.T_parent_child, self.covariance)
        sigmas_m = sigmas_translation(self.T_child_parent, covariance)
        if {*ROTATIONS} <= {*self.out_of_reach}:
            sigmas_m = self.sigmas[:3]  # the axes of both sensors are the same by convention
        elif self.unobservable():
            sigmas_m = np.where(sigmas_m > _UNKNOWN_M, np.inf, sigmas_m)
        frames = self.child_frame, self.parent_frame
        return self._printed_dict(self.T_child_parent, *frames, sigmas_m, covariance)

    def _printed_dict(
        self,
        T_target_source: FloatArray,
        target: str,
        source: str,
        sigmas_m: FloatArray,
        covariance: FloatArray,
    ) -> dict[str, Any]:
        """A transform in the notations people and programs use, with the standard deviation of each
        number that is printed; infinite, and no number, for what is unknown.
        """
        rotation = T_target_source[:3, :3]
        is_turn_known = not {*ROTATIONS} & {*self.unobservable()}
        rpy, sigmas = se3.rotation_to_rpy(rotation), sigmas_rpy(T_target_source, covariance)
        # Near gimbal lock roll and yaw have no standard deviation and are known.
        known = np.isfinite(sigmas) | is_turn_known
        document: dict[str, Any] = {
            "maps": f"coordinates of {source} into {target}",
            "translation": np.where(np.isfinite(sigmas_m), T_target_source[:3, 3], np.nan),
            "sigma_translation": sigmas_m,
            "quat_xyzw": se3.to_quat_xyzw(T_target_source) if is_turn_known else None,
            "rpy_deg": np.degrees(np.where(known, rpy, np.nan)),
            "sigma_rpy_deg": np.degrees(sigmas),
            "matrix": T_target_source,
        }
        if is_near_gimbal_lock(rotation, covariance):
            # Roll and yaw have no meaning of their own here.
            printed = printed_rotation(T_target_source, covariance)
            known = np.isfinite(printed.sigmas) | is_turn_known
            vector = np.where(known, printed.values, np.nan)
            document["rotation_vector_deg"] = np.degrees(vector)
            document["sigma_rotation_vector_deg"] = np.degrees(printed.sigmas)
        return document

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Build from the mapping that :meth:`to_dict` gave; other keys are ignored.

        Raises
        ------
        InputError
            If ``data`` is no calibration, is of another version or lacks something; the message
            says what.
        """
        is_mapping = isinstance(data, Mapping)
        found = (data.get("format"), data.get("version")) if is_mapping else (None, None)
        if found != (_FORMAT, _VERSION):
            raise InputError(
                f"expected format {_FORMAT}, version {_VERSION}; "
                f"found format {found[0]}, version {found[1]}"
            )
        # Version 0.1 had another name for it.
        later: dict[str, Any] = {"cross_check": data.get("consistency")} | dict(data)
        try:
            check_values(later)
            return cls(
                T_parent_child=transform_of(data["T_parent_child"]),
                T_method=transform_of(data["T_method"]) if "T_method" in data else None,
                base_frame=str(data.get("base_frame", "")),
                T_base_parent=base_parent(data) if "T_base_child" in data else None,
                floor=floor_of(data["floor"]) if "floor" in data else None,
                covariance=covariance_of(data["covariance"]),
                status=SolveStatus(data["status"]),
                observability=tuple(
                    DofObservability(
                        dof["name"], DofVerdict(dof["verdict"]), *numbers([dof["sigma"]])
                    )
                    for dof in data["observability"]
                ),
                warnings=tuple(data["warnings"]),
                findings=tuple(data.get("findings", ())),
                **{name: data[name] for name in PLAIN},
                **{name: later[name] for name in PLAIN_LATER if name in later},
            )
        except KeyError as error:
            raise InputError(f"the calibration has no {error}: restore or repeat it") from None
        except (TypeError, ValueError) as error:
            raise InputError(
                f"the calibration was changed after it was written: {error}; restore or repeat it"
            ) from None
