"""``report.html``: one self-contained page with the extrinsic, its uncertainty and the evidence."""

import math
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from hand_eye_calib.assessment.excitation import what_is_missing
from hand_eye_calib.checks.streams import summarise
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.evidence import Evidence
from hand_eye_calib.errors import printable
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.report.captions import TITLES, captions
from hand_eye_calib.report.report_figures import draw_all
from hand_eye_calib.results.calibration import Calibration, DofVerdict, Reason, Verdict
from hand_eye_calib.results.records import Noise
from hand_eye_calib.results.status import ROTATIONS, TRANSLATIONS
from hand_eye_calib.results.verdict import shown, target_of
from hand_eye_calib.text import (
    amount,
    angle,
    counted,
    duration,
    fixed,
    given_or_estimated,
    in_words,
    length,
    listing,
    with_sigma,
)

Plain = Mapping[str, Any]

_WORDS = {
    DofVerdict.OBSERVED: "determined by the motion",
    DofVerdict.WEAK: "determined, but not well",
    DofVerdict.UNOBSERVABLE: "do not use this value",
    DofVerdict.PRIOR: "mostly from the prior",
}
_AXIS_NAMES = {"roll": "about x (roll)", "pitch": "about y (pitch)", "yaw": "about z (yaw)"}

# A bar reaches from a thousandth of the target to ten times the target, by its logarithm.
_BAR_DECADES, _BAR_ABOVE = 4.0, 1.0

_REFUSED = {"refused_duplicate": "with a repeated stamp", "refused_late": "late arrivals"}


def render(
    calibration: Calibration,
    config: CalibratorConfig,
    evidence: Evidence,
    *,
    inputs: Plain | None = None,
    command: str = "",
) -> str:
    """The report as HTML.

    Parameters
    ----------
    calibration : Calibration
    config : CalibratorConfig
        The options that gave it.
    evidence : Evidence
        See :func:`~hand_eye_calib.engine.evidence.gather`.
    inputs : mapping, optional
        Where the data came from, in plain values.
    command : str
        Shell command that publishes the result; empty for none.

    Returns
    -------
    str
    """
    inputs = inputs or {}
    parent, child = printable(calibration.parent_frame), printable(calibration.child_frame)
    return (
        environment()
        .get_template("report.html")
        .render(
            **_result(calibration),
            rotating=child if evidence.has_positions_of_parent else parent,
            advice=_advice(calibration, evidence),
            command=command,
            figures=_figures(calibration, evidence),
            findings=calibration.findings,
            summary=_summary(calibration, evidence),
            streams=[_stream(name, inputs, evidence.as_read) for name in ("parent", "child")],
            reasons=[_reason(reason) for reason in shown(calibration.reasons)],
            unknown=_by_hand(calibration),
            target=_targets(calibration),
            provenance=_provenance(inputs),
            options={name: value for name, value in config.to_options().items() if value != ""},
        )
    )


def _targets(calibration: Calibration) -> str:
    """Target of x, y and z, of the rotations, and of the axes that have their own."""
    single = [f"{axis} {amount(axis, value)}" for axis, value in calibration.target_axes.items()]
    common = amount("x", calibration.target_translation), amount("yaw", calibration.target_rotation)
    return listing([*common, *single])


def _result(calibration: Calibration) -> dict[str, Any]:
    """What the page says of the result alone."""
    document = calibration.to_dict()
    return {
        "calibration": calibration,
        "parent": printable(calibration.parent_frame),
        "child": printable(calibration.child_frame),
        "document": document,
        **verdict_of(calibration),
        "kind": _kind(calibration),
        "directions": [
            _direction(document[key], calibration) for key in ("T_parent_child", "T_child_parent")
        ],
        "axes": _axes(calibration),
        "differences": _differences(calibration),
    }


def _figures(calibration: Calibration, evidence: Evidence) -> list[dict[str, Any]]:
    svgs = draw_all(calibration, evidence)
    texts = captions(calibration, evidence)
    return [
        {"name": name, "title": TITLES[name], "said": said, "svg": svgs.get(name)}
        for name, said in texts.items()
    ]


def environment() -> jinja2.Environment:
    """The templates of pages, and what they may use."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["number"] = fixed
    made.filters["in_words"] = in_words
    made.filters["printable"] = printable
    return made


# ---------------------------------------------------------------- the verdict


_LOOKS = {
    Verdict.USE: ("✓", "good"),
    Verdict.USE_WITH_CARE: ("!", "warn"),
    Verdict.DO_NOT_USE: ("✗", "bad"),
}


def verdict_of(calibration: Calibration) -> dict[str, str]:
    """Verdict, what it says in a sentence, a mark and a tone for it."""
    mark, tone = _LOOKS[calibration.verdict]
    verdict, _, said = calibration.headline.partition(": ")
    return {"mark": mark, "tone": tone, "verdict": verdict, "said": f"{said[:1].upper()}{said[1:]}"}


def _reason(reason: Reason) -> dict[str, str]:
    options = ", ".join(f"{name} {value}" for name, value in reason.options.items())
    what_to_do = f"{reason.what_to_do}: {options}" if options else reason.what_to_do
    return {"sentence": reason.sentence, "what_to_do": what_to_do}


def _advice(calibration: Calibration, evidence: Evidence) -> str:
    """The motion that would help, if the result is one to improve."""
    if calibration.verdict is Verdict.DO_NOT_USE:
        return ""
    return what_is_missing(evidence.excitation, calibration)


def _by_hand(calibration: Calibration) -> str:
    """Words of the command that stand for axes to be measured."""
    words = [value for value in calibration.usable_numbers().values() if isinstance(value, str)]
    return listing(words)


def _kind(calibration: Calibration) -> str:
    """What the result is, in a word."""
    unknown = {*calibration.out_of_reach}
    return "Position" if unknown & {*ROTATIONS} else "Orientation" if unknown else "Pose"


def _direction(transform: Plain, calibration: Calibration) -> dict[str, Any]:
    """A transform as rows: each printed number with its standard deviation."""
    unknown = {*calibration.out_of_reach}
    rows = [
        {"name": name, "value": with_sigma(value, sigma, 3), "unit": " m"}
        for name, value, sigma in zip(
            "xyz", transform["translation"], transform["sigma_translation"], strict=True
        )
    ]
    is_locked = "rotation_vector_deg" in transform
    kind = "rotation_vector" if is_locked else "rpy"
    names = ("rx", "ry", "rz") if is_locked else ("roll", "pitch", "yaw")
    angles = zip(names, transform[f"{kind}_deg"], transform[f"sigma_{kind}_deg"], strict=True)
    turned = [
        {"name": name, "value": with_sigma(value, sigma, 2), "unit": "°"}
        for name, value, sigma in angles
    ]
    none = {"value": "not shown by these streams", "unit": ""}
    if unknown & {*TRANSLATIONS}:
        rows = [none | {"name": "x, y, z"}]
    if unknown & {*ROTATIONS}:
        turned = [none | {"name": "roll, pitch, yaw"}]
    return {
        "maps": printable(transform["maps"]),
        "rows": [row | {"value": row["value"].replace("+/-", "±")} for row in rows + turned],
        "quat_xyzw": transform["quat_xyzw"],
        "is_locked": is_locked,
    }


def _axes(calibration: Calibration) -> list[dict[str, Any]]:
    """Rows of the table of uncertainties, along and about the parent's axes."""
    rows = []
    for dof in calibration.observability:
        limit = target_of(dof.name, calibration)
        if dof.name in calibration.out_of_reach:
            continue
        rows.append(
            {
                "name": dof.name,
                "title": _AXIS_NAMES.get(dof.name, f"along {dof.name}"),
                "sigma": amount(dof.name, dof.sigma) if np.isfinite(dof.sigma) else "unknown",
                "verdict": dof.verdict.value,
                "words": _WORDS[dof.verdict],
                "bar": _bar(dof.sigma / limit),
            }
        )
    return rows


def _differences(calibration: Calibration) -> list[dict[str, str]]:
    """Rows of the comparison with what is installed; none without one."""
    if not calibration.comparison:
        return []
    (difference,) = calibration.comparison.differences
    return [
        {
            "title": _AXIS_NAMES.get(axis, f"along {axis}"),
            "difference": _known(axis, row.difference) + f" ± {_known(axis, row.sigma)}",
            "visible": _known(axis, row.visible),
            "verdict": row.verdict,
        }
        for axis, row in difference.axes.items()
    ]


def _known(axis: str, value: float | None) -> str:
    return "unknown" if value is None else amount(axis, value)


def _bar(ratio: float) -> float:
    """Length in per cent of the bar for a standard deviation, from its ratio to the target."""
    if not ratio > 0:
        return 1.0
    if not np.isfinite(ratio):
        return 100.0
    return float(np.clip(100 * (1 - (_BAR_ABOVE - math.log10(ratio)) / _BAR_DECADES), 1, 100))


# ---------------------------------------------------------------- data and provenance


def _summary(calibration: Calibration, evidence: Evidence) -> dict[str, str]:
    """What was solved, as names and values."""
    offset = (calibration.time_offset_s, calibration.time_offset_sigma_s)
    scale = (calibration.scale, calibration.scale_sigma)
    span = duration(evidence.tracks.times_s[-1])
    method = f"{calibration.method} ({calibration.backend})"
    if calibration.method_reason:
        method += f"; {calibration.method_reason}"
    rows = {
        "Method": method,
        "Reference": calibration.reference_reason or calibration.reference,
        "Poses": f"{calibration.n_poses:,} synchronised pose pairs over {span}",
        "Motion pairs": f"{calibration.n_inliers:,} of {calibration.n_pairs:,} are inliers",
        "Objective": f"{calibration.objective:.6g}",
        "Time offset": given_or_estimated(*offset, "s"),
        "Scale": given_or_estimated(*scale, ""),
    }
    if noise := calibration.noise:
        is_whole = calibration.measured == "poses"
        rows["Noise"] = _noise(noise) if is_whole else "; ".join(noise.in_words)
    return rows


def _noise(noise: Noise) -> str:
    def levels(kind: str, suffix: str) -> str:
        translation = length(getattr(noise, f"translation_{kind}_m{suffix}"))
        return f"{translation} and {angle(getattr(noise, f'rotation_{kind}_rad{suffix}'))}"

    jumps = counted(len(noise.jumps_before_stamp_ns), "jump")
    return (
        f"{levels('white', '')} per pose and axis; growing by {levels('drift', '_per_pose')} from "
        f"pose to pose; systematic error: {noise.systematic}; {jumps}"
    )


def _stream(name: str, inputs: Plain, streams: Mapping[str, Trajectory]) -> dict[str, str]:
    """Where a stream came from, how many poses, their rate, the longest gap, the path length."""
    known = dict(inputs.get(name, {}))
    count = known.get("messages", known.get("poses"))
    first_ns, last_ns = known.get("first_stamp_ns"), known.get("last_stamp_ns")
    span_s = None if first_ns is None or last_ns is None else (last_ns - first_ns) * 1e-9
    refused = [f"{known[key]:,} {words}" for key, words in _REFUSED.items() if known.get(key)]
    row = {
        "name": name,
        "source": known.get("topic") or Path(known.get("file", "-")).name,
        "poses": "-" if count is None else f"{count:,}",
        "rate": f"{(count - 1) / span_s:.1f} Hz" if count and count > 1 and span_s else "-",
        "duration": "-" if span_s is None else duration(span_s),
        "gap": "-",
        "path": "-",
        "refused": "; ".join(refused) or "none",
    }
    stream = streams.get(name)
    # In a very long recording only the newest poses are at hand: of the stream as a whole they say
    # nothing.
    if stream is not None and len(stream) >= max(2, count or 0):
        row |= _of_whole(stream)
    return row


def _of_whole(stream: Trajectory) -> dict[str, str]:
    whole = summarise(stream)
    return {
        "gap": f"{whole.longest_interval_s:.2f} s",
        "path": "-" if whole.path_m is None else length(whole.path_m),
        "duration": duration(whole.duration_s),
        "poses": f"{whole.poses:,}",
        "rate": f"{whole.rate_hz:.1f} Hz",
    }


def _provenance(inputs: Plain) -> list[tuple[str, str]]:
    """Versions, files and the rest of the inputs, as names and values."""
    versions = {name: _version(name) for name in ("hand_eye_calib", "numpy", "scipy")}
    rows = [
        ("Written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")),
        ("Versions", in_words(versions | {"python": platform.python_version()})),
    ]
    # Without folders, which are nobody's business who gets this page; extrinsic.yaml has them.
    rows += [
        (name.capitalize(), in_words(_without_folders(value)))
        for name, value in inputs.items()
        if name not in ("parent", "child", "options", "files")
    ]
    rows += [
        (
            f"File {Path(file['file']).name}",
            f"{file['bytes']:,} bytes, SHA-256 {file['sha256']}",
        )
        for file in inputs.get("files", ())
    ]
    return rows


def _without_folders(value: Any) -> Any:
    """A path, or paths in a list or mapping, as names alone; anything else as it is."""
    if isinstance(value, Mapping):
        return {name: _without_folders(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_folders(item) for item in value]
    is_path = isinstance(value, str) and (value.startswith(("/", "~", "./", "../")))
    return Path(value).name if is_path and Path(value).exists() else value


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"
