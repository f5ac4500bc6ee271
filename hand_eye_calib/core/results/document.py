"""Documents: a result as plain values for JSON and YAML, and its numbers for other programs."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray
from hand_eye_calib.core.base.plain import Document, plain
from hand_eye_calib.core.base.text import (
    amount,
    fixed,
    given_or_estimated,
    listing,
    with_sigma,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.covariances import (
    inverse_covariance,
    sigmas_in_parent,
    sigmas_rpy,
)
from hand_eye_calib.core.results.axes import (
    cause_of_allowance,
    kinds_to_declare,
)
from hand_eye_calib.core.results.parts import ExtraTransform, all_parts, part
from hand_eye_calib.core.results.reasons import Reason, Verdict
from hand_eye_calib.core.results.records import (
    AXES,
    ROTATIONS,
    TRANSLATIONS,
    by_hand,
)
from hand_eye_calib.core.results.result import Result
from hand_eye_calib.core.results.verdict import Judged

FORMAT = "hand_eye_calib/extrinsic"
# Version of the documents. It increases with a change that an older reader cannot understand. In
# version 1, covariance and sigma did not contain the allowance, which was called floor.
VERSION = 2

# Two standard deviations are practically the same if their log ratio is below this.
_SAME_ANGLES = 0.2

# An allowance below this share of a standard deviation changes none of its two digits.
_NEGLIGIBLE_SHARE = 0.01

# Fields of a result that are matrices in a document.
TRANSFORMS = ("T_parent_child", "T_method", "T_base_parent")
COVARIANCES = ("covariance_measured", "covariance_allowance")
# Fields of a result that documents do not have.
NOT_IN_FILES = ("motion_residuals", "recording", "parts")

# If a direction is unobservable, an axis is also unknown if its standard deviation (m) is larger
# than this.
UNKNOWN_M = 0.9

# An axis is unknown if it contains more than this share (a cosine) of an unobservable direction.
_SHARED = 0.02


@dataclass(frozen=True, kw_only=True)
class Notation:
    """A transform in the notations of documents: translation, quaternion, angles and matrix.

    ``maps`` names source and target. Each number (m, deg) has a standard deviation (``sigma``).
    ``sigma_measured`` is the part of this deviation without the allowance. ``sigma_about_deg`` has
    the standard deviations of the rotation about the axes x, y and z of the target. An unknown
    number is NaN with an infinite standard deviation. An unknown rotation has no quaternion.
    """

    maps: str
    translation: FloatArray
    sigma_translation: FloatArray
    sigma_measured_translation: FloatArray
    quat_xyzw: FloatArray | None
    rpy_deg: FloatArray
    sigma_rpy_deg: FloatArray
    sigma_measured_rpy_deg: FloatArray
    sigma_about_deg: FloatArray
    matrix: FloatArray


def document_of(result: Judged) -> Document:
    """Return the document of a result; see ``Calibration.to_dict``."""
    parent = result.parent_frame
    child = result.child_frame
    document: Document = {
        "verdict": result.verdict,
        "headline": result.headline,
        "reasons": [_reason_of(reason) for reason in result.reasons],
        "format": FORMAT,
        "version": VERSION,
        "parent_frame": parent,
        "child_frame": child,
        **transforms_of(result),
        "status": result.status,
        **_covariances_of(result),
        "sigma": dict(zip(AXES, result.sigmas, strict=True)),
        "observability": _observability_of(result),
    }
    if result.T_method is not None:
        of = (
            "T_parent_child as the method solved it, without priors and without values that "
            "replace unobservable directions"
        )
        document["T_method"] = {"of": of, "matrix": result.T_method}
    document["findings"] = [finding.to_dict() for finding in result.findings]
    others = {
        *TRANSFORMS,
        *COVARIANCES,
        *NOT_IN_FILES,
        "observability_measured",
    }
    for field in fields(result):
        if field.name not in others.union(document):
            document[field.name] = getattr(result, field.name)
    for extra in all_parts():
        document |= extra.write(result.parts.get(extra.name))
    return plain(document)


def _reason_of(reason: Reason) -> Document:
    """Return a reason in plain values; its options have the names that files use."""
    document: Document = plain(reason)
    document["what_to_do"] = document.pop("advice")
    return document


def _covariances_of(result: Result) -> Document:
    """Return the covariance of a result and its two parts, as fields of a document."""
    of = "error xi in T_parent_child @ exp(xi)"
    child = result.child_frame
    order = ["rho_x", "rho_y", "rho_z", "phi_x", "phi_y", "phi_z"]
    measured = f"{of}: the part that the recording shows"
    allowance = (
        f"{of}: the allowance for constant errors, which no recording shows"
    )
    return {
        "covariance": matrix_of(of, child, result.covariance)
        | {"order": order},
        "covariance_measured": matrix_of(
            measured, child, result.covariance_measured
        ),
        "covariance_allowance": matrix_of(
            allowance, child, result.covariance_allowance
        ),
    }


def _observability_of(result: Result) -> list[Document]:
    """Return a row for each axis: its standard deviation, and both parts of it."""
    rows = []
    columns = zip(
        result.observability,
        result.sigmas_measured,
        result.allowance,
        strict=True,
    )
    for dof, measured, allowance in columns:
        row = plain(dof) | {"sigma_measured": measured, "allowance": allowance}
        rows.append(row | {"frame": result.parent_frame})
    return rows


class _Transform(NamedTuple):
    """Transform of a result; it maps coordinates of ``source`` into ``target``.

    Attributes
    ----------
    covariances : (2, 6, 6) array-like
        Measured part and allowance.
    sigmas_m : (3,) array or None
        Measured standard deviations of the translation; None if the covariance contains them.
    is_extra : bool
        Whether the transform belongs to a part of the result.
    """

    T: FloatArray
    source: str
    target: str
    covariances: Sequence[FloatArray]
    sigmas_m: FloatArray | None = None
    is_extra: bool = False


def transforms_of(result: Result) -> dict[str, Notation]:
    """Return the transforms of a result by their names."""
    T = result.T_parent_child
    parent = result.parent_frame
    child = result.child_frame
    own = result.covariance_measured, result.covariance_allowance
    exchanged = [inverse_covariance(T, covariance) for covariance in own]
    sigmas_m = result.sigmas_measured[:3]
    # If the streams cannot determine the rotation, the sensors have the same axes by convention.
    has_same_axes = {*ROTATIONS} <= {*result.out_of_reach}
    sigmas_of_inverse_m = sigmas_m if has_same_axes else None
    transforms = {
        "T_parent_child": _Transform(T, child, parent, own, sigmas_m),
        "T_child_parent": _Transform(
            result.T_child_parent, parent, child, exchanged, sigmas_of_inverse_m
        ),
    }
    if result.T_base_child is not None:
        transforms["T_base_child"] = _Transform(
            result.T_base_child, child, result.base_frame, own
        )
    for name, extra in extra_transforms(result).items():
        covariances = extra.covariance, np.zeros((6, 6))
        transforms[name] = _Transform(
            extra.T_target_source,
            extra.source,
            extra.target,
            covariances,
            is_extra=True,
        )
    hidden = {*result.unobservable()}
    return {
        name: _notation(transform, hidden)
        for name, transform in transforms.items()
    }


def _notation(transform: _Transform, hidden: Collection[str]) -> Notation:
    """Return a transform in all notations; ``hidden`` are the unobservable axes of the result."""
    T = transform.T
    measured, allowance = transform.covariances
    R = se3.rotation_of(T)
    sigmas_m = transform.sigmas_m
    if sigmas_m is None:
        sigmas_m = sigmas_in_parent(R, measured)[:3]
        if hidden or transform.is_extra:
            sigmas_m = np.where(sigmas_m > UNKNOWN_M, np.inf, sigmas_m)
    is_rotation_known = not {*ROTATIONS} & {*hidden}
    sigmas = sigmas_rpy(T, measured)
    # Near gimbal lock, roll and yaw are known, but without a standard deviation.
    is_known = np.isfinite(sigmas) | is_rotation_known
    return Notation(
        maps=f"coordinates of {transform.source} into {transform.target}",
        translation=np.where(
            np.isfinite(sigmas_m), se3.translation_of(T), np.nan
        ),
        sigma_translation=np.hypot(
            sigmas_m, sigmas_in_parent(R, allowance)[:3]
        ),
        sigma_measured_translation=sigmas_m,
        quat_xyzw=se3.to_quat_xyzw(T) if is_rotation_known else None,
        rpy_deg=np.degrees(np.where(is_known, se3.rotation_to_rpy(R), np.nan)),
        sigma_rpy_deg=np.degrees(np.hypot(sigmas, sigmas_rpy(T, allowance))),
        sigma_measured_rpy_deg=np.degrees(sigmas),
        sigma_about_deg=np.degrees(
            np.hypot(
                sigmas_in_parent(R, measured)[3:],
                sigmas_in_parent(R, allowance)[3:],
            )
        ),
        matrix=T,
    )


def extra_transforms(result: Result) -> dict[str, ExtraTransform]:
    """Return the transforms of the parts of a result by their names."""
    transforms: dict[str, ExtraTransform] = {}
    for name, value in result.parts.items():
        transforms |= part(name).transforms(value)
    return transforms


def matrix_of(of: str, frame: str, matrix: FloatArray) -> Document:
    """Return a covariance as a field of a document; ``of`` names its error."""
    return {"of": of, "frame": frame, "units": "m, rad", "matrix": matrix}


def _inliers_in_words(result: Result) -> dict[str, str]:
    """Return the number of inliers as text, with its name; empty for stops, which have a table."""
    if result.reference == "stops":
        return {}
    counts = f"{result.n_inliers:,} of {result.n_pairs:,}"
    return {"Motion pairs": f"{counts} are inliers"}


def summary(result: Result) -> dict[str, str]:
    """Return quantities of the solve with their values as text."""
    rate = result.clock_rate
    proofs = {"yes": "proved", "no": "not proved"}
    offset = result.time_offset_s
    method = f"{result.method} ({result.backend})"
    if result.method_reason:
        method += f"; {result.method_reason}"
    rows = {
        "Method": method,
        "Reference": result.reference_reason or result.reference,
        "Poses": f"{result.n_poses:,}",
        **_inliers_in_words(result),
        "Objective": f"{result.objective:.6g}",
        "Time offset": given_or_estimated(
            offset, result.time_offset_sigma_s, "s"
        ),
        "Scale": given_or_estimated(result.scale, result.scale_sigma, ""),
    }
    if result.proved_global in proofs:
        proof = proofs[result.proved_global]
        rows["Objective"] += f", {proof} to be the global minimum"
    if rate and rate.is_used:
        rows["Time offset"] += (
            f" at {rate.at_ns * 1e-9:.3f} s; the child's clock is {rate}"
        )
    if result.noise:
        # In documents, the first sentence begins with the name of this row.
        sentences = [
            text.removeprefix("Noise: ").rstrip(".")
            for text in result.noise.in_words
        ]
        rows["Noise"] = "; ".join(sentences)
    return rows


def printed_numbers(
    transform: Notation, out_of_reach: Collection[str], sign: str = "+/-"
) -> dict[str, str]:
    """Return the printed numbers of a transform by axis, with their standard deviations.

    The axes are x, y, z (m), roll, pitch and yaw (deg). If the streams cannot determine the
    translation or the rotation, its three axes share one text under their joint name.
    """
    texts = {}
    for axes, values, sigmas, unit in (
        (TRANSLATIONS, transform.translation, transform.sigma_translation, "m"),
        (ROTATIONS, transform.rpy_deg, transform.sigma_rpy_deg, "deg"),
    ):
        if {*axes} <= {*out_of_reach}:
            texts[listing(axes)] = "not estimated"
            continue
        for axis, value, sigma in zip(
            axes, values.tolist(), sigmas.tolist(), strict=True
        ):
            if not np.isfinite(value):
                texts[axis] = "unknown"
            elif not np.isfinite(sigma):  # near gimbal lock
                texts[axis] = f"{fixed(value, 2)} {unit}"
            else:
                decimals = 3 if unit == "m" else 2
                number = with_sigma(value, sigma, decimals)
                texts[axis] = f"{number.replace('+/-', sign)} {unit}"
    return texts


def parts_of_sigmas(transform: Notation) -> dict[str, str]:
    """Return both parts of each standard deviation, measured and allowance, in words by axis.

    An example is "4 mm measured, 8 mm allowance". Axes with a negligible allowance and unknown axes
    are left out.
    """
    sigmas = np.r_[
        transform.sigma_translation, np.radians(transform.sigma_rpy_deg)
    ]
    measured = np.r_[
        transform.sigma_measured_translation,
        np.radians(transform.sigma_measured_rpy_deg),
    ]
    parts = {}
    for axis, sigma, sigma_measured in zip(
        AXES, sigmas.tolist(), measured.tolist(), strict=True
    ):
        if not math.isfinite(sigma):
            continue
        allowance = math.sqrt(max(sigma**2 - sigma_measured**2, 0.0))
        if allowance > _NEGLIGIBLE_SHARE * sigma:
            recorded = amount(axis, sigma_measured)
            parts[axis] = (
                f"{recorded} measured, {amount(axis, allowance)} allowance"
            )
    return parts


def angles_in_words(transform: Notation, result: Result) -> str:
    """Explain why angles are less or more certain than the rotation; empty if they are not.

    Near a pitch of 90 deg, a small rotation changes both roll and yaw by much. The three angles are
    applied one after the other about fixed axes, so their standard deviations may differ from those
    about the axes of the target. Unknown axes are ignored.
    """
    sigmas_deg = np.asarray(transform.sigma_rpy_deg)
    # Near a pitch of 90 deg, angles may be unknown although the rotation is known.
    are_known = np.isfinite(result.sigmas[3:])
    if not are_known.all():
        are_known &= np.isfinite(sigmas_deg)
    if not are_known.any():
        return ""
    about_deg = np.asarray(transform.sigma_about_deg)[are_known]
    rotation_deg = float(about_deg.max())
    # If the digits of the angles and of the rotation are equal, no explanation is needed.
    excess_deg = float(sigmas_deg[are_known].max()) - rotation_deg
    if not round(excess_deg, 1) > 0.0:
        return _about_axes_in_words(transform, are_known, result)
    if not np.isfinite(transform.rpy_deg).all():
        return ""
    return (
        f"roll and yaw vary together at pitch {transform.rpy_deg[1]:.0f} deg; the rotation itself "
        f"is good to {amount('roll', math.radians(rotation_deg))}"
    )


def _differs_from_headline(transform: Notation, result: Result) -> bool:
    """Return whether the rotation sigma of the headline differs from those of the angles.

    The headline has the largest standard deviation about the parent's axes. Other transforms have
    other axes, and are not compared.
    """
    about_rad = np.radians(transform.sigma_about_deg)
    angles_rad = np.radians(transform.sigma_rpy_deg)
    are_of_headline = np.allclose(about_rad, result.sigmas[3:], equal_nan=True)
    if not are_of_headline or not np.isfinite([about_rad, angles_rad]).all():
        return False
    printed = [
        amount("roll", float(sigmas.max()))
        for sigmas in (about_rad, angles_rad)
    ]
    return printed[0] != printed[1]


def _about_axes_in_words(
    transform: Notation, are_known: BoolArray, result: Result
) -> str:
    """Return the standard deviations about x, y and z, if they differ from those of the angles.

    ``are_known`` (3,) marks the determined axes. The others are left out.
    """
    about_deg = np.asarray(transform.sigma_about_deg)
    are_known = are_known & np.isfinite(about_deg)
    ratios = (
        np.asarray(transform.sigma_rpy_deg)[are_known] / about_deg[are_known]
    )
    if not len(ratios) or not np.isfinite(ratios).all():
        return ""
    is_same = np.abs(np.log(ratios)).max() < _SAME_ANGLES
    if is_same and not _differs_from_headline(transform, result):
        return ""
    axes = np.array(TRANSLATIONS)[are_known].tolist()
    sizes = [
        amount("roll", math.radians(sigma))
        for sigma in about_deg[are_known].tolist()
    ]
    word = "axes" if len(axes) > 1 else "axis"
    if len({*sizes}) == 1:
        sizes = sizes[:1]
    return (
        f"roll, pitch and yaw are turns one after the other; about the {word} {listing(axes)} "
        f"the rotation is good to {listing(sizes)}"
    )


def allowance_in_words(result: Result) -> str:
    """Explain the allowance in the standard deviations; empty without an allowance."""
    is_known = np.isfinite(result.sigmas)
    if not result.allowance[is_known].any():
        return ""
    cause = cause_of_allowance(result)
    options = kinds_to_declare(result)
    if not options:
        return f"the allowance is for {cause}, which this recording does not exclude"
    return (
        f"the allowance is for {cause}, which no recording reveals; a sensor without them, such as "
        f"motion capture, needs {' or '.join(options)}"
    )


# ------------------------------------------------------------------------ for robots


def usable_numbers(result: Judged) -> dict[str, float | str]:
    """Return the numbers of a result's ``mounting`` for files and commands of other programs.

    Returns
    -------
    dict
        x, y, z (m) and qx, qy, qz, qw. If an angle is unknown, roll, pitch and yaw (rad) replace
        the quaternion. The value of an unknown axis is a text that every parser refuses, such as
        MEASURE_Z_BY_HAND. The dict is empty if the verdict is DO NOT USE.
    """
    if result.verdict is Verdict.DO_NOT_USE:
        return {}
    T = result.mounting[1]
    unknown = {*result.unobservable()}
    hidden = np.array([axis in unknown for axis in TRANSLATIONS])
    if result.T_base_parent is not None:
        # An axis of the base is unknown if it has a component along an unknown axis of the parent.
        components = np.abs(se3.rotation_of(result.T_base_parent)[:, hidden])
        hidden = components.max(axis=1, initial=0.0) > _SHARED
    numbers: dict[str, float | str] = {
        axis: by_hand(axis) if is_hidden else float(value)
        for axis, value, is_hidden in zip(
            TRANSLATIONS, se3.translation_of(T), hidden, strict=True
        )
    }
    if unknown.intersection(ROTATIONS):
        return numbers | usable_angles(result)
    return numbers | dict(
        zip(("qx", "qy", "qz", "qw"), se3.to_quat_xyzw(T), strict=True)
    )


def transform_arguments(result: Judged, decimals: int) -> list[str]:
    """Return the arguments of static_transform_publisher for a result's ``mounting``.

    The list is empty if the verdict is DO NOT USE.
    """
    arguments: list[str] = []
    for name, value in usable_numbers(result).items():
        arguments += [
            f"--{name}",
            value if isinstance(value, str) else fixed(value, decimals),
        ]
    if arguments:
        arguments += [
            "--frame-id",
            result.mounting[0],
            "--child-frame-id",
            result.child_frame,
        ]
    return arguments


def usable_angles(result: Result) -> dict[str, float | str]:
    """Return roll, pitch and yaw of a result's ``mounting``, rad, about fixed axes, as in URDF.

    The value of an unknown angle is a text that every parser refuses.
    """
    T = result.mounting[1]
    # Near gimbal lock, roll and yaw are known, but without a standard deviation.
    are_known = np.full(3, True)
    if set(result.unobservable()).intersection(ROTATIONS):
        are_known = np.isfinite(sigmas_rpy(T, result.covariance_measured))
    angles = se3.rotation_to_rpy(se3.rotation_of(T)).tolist()
    return {
        name: angle if is_known else by_hand(name)
        for name, angle, is_known in zip(
            ROTATIONS, angles, are_known, strict=True
        )
    }
