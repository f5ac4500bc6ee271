"""The result of a calibration: the extrinsic, its covariance, and what to know before using it."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from hand_eye_calib.core.base.errors import required
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.registry import RESULT_METHODS
from hand_eye_calib.core.base.text import AXIS_UNITS
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.se3 import inverse_covariance, sigmas_in_parent
from hand_eye_calib.core.results import document
from hand_eye_calib.core.results.parts import part
from hand_eye_calib.core.results.records import AXES, DofObservability, DofVerdict, SolveStatus
from hand_eye_calib.core.results.verdict import Judged, Verdict

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Calibration", "DofObservability", "DofVerdict", "SolveStatus", "Verdict"]


def data_frame(rows: Sequence[Mapping[str, Any]], index: str) -> "pd.DataFrame":
    """A DataFrame of rows with equal names, one of which is the index; a MissingDependencyError
    without pandas.
    """
    pandas = required("pandas", "a table", "notebook")
    return pandas.DataFrame(rows).set_index(index)


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration(Judged):
    """An extrinsic with its quality: the values of
    :class:`~hand_eye_calib.core.results.result.Result`, and what follows from them.

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
        printed = zip(AXES, se3.xyz_rpy(self.T_parent_child), self.sigmas_printed, strict=True)
        values = ", ".join(f"{axis} {at:.6g} +/- {sigma:.2g}" for axis, at, sigma in printed)
        return (
            f"<Calibration: {self.headline}\n {frames}: {values} (m, rad), "
            f"{self.method} {self.reference}, {self.n_poses} poses>"
        )

    def to_frame(self) -> "pd.DataFrame":
        """DataFrame with a row for each of x, y, z, roll, pitch, yaw: the printed number, its
        standard deviation with the allowance (m, rad), and the verdict.

        Raises
        ------
        MissingDependencyError
            Without pandas.
        """
        values = se3.xyz_rpy(self.T_parent_child).tolist()
        rows = zip(self.observability, values, self.sigmas_printed, strict=True)
        table = []
        for dof, value, sigma in rows:
            row = {"axis": dof.name, "value": value, "sigma": sigma}
            table.append(row | {"unit": AXIS_UNITS[dof.name], "verdict": dof.verdict.value})
        return data_frame(table, "axis")

    def inverse(self) -> "Calibration":
        """The result with the roles of both sensors exchanged: the pose of the parent sensor in the
        child sensor's frame. What was compared with it is left out.
        """
        T = self.T_parent_child
        covariance = inverse_covariance(T, self.covariance_measured)
        sigmas = sigmas_in_parent(se3.rotation_of(self.T_child_parent), covariance)
        if self.unobservable():
            sigmas[sigmas > document.UNKNOWN_M] = np.inf
        known = (DofVerdict.UNOBSERVABLE, DofVerdict.OBSERVED)
        observability = tuple(
            DofObservability(axis, known[bool(np.isfinite(sigma))], sigma)
            for axis, sigma in zip(AXES, sigmas.tolist(), strict=True)
        )
        return replace(
            self,
            T_parent_child=self.T_child_parent,
            T_method=None if self.T_method is None else se3.inverse(self.T_method),
            T_base_parent=None,
            covariance_measured=covariance,
            covariance_allowance=inverse_covariance(T, self.covariance_allowance),
            observability_measured=observability,
            parent_frame=self.child_frame,
            child_frame=self.parent_frame,
            parts={name: part(name).invert(value) for name, value in self.parts.items()},
            time_offset_s=0.0 - self.time_offset_s,
            scale=1.0 / self.scale,
            scale_sigma=self.scale_sigma / self.scale**2,
            motion_residuals=None,
            cross_check=None,
            comparison=None,
            recording=None,
        )

    def save(self, directory: str | Path) -> Path:
        """Write ``extrinsic.yaml`` and the files for robots; see :func:`hand_eye_calib.save`."""
        return RESULT_METHODS["save"](self, directory)

    def plot(self, ax: Any = None) -> Any:
        """Draw the result: a figure of Matplotlib; see :func:`hand_eye_calib.plot`."""
        return RESULT_METHODS["plot"](self, ax)

    def report(self, path: str | Path) -> Path:
        """Write the report as one HTML file; a directory gets ``report.html``.

        Raises
        ------
        InputError
            If the result was read from a file, which has no poses, or the report cannot be written.
        """
        self.residuals()
        path = Path(path, "report.html") if Path(path).is_dir() else Path(path)
        return RESULT_METHODS["report"](self, path)

    def static_transform_command(self) -> str:
        """Shell command that publishes the child's pose as a static transform, in the frame that it
        is mounted on; empty if the verdict is DO NOT USE. For an axis that the motion does not
        determine it has a word that static_transform_publisher refuses.
        """
        told = document.transform_arguments(self, 9)
        command = f"ros2 run tf2_ros static_transform_publisher {shlex.join(told)}"
        return command if told else ""

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
        return RESULT_METHODS["export"](self, format)

    def to_dict(self) -> Document:
        """Everything but the residuals as plain numbers, strings, lists and mappings, ready for
        JSON or YAML. None for what is infinite, and for each printed number of an axis that is
        not known; only a ``matrix`` has a number there, so that it can be read back.
        """
        return document.document_of(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Build from the mapping that :meth:`to_dict` gave; other keys are ignored.

        Raises
        ------
        InputError
            If ``data`` is no calibration, is of another version or lacks something; the message
            says what.
        """
        return document.result_from(cls, data)
