"""The same recording calibrated with several methods and references, as a table."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.offline import Progress, offline_config, whole_snapshot
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.methods import METHODS
from hand_eye_calib.results.calibration import Calibration
from hand_eye_calib.results.tables import data_frame

if TYPE_CHECKING:
    import pandas as pd


def compare_methods(
    parent: Trajectory,
    child: Trajectory,
    methods: Sequence[str] = tuple(METHODS),
    references: Sequence[str] = ("auto",),
    *,
    config: CalibratorConfig | None = None,
    progress: Progress | None = None,
) -> "pd.DataFrame":
    """Calibrate the same trajectories with several methods and references.

    Parameters
    ----------
    parent, child : Trajectory
        Poses of each sensor in its own world.
    methods : sequence of str
        All by default.
    references : sequence of str
        For methods that use one, such as ``("auto", "B5", "C20")``; the others run once.
    config : CalibratorConfig, optional
        All other options.
    progress : callable, optional
        Called with the share that is done, 0 to 1, and the method that begins.

    Returns
    -------
    pandas.DataFrame
        One row per method and reference: ``method`` and ``reference`` as asked for, ``solved_by``
        and ``on`` as chosen, ``verdict``, ``status``, ``x`` to ``yaw`` (m, rad) and their
        ``sigma_x`` to ``sigma_yaw``, ``time_offset_s``, ``scale``, ``pairs``, ``inliers``, and
        ``seconds`` of processor time.

    Raises
    ------
    ConfigError
        For a method or reference that is not known, or if a stream is not one of poses.
    NotEnoughDataError
        If too few poses can be paired.
    MissingDependencyError
        Without pandas.
    """
    config = config or offline_config(parent, child, {})
    config.require_poses("a comparison of methods")
    asked = list(_asked(methods, references))
    configs = [replace(config, method=method, reference=on or "auto") for method, on in asked]
    snapshot = whole_snapshot(config, parent, child).resolved()
    rows = []
    for number, ((method, on), one) in enumerate(zip(asked, configs, strict=True)):
        if progress is not None:
            progress(number / len(asked), " ".join(filter(None, (method, on))))
        own = replace(snapshot.config, method=one.method, reference=one.reference)
        started = time.process_time()
        result = replace(snapshot, config=own).estimate()
        seconds = time.process_time() - started
        rows.append({"method": method, "reference": on, **_row(result), "seconds": seconds})
    if progress is not None:
        progress(1.0, "done")
    return data_frame(rows)


def _asked(methods: Sequence[str], references: Sequence[str]) -> Iterator[tuple[str, str]]:
    for method in methods:
        record = METHODS.get(method)
        for reference in references if record is None or record.uses_reference else ("",):
            yield method, reference


def _row(result: Calibration) -> dict[str, Any]:
    axes = result.rows()
    return {
        "solved_by": result.method,
        "on": result.reference,
        "verdict": result.verdict.value,
        "status": result.status.value,
        **{name: row["value"] for name, row in axes.items()},
        **{f"sigma_{name}": row["sigma"] for name, row in axes.items()},
        "time_offset_s": result.time_offset_s,
        "scale": result.scale,
        "pairs": result.n_pairs,
        "inliers": result.n_inliers,
    }
