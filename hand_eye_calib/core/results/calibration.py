"""The result of a calibration: extrinsic, covariance and verdict."""

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hand_eye_calib.core.base.errors import require_type, required
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.registry import RESULT_METHODS
from hand_eye_calib.core.base.text import AXIS_UNITS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import (
    inverse_covariance,
    sigmas_in_parent,
)
from hand_eye_calib.core.results import document, stored
from hand_eye_calib.core.results.parts import part
from hand_eye_calib.core.results.reasons import Verdict
from hand_eye_calib.core.results.records import (
    AXES,
    DofObservability,
    DofVerdict,
    SolveStatus,
)
from hand_eye_calib.core.results.verdict import Judged

if TYPE_CHECKING:
    import pandas as pd

__all__ = [
    "Calibration",
    "DofObservability",
    "DofVerdict",
    "SolveStatus",
    "Verdict",
]


def data_frame(rows: Sequence[Mapping[str, Any]], index: str) -> "pd.DataFrame":
    """Return a DataFrame of rows with the same names; the column ``index`` is the index.

    Raises
    ------
    MissingDependencyError
        Without pandas.
    """
    pandas = required("pandas", "a table", "notebook")
    return pandas.DataFrame(rows).set_index(index)


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration(Judged):
    """An extrinsic with its quality.

    It has the values of :class:`~hand_eye_calib.core.results.result.Result`. :attr:`verdict` and
    :attr:`reasons` follow from these values. Two results are equal if their documents are equal.

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
        numbers = document.printed_numbers(
            document.transforms_of(self)["T_parent_child"], self.out_of_reach
        )
        values = ", ".join(
            f"{axis} {number}" for axis, number in numbers.items()
        )
        notes = "".join(f"\n note: {warning}" for warning in self.warnings)
        return (
            f"<Calibration: {self.headline}{notes}\n {frames}: {values}, "
            f"{self.method} {self.reference}, {self.n_poses} poses>"
        )

    def to_frame(self) -> "pd.DataFrame":
        """Return a DataFrame with a row for each of x, y, z, roll, pitch, yaw.

        A row has the printed number, its standard deviation with the allowance (m, rad), and the
        verdict on the axis. An unknown number is NaN.

        Raises
        ------
        MissingDependencyError
            Without pandas.
        """
        sigmas = self.sigmas_printed
        # Near gimbal lock, a known angle has no standard deviation.
        is_known = np.isfinite(self.sigmas)
        pose = se3.xyz_rpy(self.T_parent_child)
        values = np.where(is_known, pose, np.nan).tolist()
        rows = zip(self.observability, values, sigmas, strict=True)
        table = []
        for dof, value, sigma in rows:
            row = {
                "axis": dof.name,
                "value": value,
                "sigma": sigma,
                "unit": AXIS_UNITS[dof.name],
                "verdict": dof.verdict.value,
            }
            table.append(row)
        return data_frame(table, "axis")

    def inverse(self) -> "Calibration":
        """Return the pose of the parent sensor in the child sensor's frame, as a result.

        The inverse has no residuals, no cross-check, and no comparison with an installed transform.
        """
        T = self.T_parent_child
        covariance = inverse_covariance(T, self.covariance_measured)
        sigmas = sigmas_in_parent(
            se3.rotation_of(self.T_child_parent), covariance
        )
        if self.unobservable():
            sigmas[sigmas > document.UNKNOWN_M] = np.inf
        observability = []
        for axis, sigma in zip(AXES, sigmas.tolist(), strict=True):
            is_known = math.isfinite(sigma)
            verdict = (
                DofVerdict.OBSERVED if is_known else DofVerdict.UNOBSERVABLE
            )
            observability.append(DofObservability(axis, verdict, sigma))
        return replace(
            self,
            T_parent_child=self.T_child_parent,
            T_method=None
            if self.T_method is None
            else se3.inverse(self.T_method),
            T_base_parent=None,
            covariance_measured=covariance,
            covariance_allowance=inverse_covariance(
                T, self.covariance_allowance
            ),
            observability_measured=tuple(observability),
            exact_streams=tuple(
                "child" if stream == "parent" else "parent"
                for stream in self.exact_streams
            ),
            parent_frame=self.child_frame,
            child_frame=self.parent_frame,
            parts={
                name: part(name).invert(value)
                for name, value in self.parts.items()
            },
            # Subtracting from 0.0 changes an offset of 0.0 to 0.0, and not to -0.0.
            time_offset_s=0.0 - self.time_offset_s,
            scale=1.0 / self.scale,
            scale_sigma=self.scale_sigma / self.scale**2,
            motion_residuals=None,
            cross_check=None,
            comparison=None,
            recording=None,
        )

    def save(self, directory: str | Path) -> Path:
        """Write ``extrinsic.yaml`` and files for robots; see :func:`hand_eye_calib.save`."""
        return RESULT_METHODS["save"](self, directory)

    def plot(self, ax: Any = None) -> Any:
        """Draw the result with Matplotlib; see :func:`hand_eye_calib.plot`."""
        return RESULT_METHODS["plot"](self, ax)

    def _repr_html_(self) -> str:
        """Return verdict, numbers and the three views, for notebooks."""
        html: str = RESULT_METHODS["html"](self)
        return html

    def report(self, path: str | Path) -> Path:
        """Write the report as one HTML file; a directory gets ``report.html``.

        Raises
        ------
        InputError
            If the result was read from a file, because files have no poses; or if the report cannot
            be written.
        """
        self.residuals()
        require_type("path", path, str, PathLike)
        path = Path(path, "report.html") if Path(path).is_dir() else Path(path)
        return RESULT_METHODS["report"](self, path)

    def static_transform_command(self) -> str:
        """Return the shell command that publishes the child's pose as a static transform.

        The pose is in the frame on which the child is mounted. If an axis is unknown, the command
        has a word instead of a number, which static_transform_publisher refuses. The command is
        empty if the verdict is DO NOT USE.
        """
        arguments = document.transform_arguments(self, 9)
        if not arguments:
            return ""
        return f"ros2 run tf2_ros static_transform_publisher {shlex.join(arguments)}"

    def export(self, format: str) -> str:
        """Return the extrinsic as a file of another program.

        Parameters
        ----------
        format : str
            "autoware", "fast_lio", "fast_livo2", "lio_sam", "kalibr", "openvins", "vins",
            "orbslam3", "apollo", "dlio", "glim", "msa", "px4", "kitti", "nuscenes", "colmap",
            "driveworks", "easy_handeye2", "opencv", "numpy", "urdf" or "launch".
            docs/exports.md describes them.

        Returns
        -------
        str
            Text of the file, with a comment that names the source and the target frame of the
            numbers. If the format has the sensors in the other order, the transform and the sign of
            the time offset are inverted.

        Raises
        ------
        ConfigError
            For an unknown format.
        InputError
            If the verdict is DO NOT USE, or an axis that the format needs is unknown.

        Examples
        --------
        >>> print(result.export("fast_lio"))  # doctest: +SKIP
        """
        return RESULT_METHODS["export"](self, format)

    def to_dict(self) -> Document:
        """Return the result without its residuals in plain values, for JSON or YAML.

        Infinite numbers and values of unknown axes are None. Only ``matrix`` contains numbers for
        unknown axes, so that :meth:`from_dict` can read it.
        """
        return document.document_of(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Build a result from the mapping that :meth:`to_dict` returned; other keys are ignored.

        Raises
        ------
        InputError
            If ``data`` is not a calibration, has another version or lacks a value. The message
            names the value.
        """
        return stored.result_from(cls, data)
