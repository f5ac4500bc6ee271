"""Comparison of results with the installed extrinsic, or with each other."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from hand_eye_calib.core.assessment.agreement import Agreement, agreement_of
from hand_eye_calib.core.assessment.change import UNKNOWN, Change, moved
from hand_eye_calib.core.assessment.moved import (
    scatter_in_words,
    scatter_of_recordings,
)
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError, require_type
from hand_eye_calib.core.base.text import listing
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import turned
from hand_eye_calib.core.geometry.frames import Extrinsic
from hand_eye_calib.core.geometry.se3 import deviation, xyz_rpy
from hand_eye_calib.core.results.axes import target_of
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.core.results.context import Comparison, Difference
from hand_eye_calib.core.results.records import AXES, DofVerdict

_Named = tuple[str, Calibration | Extrinsic]

# An axis that is reported as unchanged may have changed by at most this multiple of its target.
SEEN_TARGETS = 5.0


def compare(
    results: Sequence[Calibration],
    installed: Calibration | Extrinsic | None = None,
    names: Sequence[str] | None = None,
) -> Comparison:
    """Compare results with the installed extrinsic, or with each other.

    If the frames of a result are exchanged (child and parent), the result is inverted.

    Parameters
    ----------
    results : sequence of Calibration
    installed : Calibration or Extrinsic, optional
        Extrinsic that the robot uses. By default, the results of several recordings of one rig are
        compared with each other.
    names : sequence of str, optional
        Names of the results; the default is a number.

    Returns
    -------
    Comparison
        ``moved`` has the names of the results that differ from the installed extrinsic. Without an
        installed extrinsic, it has the results that the others contradict.

    Raises
    ------
    InputError
        If there is nothing to compare, or if the results are for different pairs of frames.

    Examples
    --------
    >>> hec.compare([result], installed=result).verdict
    'same'
    """
    _require_types(results, installed)
    results = [_in_frames_of(results[0], result) for result in results]
    if isinstance(installed, Calibration) and results:
        installed = _in_frames_of(results[0], installed)
    by_name = _by_name(results, names)
    require_same_frames(
        extrinsic
        for extrinsic in (*results, installed)
        if isinstance(extrinsic, Calibration)
    )
    if installed is not None:
        return _comparison_with_installed(by_name, installed)
    return _comparison_with_each_other(by_name)


def _require_types(results: Sequence[object], installed: object) -> None:
    """Raise an InputError if an argument of :func:`compare` has another type."""
    require_type("results", results, Sequence, remedy="pass a list of results")
    for result in results:
        require_type(
            "each result",
            result,
            Calibration,
            remedy="read a saved result with hand_eye_calib.load",
        )
    if installed is not None and not isinstance(
        installed, Calibration | Extrinsic
    ):
        raise InputError(
            "installed must be an earlier result, such as hec.load(DIR); got "
            f"{type(installed).__name__}. For another source, run hand_eye_calib compare DIR "
            "--with SOURCE"
        )


def _in_frames_of(first: Calibration, result: Calibration) -> Calibration:
    """Return a result in given frames, inverted if they are exchanged."""
    is_exchanged = (
        result.parent_frame == first.child_frame
        and result.child_frame == first.parent_frame
    )
    return result.inverse() if is_exchanged else result


def _comparison_with_installed(
    by_name: Mapping[str, Calibration], installed: Calibration | Extrinsic
) -> Comparison:
    """Compare results with the installed extrinsic."""
    differences = _differences(
        [(("installed", installed), named) for named in by_name.items()]
    )
    verdict = _verdict_of(differences)
    moved_names = tuple(
        difference.second
        for difference in differences
        if difference.verdict == Change.MOVED
    )
    if len(differences) == 1:
        sentence = differences[0].sentence
    elif moved_names:
        sentence = f"moved: {listing(moved_names)} of {len(differences)}"
    else:
        sentence = f"{verdict}: none of {len(differences)} differs from what is installed"
    return Comparison(
        sentence=sentence,
        verdict=verdict,
        moved=moved_names,
        differences=differences,
    )


def _comparison_with_each_other(
    by_name: Mapping[str, Calibration],
) -> Comparison:
    """Compare the results of several recordings of one rig."""
    differences = _differences([*combinations(by_name.items(), 2)])
    verdict = _verdict_of(differences)
    moved_names: tuple[str, ...] = ()
    if any(difference.verdict == Change.MOVED for difference in differences):
        moved_names, sentence = _moved_results(by_name, differences)
    elif len(by_name) == 2 and verdict == Change.SAME.value:
        sentence = f"{verdict}: both agree"
    else:
        sentence = f"{verdict}: none of {len(by_name)} differs from another"
    return Comparison(
        sentence=sentence,
        verdict=verdict,
        moved=moved_names,
        differences=differences,
    )


def _differences(
    couples: Sequence[tuple[_Named, tuple[str, Calibration]]],
) -> tuple[Difference, ...]:
    """Test each pair of extrinsics for a difference."""
    if not couples:
        raise InputError(
            "expected two results or more; to compare one result with the installed transform, add "
            "--with (in Python, pass installed=)"
        )
    return tuple(_difference(*couple) for couple in couples)


def _verdict_of(differences: Sequence[Difference]) -> str:
    """Return the verdict of all differences together."""
    verdicts = [Change(difference.verdict) for difference in differences]
    return Change.of_all(verdicts).value


def _by_name(
    results: Sequence[Calibration], names: Sequence[str] | None
) -> dict[str, Calibration]:
    """Return results by name: the given names, or ``result 1``, ``result 2`` and so on."""
    if not names:
        names = [f"result {number}" for number in range(1, len(results) + 1)]
    by_name = dict(zip(names, results, strict=False))
    if len(by_name) < len(results):
        twice = next(
            name for name, count in Counter(names).items() if count > 1
        )
        raise InputError(f"{twice} appears twice: name each result once")
    return by_name


def _moved_results(
    by_name: Mapping[str, Calibration], differences: Sequence[Difference]
) -> tuple[tuple[str, ...], str]:
    """Return the names of the results that the others contradict, and a sentence about them."""
    names = [*by_name]
    # At least two results differ significantly. A weaker level suffices to find which of them
    # moved.
    agreement = agreement_of_results([*by_name.values()], level=0.05)
    if agreement.kind in ("one off", "moved"):
        moved_names = tuple(names[index] for index in agreement.apart)
        return moved_names, f"moved: {agreement.sentence(names)}"
    couples = [
        f"{difference.first} and {difference.second}"
        for difference in differences
        if difference.verdict == Change.MOVED
    ]
    return (
        (),
        f"moved: {'; '.join(couples)} differ; they do not show which of them has moved",
    )


def with_comparison(
    result: Calibration, installed: Calibration | Extrinsic
) -> Calibration:
    """Return a copy of a result with its comparison with the installed extrinsic."""
    origin = (
        "a result" if isinstance(installed, Calibration) else installed.origin
    )
    values = by_axis(xyz_rpy(installed.T_parent_child))
    comparison = compare([result], installed, ["result"])
    return replace(
        result, comparison=replace(comparison, installed=origin, values=values)
    )


def installed_transform(calibration: Calibration) -> FloatArray | None:
    """Return the installed T_parent_child (4, 4); None if the result has no comparison with it."""
    comparison = calibration.comparison
    if comparison is None or not comparison.values:
        return None
    values = np.array([comparison.values[axis] for axis in AXES])
    return se3.from_rotation_translation(
        se3.rotation_from_rpy(values[3:]), values[:3]
    )


def _difference(first: _Named, second: tuple[str, Calibration]) -> Difference:
    """Test on each axis whether two named extrinsics differ."""
    first_name, before = first
    second_name, after = second
    covariance, scatter, allowance = _covariances(before) + _covariances(after)
    if not (_is_from_motion(before) and _is_from_motion(after)):
        # Constant sensor errors cancel between two estimates from motion, but not here. The
        # variance of an axis is the larger value of two: the allowance, which covers these errors,
        # and the scatter between recordings.
        scatter = allowance + np.diag(
            np.maximum(np.diag(scatter - allowance), 0.0)
        )
    values = deviation(after.T_parent_child, before.T_parent_child)
    limits = SEEN_TARGETS * np.array([target_of(axis, after) for axis in AXES])
    difference = moved(values, covariance + scatter, limits)
    return Difference(
        first=first_name,
        second=second_name,
        verdict=difference.verdict.value,
        sentence=difference.sentence,
        axes=difference.axes,
        change=difference.what if difference.verdict is Change.MOVED else "",
    )


def _is_from_motion(extrinsic: Calibration | Extrinsic) -> bool:
    """Return whether an extrinsic was estimated from the motion of the same sensors."""
    return isinstance(extrinsic, Calibration) or extrinsic.is_calibration


def scatters_in_words(
    results: Sequence[Calibration],
    installed: Calibration | Extrinsic | None = None,
) -> str:
    """Explain the scatter between recordings in the standard deviations of a comparison."""
    texts = [scatter_in_words(_covariances(result)[0]) for result in results]
    scatters = "; and ".join(dict.fromkeys(texts))
    if installed is not None and not _is_from_motion(installed):
        return (
            "+/- contains the allowance of the result, or the usual scatter between recordings "
            f"where that is larger; it is assumed to be {scatters}"
        )
    return (
        "+/- contains the usual scatter between recordings, which is assumed to be "
        + scatters
    )


def _covariances(extrinsic: Calibration | Extrinsic) -> FloatArray:
    """Return three covariances of an extrinsic, as an array (3, 6, 6) in the parent's axes.

    The first is the measured covariance. The second is the scatter between recordings of the rig.
    The third is the allowance for constant sensor errors.
    """
    rotation = se3.rotation_of(extrinsic.T_parent_child)
    covariance = np.diag(UNKNOWN**2)
    allowance = np.zeros((6, 6))
    if isinstance(extrinsic, Calibration):
        measured = extrinsic.covariance_measured
        allowance = turned(rotation, extrinsic.covariance_allowance)
    else:
        measured = extrinsic.covariance
    if np.isfinite(measured).all():
        covariance = turned(rotation, measured)
    if isinstance(extrinsic, Calibration):
        is_hidden = [
            dof.verdict is DofVerdict.UNOBSERVABLE
            for dof in extrinsic.observability
        ]
        covariance = covariance + np.diag(np.where(is_hidden, UNKNOWN**2, 0.0))
    scatter = np.zeros((6, 6))
    if _is_from_motion(extrinsic):
        scatter = scatter_of_recordings(covariance)
    return np.array([covariance, scatter, allowance])


def agreement_of_results(
    results: Sequence[Calibration], level: float = 0.01
) -> Agreement:
    """Test whether the results of several recordings of one rig agree.

    ``results`` are in the order of time. ``level`` is the significance level of
    :func:`~hand_eye_calib.core.assessment.agreement.agreement_of`.
    """
    Ts = np.array([result.T_parent_child for result in results])
    in_child = np.array([result.covariance_measured for result in results])
    in_parent = turned(se3.rotation_of(Ts), in_child)
    variances = [
        np.diag(scatter_of_recordings(covariance)) for covariance in in_parent
    ]
    # The usual scatter of the rig: the median over its recordings.
    usual_scatter = np.sqrt(np.median(variances, axis=0))
    return agreement_of(Ts, in_parent, usual_scatter, level)


def require_same_frames(results: Iterable[Calibration]) -> None:
    """Raise InputError if the results have different pairs of frames."""
    frames = {
        f"{result.child_frame} in {result.parent_frame}" for result in results
    }
    if len(frames) > 1:
        raise InputError(
            f"expected results of one pair of frames; found {' and '.join(sorted(frames))}: "
            "calibrate all with the same parent_frame and child_frame"
        )


def by_axis(values: FloatArray) -> dict[str, float]:
    """Return six values as a mapping from the name of the axis to the value."""
    return dict(zip(AXES, values.tolist(), strict=True))
