"""The result of a calibration: the extrinsic and everything one has to know to trust it."""

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.printed_angles import (
    inverse_covariance,
    is_near_gimbal_lock,
    printed_rotation,
    sigmas_rpy,
    sigmas_translation,
)

# Of to_dict: a change that an older reader cannot understand raises the version.
_FORMAT = "hand_eye_calib/extrinsic"
_VERSION = 1

# Where the motion leaves something unknown, a standard deviation above this (m) comes from that.
_UNKNOWN_M = 0.9


class SolveStatus(str, Enum):
    """How a solve ended. Only OK is a result to use as it is."""

    OK = "ok"
    UNOBSERVABLE = "unobservable"
    NOT_CONVERGED = "not_converged"


class DofVerdict(str, Enum):
    """What the motion says about one degree of freedom; PRIOR where a prior says (most of) it."""

    OBSERVED = "observed"
    WEAK = "weak"
    UNOBSERVABLE = "unobservable"
    PRIOR = "prior"


@dataclass(frozen=True)
class DofObservability:
    """Verdict on one degree of freedom of the child sensor's pose, along or about an axis of the
    parent sensor's frame.

    Attributes
    ----------
    name : str
        x, y, z (translation) or roll, pitch, yaw (rotation about x, y, z).
    verdict : DofVerdict
    sigma : float
        One standard deviation, in m or rad; ``inf`` where unobservable.
    """

    name: str
    verdict: DofVerdict
    sigma: float


@dataclass(frozen=True)
class Calibration:
    """An extrinsic with its quality.

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
    objective : float
        Value of the method's cost at the solution; for dnlo eq. (5), the outliers' share included.
    method, reference, backend : str
        What was solved; ``reference`` is the one used, also where ``auto`` was asked for.
    n_poses, n_pairs, n_inliers : int
        Synchronised pose pairs, motion pairs, and motion pairs that count as inliers.
    time_offset_s, time_offset_sigma_s : float
        Seconds added to the child's stamps, and one standard deviation: 0 where the offset was
        given.
    scale, scale_sigma : float
        Factor applied to the child's translations, and one standard deviation: 0 where the scale
        was given.
    reference_reason : str
        Why ``auto`` chose the reference; empty where it was given.
    noise : dict or None
        What the adaptive estimator found out about the trajectories' noise; None with other
        methods.
    consistency : dict or None
        Per axis, how far other methods and references and the drive's halves lie from this answer
        (:class:`~hand_eye_calib.engine.cross_check.Consistency`); None where they were not asked.
    stamp_ns : int
        Stamp of the newest pose used, parent clock.
    parent_frame, child_frame : str
    warnings : tuple of str
        What a person should know before using the result.
    """

    T_parent_child: np.ndarray
    covariance: np.ndarray
    status: SolveStatus
    observability: tuple
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
    reference_reason: str = ""
    noise: dict | None = None
    consistency: dict | None = None
    stamp_ns: int = 0
    parent_frame: str = "parent"
    child_frame: str = "child"
    warnings: tuple = field(default_factory=tuple)

    @property
    def T_child_parent(self):
        """(4, 4) array: pose of the parent sensor in the child sensor's frame."""
        return se3.inverse(self.T_parent_child)

    @property
    def sigmas(self):
        """(6,) array: standard deviations along (m) and about (rad) the axes of the parent sensor's
        frame; infinite where unobservable.
        """
        return np.array([dof.sigma for dof in self.observability])

    @property
    def sigmas_rpy(self):
        """(3,) array: standard deviations, rad, of the roll, pitch and yaw that are printed; infinite
        where one is unknown. Those of ``sigmas`` are of rotations about the parent's axes instead.
        """
        return sigmas_rpy(self.T_parent_child, self.covariance)

    def unobservable(self):
        """Names of the degrees of freedom the motion did not reveal."""
        return [dof.name for dof in self.observability if dof.verdict is DofVerdict.UNOBSERVABLE]

    def to_dict(self):
        """Everything as plain numbers, strings, lists and mappings, ready for JSON or YAML
        (infinite sigmas as None).
        """
        return {
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
                "matrix": [[_finite(value) for value in row] for row in self.covariance.tolist()],
            },
            "observability": [
                {
                    "name": dof.name,
                    "frame": self.parent_frame,
                    "verdict": dof.verdict.value,
                    "sigma": _finite(dof.sigma),
                }
                for dof in self.observability
            ],
            "objective": float(self.objective),
            "method": self.method,
            "reference": self.reference,
            "backend": self.backend,
            "n_poses": self.n_poses,
            "n_pairs": self.n_pairs,
            "n_inliers": self.n_inliers,
            "time_offset_s": self.time_offset_s,
            "time_offset_sigma_s": self.time_offset_sigma_s,
            "scale": self.scale,
            "scale_sigma": self.scale_sigma,
            "reference_reason": self.reference_reason,
            "noise": self.noise,
            "consistency": self.consistency,
            "stamp_ns": self.stamp_ns,
            "warnings": list(self.warnings),
        }

    def _transform_dict(self):
        return _transform_dict(
            self.T_parent_child,
            self.parent_frame,
            self.child_frame,
            self.sigmas[:3],
            self.covariance,
        )

    def _inverse_dict(self):
        covariance = inverse_covariance(self.T_parent_child, self.covariance)
        sigmas_m = sigmas_translation(self.T_child_parent, covariance)
        if self.unobservable():
            sigmas_m = np.where(sigmas_m > _UNKNOWN_M, np.inf, sigmas_m)
        return _transform_dict(
            self.T_child_parent,
            self.child_frame,
            self.parent_frame,
            sigmas_m,
            covariance,
        )

    @classmethod
    def from_dict(cls, data):
        """The calibration that :meth:`to_dict` described; what else ``data`` holds is left alone.

        Raises
        ------
        InputError
            Where ``data`` is no calibration, is of another version, or lacks something; the message
            says what.
        """
        found = (
            (data.get("format"), data.get("version")) if isinstance(data, dict) else (None, None)
        )
        if found != (_FORMAT, _VERSION):
            raise InputError(
                f"expected format {_FORMAT}, version {_VERSION}; found format {found[0]}, version {found[1]}"
            )
        plain = ("objective", "method", "reference", "backend", "n_poses", "n_pairs", "n_inliers", "time_offset_s", "scale",
                 "stamp_ns", "parent_frame", "child_frame")  # fmt: skip
        try:
            return cls(
                T_parent_child=np.array(data["T_parent_child"]["matrix"], dtype=float).reshape(
                    4, 4
                ),
                covariance=np.array(
                    [_infinite(row) for row in data["covariance"]["matrix"]], dtype=float
                ).reshape(6, 6),
                status=SolveStatus(data["status"]),
                observability=tuple(
                    DofObservability(
                        dof["name"], DofVerdict(dof["verdict"]), *_infinite([dof["sigma"]])
                    )
                    for dof in data["observability"]
                ),
                warnings=tuple(data["warnings"]),
                **{name: data[name] for name in plain},
                # older files lack these
                **{name: data.get(name, 0.0) for name in ("time_offset_sigma_s", "scale_sigma")},
                reference_reason=data.get("reference_reason", ""),
                noise=data.get("noise"),
                consistency=data.get("consistency"),
            )
        except KeyError as error:
            raise InputError(
                f"the calibration lacks {error}; it is not as it was written"
            ) from None
        except (TypeError, ValueError) as error:
            raise InputError(f"the calibration is not as it was written: {error}") from None


def _infinite(values):
    return [np.inf if value is None else float(value) for value in values]


def _finite(value):
    return float(value) if np.isfinite(value) else None


def _transform_dict(T_target_source, target, source, sigmas_m, covariance):
    """A transform in the notations people and programs use, with the standard deviation of each
    number that is printed (None for unknown).
    """
    rotation = T_target_source[:3, :3]
    document = {
        "maps": f"coordinates of {source} into {target}",
        "translation": T_target_source[:3, 3].tolist(),
        "sigma_translation": [_finite(value) for value in sigmas_m],
        "quat_xyzw": se3.to_quat_xyzw(T_target_source).tolist(),
        "rpy_deg": np.degrees(se3.rotation_to_rpy(rotation)).tolist(),
        "sigma_rpy_deg": _degrees(sigmas_rpy(T_target_source, covariance)),
        "matrix": T_target_source.tolist(),
    }
    if is_near_gimbal_lock(rotation, covariance):
        # Here roll and yaw mean nothing one by one.
        printed = printed_rotation(T_target_source, covariance)
        document["rotation_vector_deg"] = np.degrees(printed.values).tolist()
        document["sigma_rotation_vector_deg"] = _degrees(printed.sigmas)
    return document


def _degrees(values):
    return [_finite(value) for value in np.degrees(values)]
