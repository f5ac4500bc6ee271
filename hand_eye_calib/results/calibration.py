"""The result of a calibration: the extrinsic, its covariance, and what to know before using it."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.extrinsic import (
    inverse_covariance,
    sigmas_rpy,
    sigmas_translation,
)
from hand_eye_calib.plain import plain
from hand_eye_calib.results.document import MATRICES, NOT_IN_FILES, values_of
from hand_eye_calib.results.records import Finding, Residuals
from hand_eye_calib.results.result import Result
from hand_eye_calib.results.status import (
    AXES,
    ROTATIONS,
    TRANSLATIONS,
    DofObservability,
    DofVerdict,
    SolveStatus,
    by_hand,
)
from hand_eye_calib.results.tables import data_frame
from hand_eye_calib.results.verdict import Reason, Verdict, headline, reasons, verdict_of
from hand_eye_calib.upstairs import upstairs

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "Calibration",
    "DofObservability",
    "DofVerdict",
    "Finding",
    "Reason",
    "Residuals",
    "SolveStatus",
    "Verdict",
]

# Format and version of to_dict. A change that an older reader cannot understand raises the version.
_FORMAT = "hand_eye_calib/extrinsic"
_VERSION = 1

# An axis with more than this share (a cosine) of an unobservable direction is unknown, too.
_SHARED = 0.02

# What has a direction and is left out when both sensors change their roles.
_OF_THIS_DIRECTION = (
    "cross_check",
    "comparison",
    "motion_residuals",
    "recording",
    "T_base_parent",
)

# With a direction unobservable, a larger standard deviation (m) of the inverse comes from that.
_UNKNOWN_M = 0.9


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration(Result):
    """An extrinsic with its quality: the values of
    :class:`~hand_eye_calib.results.result.Result`, and what follows from them.

    :attr:`verdict` says whether it may be used, and :attr:`reasons` why not. Two are equal if their
    documents are.

    Examples
    --------
    >>> result.verdict.value
    'USE'
    >>> result.translation.round(2), result.rotation.as_quat().shape  # m; SciPy's Rotation
    (array([ 0.11, -0.29,  0.48]), (4,))
    >>> result.inverse().parent_frame, result == hec.Calibration.from_dict(result.to_dict())
    ('camera', True)
    >>> result.save("saved"), result.report("saved/report.html")
    (PosixPath('saved/extrinsic.yaml'), PosixPath('saved/report.html'))
    """

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Calibration):
            return NotImplemented
        return self is other or self.to_dict() == other.to_dict()

    __hash__ = object.__hash__

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
        units = 3 * ["m"] + 3 * ["rad"]
        columns = zip(self.observability, self._printed(), sigmas, units, strict=True)
        return {
            dof.name: {"value": value, "sigma": sigma, "unit": unit, "verdict": dof.verdict.value}
            for dof, value, sigma, unit in columns
        }

    def inverse(self) -> "Calibration":
        """The result with the roles of both sensors exchanged: the pose of the parent sensor in the
        child sensor's frame. What was compared with it is left out.
        """
        to_child = np.kron(np.eye(2), self.T_child_parent[:3, :3])
        covariance, floor = (
            inverse_covariance(self.T_parent_child, each) for each in (self.covariance, self._floor)
        )
        variances = np.diag(to_child @ covariance @ to_child.T)
        sigmas = np.sqrt(np.maximum(variances, 0.0))
        unknown = bool(self.unobservable()) & (sigmas > _UNKNOWN_M)
        sigmas = np.where(unknown, np.inf, sigmas)
        kinds = DofVerdict.OBSERVED, DofVerdict.UNOBSERVABLE
        verdicts = [kinds[is_unknown] for is_unknown in unknown.astype(int).tolist()]
        axes = tuple(map(DofObservability, AXES, verdicts, sigmas.tolist()))
        worlds: dict[str, Any] = {}
        if self.T_world_world is not None and self.cov_world_world is not None:
            worlds = {
                "T_world_world": se3.inverse(self.T_world_world),
                "cov_world_world": inverse_covariance(self.T_world_world, self.cov_world_world),
            }
        exchanged: dict[str, Any] = {
            "T_parent_child": self.T_child_parent,
            "T_method": None if self.T_method is None else se3.inverse(self.T_method),
            "covariance": covariance,
            "floor": None if self.floor is None else floor,
            "observability": axes,
            "parent_frame": self.child_frame,
            "child_frame": self.parent_frame,
            "parent_world_frame": self.child_world_frame,
            "child_world_frame": self.parent_world_frame,
            "time_offset_s": 0.0 - self.time_offset_s,
            "scale": 1.0 / self.scale,
            "scale_sigma": self.scale_sigma / self.scale**2,
        }
        left_out: dict[str, Any] = dict.fromkeys(_OF_THIS_DIRECTION)
        return replace(self, **exchanged, **worlds, **left_out)

    def save(self, directory: str | Path) -> Path:
        """Write ``extrinsic.yaml`` and the files for robots; see :func:`hand_eye_calib.save`."""
        return cast(Path, upstairs("io.results", "save_result")(self, directory))

    def plot(self) -> Any:
        """Draw the result: a figure of Matplotlib; see :func:`hand_eye_calib.plot`."""
        return upstairs("report.plot", "plot")(self)

    def report(self, path: str | Path) -> Path:
        """Write the report as one HTML file; a directory gets ``report.html``.

        Raises
        ------
        InputError
            If the result was read from a file, which has no poses, or the report cannot be written.
        """
        if self.motion_residuals is None:
            raise InputError("a result that was read from a file has no poses; calibrate again")
        path = Path(path, "report.html") if Path(path).is_dir() else Path(path)
        page = upstairs("report.report", "render")(self, self.recording)
        return cast(Path, upstairs("io.results", "save_text")(path, page))

    def static_transform_command(self) -> str:
        """Shell command that publishes the child's pose as a static transform, in the frame that it
        is mounted on; empty if the verdict is DO NOT USE. For an axis that the motion does not
        determine it has a word that static_transform_publisher refuses.
        """
        told = "".join(
            f"--{name} {value if isinstance(value, str) else f'{round(value, 9) + 0.0:.9f}'} "
            for name, value in self.usable_numbers().items()
        )
        parent, child = map(shlex.quote, (self.mounting[0], self.child_frame))
        frames = f"--frame-id {parent} --child-frame-id {child}"
        return told and f"ros2 run tf2_ros static_transform_publisher {told}{frames}"

    def export(self, format: str) -> str:
        """The extrinsic as a file of another program.

        Parameters
        ----------
        format : str
            "autoware", "fast_lio", "fast_livo2", "lio_sam", "kalibr", "openvins", "vins",
            "orbslam3", "apollo", "dlio", "glim", "msa", "px4", "kitti", "nuscenes", "colmap",
            "driveworks", "easy_handeye2", "opencv" or "numpy"; docs/exports.md has a page of them.

        Returns
        -------
        str
            The text of the file. A comment says by the frames' names what the numbers map. Where
            the format has the sensors the other way round, the transform is inverted, and so is
            the sign of the time offset.

        Raises
        ------
        ConfigError
            For an unknown format.
        InputError
            Under DO NOT USE, and if an axis is not known that the format has.

        Examples
        --------
        >>> print(result.export("fast_lio"))  # doctest: +SKIP
        """
        from hand_eye_calib.results.exports import export_text

        is_usable = self.verdict is not Verdict.DO_NOT_USE
        return export_text(self, format, self.headline, is_usable)

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
        T, unknown = self.mounting[1], {*self.unobservable()}
        hidden = np.array([axis in unknown for axis in TRANSLATIONS])
        if self.T_base_parent is not None:  # axes that share a direction that the motion hides
            of_base = np.abs(self.T_base_parent[:3, :3][:, hidden])
            hidden = of_base.max(axis=1, initial=0.0) > _SHARED
        numbers: dict[str, float | str] = {
            axis: by_hand(axis) if is_hidden else float(value)
            for axis, value, is_hidden in zip(TRANSLATIONS, T[:3, 3], hidden, strict=True)
        }
        if unknown.intersection(ROTATIONS):
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

    def to_dict(self) -> dict[str, Any]:
        """Everything but the residuals as plain numbers, strings, lists and mappings, ready for
        JSON or YAML. None for what is infinite, and for each printed number of an axis that is
        not known; only a ``matrix`` has a number there, so that it can be read back.
        """
        frames, child = (self.parent_frame, self.child_frame), self.child_frame
        document: dict[str, Any] = {
            "verdict": self.verdict,
            "headline": self.headline,
            "reasons": self.reasons,
            "format": _FORMAT,
            "version": _VERSION,
            "parent_frame": self.parent_frame,
            "child_frame": child,
            "T_parent_child": self._printed_dict(
                self.T_parent_child, *frames, sigmas_m=self.sigmas[:3]
            ),
            "T_child_parent": self._inverse_dict(),
            "status": self.status,
            "covariance": _matrix_of("error xi in T_parent_child @ exp(xi)", child, self.covariance)
            | {"order": ["rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z"]},
            "observability": [
                vars(dof) | {"sigma_total": total, "frame": self.parent_frame}
                for dof, total in zip(self.observability, self.sigmas_with_floor, strict=True)
            ],
        }
        if self.T_base_child is not None:
            document["T_base_child"] = self._printed_dict(self.T_base_child, self.base_frame, child)
        if self.T_method is not None:
            of = "T_parent_child as the method solved it: nothing set, no prior added"
            document["T_method"] = {"of": of, "matrix": self.T_method}
        if (Z := self.T_world_world) is not None and (cov := self.cov_world_world) is not None:
            worlds, of = (
                (self.parent_world_frame, self.child_world_frame),
                "T_world_world @ exp(xi)",
            )
            document["T_world_world"] = self._printed_dict(Z, *worlds, cov, np.zeros((6, 6)))
            document["cov_world_world"] = _matrix_of(f"error xi in {of}", worlds[1], cov)
        if self.floor is not None:
            of = "errors of a whole recording, the same in every part; not in the covariance"
            document["floor"] = _matrix_of(of, child, self.floor)
        document["sigma_total"] = dict(zip(AXES, self.sigmas_with_floor, strict=True))
        document |= {
            name: getattr(self, name)
            for name in self.__dataclass_fields__
            if name not in (*MATRICES, *NOT_IN_FILES, *document)
        }
        return cast(dict[str, Any], plain(document))

    def _inverse_dict(self) -> dict[str, Any]:
        covariance, floor = (
            inverse_covariance(self.T_parent_child, each) for each in (self.covariance, self._floor)
        )
        frames = self.child_frame, self.parent_frame
        # Where the rotation is out of reach, the axes of both sensors are the same by convention.
        sigmas_m = self.sigmas[:3] if {*ROTATIONS} <= {*self.out_of_reach} else None
        return self._printed_dict(self.T_child_parent, *frames, covariance, floor, sigmas_m)

    def _printed_dict(
        self,
        T_target_source: FloatArray,
        target: str,
        source: str,
        covariance: FloatArray | None = None,
        floor: FloatArray | None = None,
        sigmas_m: FloatArray | None = None,
    ) -> dict[str, Any]:
        """A transform in the notations people and programs use, with the standard deviation of each
        number that is printed, without and with the common-mode uncertainty; infinite, and no
        number, for what is unknown. Covariances are the result's unless others are given.
        """
        covariance = self.covariance if covariance is None else covariance
        floor = self._floor if floor is None else floor
        if sigmas_m is None:
            sigmas_m = sigmas_translation(T_target_source, covariance)
            if self.unobservable() or covariance is self.cov_world_world:
                sigmas_m = np.where(sigmas_m > _UNKNOWN_M, np.inf, sigmas_m)
        is_turn_known = not {*ROTATIONS} & {*self.unobservable()}
        rpy = se3.rotation_to_rpy(T_target_source[:3, :3])
        sigmas, of_floor = (sigmas_rpy(T_target_source, each) for each in (covariance, floor))
        # Near gimbal lock roll and yaw have no standard deviation and are known.
        known = np.isfinite(sigmas) | is_turn_known
        total_m = np.hypot(sigmas_m, sigmas_translation(T_target_source, floor))
        return {
            "maps": f"coordinates of {source} into {target}",
            "translation": np.where(np.isfinite(sigmas_m), T_target_source[:3, 3], np.nan),
            "sigma_translation": sigmas_m,
            "sigma_total_translation": total_m,
            "quat_xyzw": se3.to_quat_xyzw(T_target_source) if is_turn_known else None,
            "rpy_deg": np.degrees(np.where(known, rpy, np.nan)),
            "sigma_rpy_deg": np.degrees(sigmas),
            "sigma_total_rpy_deg": np.degrees(np.hypot(sigmas, of_floor)),
            "matrix": T_target_source,
        }

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
        try:
            return cls(**values_of(cls, data))
        except KeyError as error:
            raise InputError(f"the calibration has no {error}: restore or repeat it") from None
        except (TypeError, ValueError) as error:
            raise InputError(
                f"the calibration was changed after it was written: {error}; restore or repeat it"
            ) from None


def _matrix_of(of: str, frame: str, matrix: FloatArray) -> dict[str, Any]:
    """A covariance of a document, and what it is of."""
    return {"of": of, "frame": frame, "units": "m, rad", "matrix": matrix}
