"""``report.html``: one self-contained page that says how the sensors are mounted, how sure that is,
and why.
"""

import math
import platform
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import jinja2
import numpy as np

from hand_eye_calib.assessment.covariance import AXES, WEAK_ROTATION, WEAK_TRANSLATION
from hand_eye_calib.assessment.excitation import what_is_missing
from hand_eye_calib.assessment.metrics import deviation
from hand_eye_calib.calibration import DofVerdict, SolveStatus
from hand_eye_calib.checks.streams import summarise
from hand_eye_calib.methods import METHODS
from hand_eye_calib.report.report_figures import draw_all, time_axis

_TITLES = {
    "trajectories": "Both trajectories, brought together",
    "residuals": "Residuals over time",
    "convergence": "Convergence",
    "excitation": "Excitation",
    "methods": "Other methods and references",
    "halves": "The two halves of the drive",
    "streams": "Both streams before any solve",
}
_WORDS = {
    DofVerdict.OBSERVED: "the motion reveals it",
    DofVerdict.WEAK: "revealed, but not well",
    DofVerdict.UNOBSERVABLE: "do not use this value",
    DofVerdict.PRIOR: "mostly what was given beforehand",
}

# A bar reaches from a thousandth of the limit beyond which an axis is weak to ten times that, by
# its logarithm.
_BAR_DECADES, _BAR_ABOVE = 4.0, 1.0

# Two answers disagree when they are this many standard deviations apart.
_DISAGREE = 3.0

# A drive is long enough when from its first part on the answer stays within this many standard
# deviations of the result.
_SETTLED = 3.0


def render(calibration, config, evidence, *, inputs=None, findings=(), command=""):
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
    findings : sequence of dict
        What the stream checks found.
    command : str
        Shell command that publishes the result.

    Returns
    -------
    str
    """
    svgs = draw_all(calibration, evidence)
    said = {name: _SENTENCES[name](calibration, evidence) for name in _TITLES}
    document = calibration.to_dict()
    return (
        environment()
        .get_template("report.html")
        .render(
            calibration=calibration,
            document=document,
            verdict=_verdict(calibration),
            badge=_badge(calibration),
            directions=[document["T_parent_child"], document["T_child_parent"]],
            axes=_axes(calibration),
            advice=what_is_missing(evidence.excitation, calibration),
            command=command,
            figures=[
                {"name": name, "title": title, "said": said[name], "svg": svgs.get(name)}
                for name, title in _TITLES.items()
            ],
            findings=list(findings),
            summary=_summary(calibration, evidence),
            streams=_streams(inputs or {}, evidence.as_read),
            provenance=_provenance(inputs or {}),
            options={name: value for name, value in config.to_options().items() if value != ""},
        )
    )


def environment():
    """Where the templates of pages are found, and what they may use."""
    made = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["number"] = _fixed
    made.filters["plain"] = _plain
    return made


def _fixed(value, digits=4):
    """With so many decimals, and no minus before a zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"


def _plain(value):
    """A value of the provenance as text."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {_plain(item)}" for name, item in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(_plain(item) for item in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return "-" if value in ("", None) else str(value)


# ---------------------------------------------------------------- the verdict


def _badge(calibration):
    """A mark, the status in a word or two, and a tone for them."""
    if calibration.status is not SolveStatus.OK:
        return {"mark": "✗", "text": calibration.status.value.replace("_", " "), "tone": "bad"}
    if weak := [dof.name for dof in calibration.observability if dof.verdict is DofVerdict.WEAK]:
        return {"mark": "!", "text": f"ok, but {_list(weak)} weak", "tone": "warn"}
    return {"mark": "✓", "text": "ok", "tone": "good"}


def _verdict(calibration):
    """What to think of the result, in a sentence."""
    if calibration.status is SolveStatus.NOT_CONVERGED:
        return "The solver did not converge. Do not use this result."
    known = [dof for dof in calibration.observability if np.isfinite(dof.sigma)]
    worst = [max((dof for dof in known if (dof.name in "xyz") is is_length), key=lambda dof: dof.sigma, default=None)
             for is_length in (True, False)]  # fmt: skip
    limits = " and ".join(f"{_size(dof.sigma, dof.name)} ({dof.name})" for dof in worst if dof)
    hidden, weak = (
        calibration.unobservable(),
        [dof.name for dof in known if dof.verdict is DofVerdict.WEAK],
    )
    if len(hidden) == 6:
        return "This drive reveals nothing of how the sensors are mounted."
    if hidden:
        return f"This drive does not reveal {_list(hidden)}. The other axes are known to {limits} or better, one standard deviation."
    if weak:
        return f"All six axes are known, but {_list(weak)} only weakly: to {limits} or better, one standard deviation."
    return f"All six axes are known, to {limits} or better, one standard deviation."


def _axes(calibration):
    """Rows of the table of uncertainties."""
    transform = calibration.to_dict()["T_parent_child"]
    values = [f"{_fixed(100 * value, 2)} cm" for value in transform["translation"]]
    values += [f"{_fixed(value, 3)}°" for value in transform["rpy_deg"]]
    rows = []
    for dof, value in zip(calibration.observability, values, strict=True):
        limit = WEAK_TRANSLATION if dof.name in "xyz" else WEAK_ROTATION
        rows.append(
            {
                "name": dof.name,
                "value": value,
                "sigma": _size(dof.sigma, dof.name) if np.isfinite(dof.sigma) else "unknown",
                "verdict": dof.verdict.value,
                "words": _WORDS[dof.verdict],
                "bar": _bar(dof.sigma / limit),
            }
        )
    return rows


def _bar(ratio):
    """Length in per cent of a bar for a standard deviation, given as a multiple of the weak limit."""
    if not ratio > 0:
        return 1.0
    if not np.isfinite(ratio):
        return 100.0
    return float(np.clip(100 * (1 - (_BAR_ABOVE - math.log10(ratio)) / _BAR_DECADES), 1, 100))


# ---------------------------------------------------------------- what there is to see in each figure


def _said_of_trajectories(calibration, evidence):
    tracks = evidence.tracks
    apart = np.linalg.norm(tracks.parent - tracks.child, axis=1)
    farthest = int(np.argmax(apart))
    way = np.linalg.norm(np.diff(tracks.parent, axis=0), axis=1).sum()
    factor, unit = time_axis(tracks.times_s[-1])
    return (
        f"The way of {calibration.parent_frame} over {_length(way)}, and the same way from {calibration.child_frame}'s poses through "
        f"the result: half of the time they are within {_length(np.median(apart))} of each other, and never more than {_length(apart[farthest])} apart "
        f"(at {tracks.times_s[farthest] * factor:.1f} {unit}). Drift and jumps of the two odometries are part of that."
    )


def _said_of_residuals(calibration, evidence):
    residuals = evidence.residuals
    out = int(residuals.is_outlier.sum())
    middle = f"{_size(np.median(residuals.translation_m), 'x')} and {_size(np.median(residuals.rotation_rad), 'yaw')}"
    text = f"Half of the {len(residuals.times_s):,} motion pairs ({residuals.reference}) agree with the result to {middle}"
    if not out:
        worst = f"{_size(residuals.translation_m.max(), 'x')} and {_size(residuals.rotation_rad.max(), 'yaw')}"
        return f"{text}, all of them to {worst}; none was left out."
    largest = int(np.argmax(np.where(residuals.is_outlier, residuals.translation_m, -1)))
    factor, unit = time_axis(evidence.tracks.times_s[-1])
    return (
        f"{text}; {out:,} ({_share(out / len(residuals.times_s))}) were left out as outliers, the largest of them "
        f"{_size(residuals.translation_m[largest], 'x')} at {residuals.times_s[largest] * factor:.1f} {unit}."
    )


def _said_of_convergence(calibration, evidence):
    estimates = evidence.convergence
    if len(estimates) < 3:
        return "The drive is too short to be looked at in parts."
    known = np.isfinite(calibration.sigmas)
    moved = np.array(
        [deviation(one.calibration.T_parent_child, calibration.T_parent_child) for one in estimates]
    )[:, known]
    spread = np.array([one.calibration.sigmas for one in estimates])[:, known]
    if not known.any():
        return "No axis is revealed, however much of the drive is used."
    names = [name for name, is_known in zip(AXES, known, strict=True) if is_known]
    near = (np.abs(moved) <= _SETTLED * np.where(np.isfinite(spread), spread, 0)).all(axis=1)
    first = len(near) - int(np.argmin(near[::-1])) if not near.all() else 0
    factor, unit = time_axis(estimates[-1].until_s)
    late = estimates[max(len(estimates) * 7 // 10 - 1, 0)]
    change = _worst(deviation(late.calibration.T_parent_child, calibration.T_parent_child), known)
    last = f"The last {1 - late.until_s / estimates[-1].until_s:.0%} of the drive changed the answer by {change}."
    if first == len(near) - 1:
        return (
            f"The answer had not settled within its own uncertainty before the end ({_list(names)}): drive longer. {last} "
            f"Shaded: one standard deviation.{_thinned(estimates)}"
        )
    return (
        f"From {estimates[first].until_s * factor:.1f} {unit} of driving on, the answer stays within {_SETTLED:g} of its own standard "
        f"deviations (shaded: one) of the final one. {last}{_thinned(estimates)}"
    )


def _said_of_excitation(calibration, evidence):
    seen, turning = evidence.excitation, evidence.turning
    if not len(turning.times_s):
        return "The poses are too far apart to show how the body turned."
    over = np.degrees(np.percentile(np.abs(turning.vectors), 95, axis=0))
    turned = _list([f"{angle:.1f}° in {name}" for angle, name in zip(over, AXES[3:], strict=True)])
    least = "xyz"[int(np.argmax(np.abs(seen.worst)))]
    return (
        f"Within {turning.span_s:.1f} s the body turned by up to {turned} (95 % of the time less). An offset along {least} shows "
        f"least: 1 cm of it moves a motion by {seen.worst_gain:.2g} cm where 1 cm along the axis that shows best moves it by "
        f"{seen.gain.max():.2g} cm. Inside the grey band turning reveals little of a lever."
    )


def _said_of_methods(calibration, evidence):
    if not evidence.comparison:
        return "The drive is too short to compare methods."
    known = np.isfinite(calibration.sigmas)
    if not known.any():
        return "No axis is revealed, so there is nothing to compare."
    # What a method itself calls unobservable is not held against it.
    robust, others = {}, {}
    for one in evidence.comparison:
        group = robust if METHODS[one.calibration.method].rejects_outliers else others
        group[one.label] = np.where(
            np.isfinite(one.calibration.sigmas),
            deviation(one.calibration.T_parent_child, calibration.T_parent_child),
            0.0,
        )
    texts = []
    if robust:
        worst = np.max(np.abs(list(robust.values())), axis=0)
        texts.append(
            f"The methods that reject outliers (dnlo, adaptive) differ from the result by at most {_worst(worst, known)}"
        )
    if others:
        label = max(others, key=lambda name: _distance(others[name], known))
        texts.append(
            f"those that use every pair (dnl, park) by {_worst(others[label], known)} ({label})"
        )
    return (
        "; ".join(texts)
        + ". B<n> compares with the n-th pose before. Bars: one standard deviation; triangles lie beyond the axis; shaded: the result's own."
    )


def _said_of_halves(calibration, evidence):
    if len(evidence.halves) < 2:
        return "The drive is too short to be cut in halves."
    first, second = (half.calibration for half in evidence.halves)
    known = np.isfinite(first.sigmas) & np.isfinite(second.sigmas)
    if not known.any():
        return "The halves reveal no axis in common."
    apart = deviation(first.T_parent_child, second.T_parent_child)
    ratio = np.abs(apart[known]) / np.maximum(np.hypot(first.sigmas, second.sigmas)[known], 1e-12)
    worst = int(np.argmax(ratio))
    name = np.array(AXES)[known][worst]
    judged = (
        f"more than chance: {name} lies {ratio[worst]:.1f} of their standard deviations apart, so trust the result no further than that"
        if ratio[worst] > _DISAGREE
        else f"no more than chance: the farthest, {name}, lies {ratio[worst]:.1f} of their standard deviations apart"
    )
    less = [
        name
        for name, is_known in zip(AXES, known | ~np.isfinite(calibration.sigmas), strict=True)
        if not is_known
    ]
    missing = f" {_list(less)} is not revealed by half of the drive." if less else ""
    return f"From each half alone, without priors: they differ by {_worst(apart, known)}, {judged}.{missing}{_thinned(evidence.halves)}"


def said_of_streams(seen):
    """What there is to see in the picture of both streams, in words."""
    text = (
        "Two sensors on one rigid body turn equally fast at every moment; each motion turns both by the same angle and moves both equally far "
        "along the axis it turns about, however they are mounted. So the two curves must be one, and the dots must lie on the line (on flat ground, where nothing moves along the axis, near zero). "
    )
    if not len(seen.angles):
        return text + "Here the streams have 0 motions in common, and there is nothing to compare."
    apart = np.abs(np.diff(seen.angles, axis=1))
    text += f"Here half of the {len(seen.angles)} motions over {seen.lag_s:g} s differ by less than {_size(np.median(apart), 'yaw')}"
    if len(seen.slides):
        text += f" and {_size(np.median(np.abs(np.diff(seen.slides, axis=1))), 'x')}"
    gaps = [len(spans) - 1 for spans in seen.spans_s]
    return f"{text}. The bars below the curves show when there are poses: {gaps[0]} gaps in the parent's stream, {gaps[1]} in the child's."


_SENTENCES = {
    "trajectories": _said_of_trajectories,
    "residuals": _said_of_residuals,
    "convergence": _said_of_convergence,
    "excitation": _said_of_excitation,
    "methods": _said_of_methods,
    "halves": _said_of_halves,
    "streams": lambda calibration, evidence: said_of_streams(evidence.streams),
}


def _thinned(estimates):
    """A remark where not all poses were used."""
    stride = max(one.stride for one in estimates)
    return (
        f" To save time the parts were solved with as few as one pose in {stride}, and are less sure for that."
        if stride > 1
        else ""
    )


def _worst(difference, known):
    """The largest translation and rotation among the known axes."""
    texts = []
    for columns in (slice(0, 3), slice(3, 6)):
        values = np.where(known[columns], np.abs(difference[columns]), -1.0)
        index = int(np.argmax(values))
        if values[index] >= 0:
            name = AXES[columns.start + index]
            texts.append(f"{_size(values[index], name)} ({name})")
    return " and ".join(texts)


def _distance(difference, known):
    return float(np.linalg.norm(np.where(known, difference, 0.0)))


# ---------------------------------------------------------------- data and provenance


def _summary(calibration, evidence):
    """What was solved, as names and values."""
    rows = {
        "Method": f"{calibration.method} ({calibration.backend})",
        "Reference": calibration.reference_reason or calibration.reference,
        "Poses": f"{calibration.n_poses:,} synchronised pose pairs over {_duration(evidence.tracks.times_s[-1])}",
        "Motion pairs": f"{calibration.n_inliers:,} of {calibration.n_pairs:,} are inliers",
        "Objective": f"{calibration.objective:.6g}",
        "Time offset": _given_or_estimated(
            calibration.time_offset_s, calibration.time_offset_sigma_s, "s"
        ),
        "Scale": _given_or_estimated(calibration.scale, calibration.scale_sigma, ""),
    }
    if noise := calibration.noise:
        jumps = len(noise["jumps_before_stamp_ns"])
        rows["Noise found"] = (
            f"{_size(noise['translation_white_m'], 'x')} and {_size(noise['rotation_white_rad'], 'yaw')} per pose and axis; growing by "
            f"{_size(noise['translation_drift_m_per_pose'], 'x')} and {_size(noise['rotation_drift_rad_per_pose'], 'yaw')} from pose to "
            f"pose; systematic error: {noise['systematic']}; {jumps} jump{'' if jumps == 1 else 's'}"
        )
    return rows


def _streams(inputs, streams):
    """A row for each stream: where it came from, how many poses, how fast, the longest gap, the
    way.
    """
    rows = []
    for name in ("parent", "child"):
        known = dict(inputs.get(name, {}))
        count = known.get("messages", known.get("poses"))
        first_ns, last_ns = known.get("first_stamp_ns"), known.get("last_stamp_ns")
        row = {
            "name": name,
            "source": known.get("topic", known.get("file", "-")),
            "poses": "-" if count is None else f"{count:,}",
            "rate": "-"
            if not count or count < 2 or last_ns == first_ns
            else f"{(count - 1) / (last_ns - first_ns) * 1e9:.1f} Hz",
            "duration": "-" if first_ns is None else _duration((last_ns - first_ns) * 1e-9),
            "gap": "-",
            "way": "-",
            "refused": "; ".join(
                f"{known[key]:,} {word}" for key, word in _REFUSED.items() if known.get(key)
            )
            or "none",
        }
        stream = streams.get(name)
        # In a very long drive only the newest poses are at hand: of the stream as a whole they say
        # nothing.
        if stream is not None and len(stream) >= max(2, count or 0):
            whole = summarise(stream)
            row |= {
                "gap": f"{whole.longest_interval_s:.2f} s",
                "way": _length(whole.path_m),
                "duration": _duration(whole.duration_s),
            }
            row |= {"poses": f"{whole.poses:,}", "rate": f"{whole.rate_hz:.1f} Hz"}
        rows.append(row)
    return rows


_REFUSED = {"refused_duplicate": "with a stamp that was there already", "refused_late": "too late"}


def _provenance(inputs):
    """Versions, files and the rest of the inputs, as names and values."""
    versions = {name: _version(name) for name in ("hand_eye_calib", "numpy", "scipy")} | {
        "python": platform.python_version()
    }
    rows = {
        "Written": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC"),
        "Versions": _plain(versions),
    }
    rows |= {
        name.capitalize(): _plain(value)
        for name, value in inputs.items()
        if name not in ("parent", "child", "options", "files")
    }
    for file in inputs.get("files", ()):
        rows[f"File {Path(file['file']).name}"] = (
            f"{file['file']}, {file['bytes']:,} bytes, SHA-256 {file['sha256']}"
        )
    return rows


def _version(name):
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed"


# ---------------------------------------------------------------- words


def _given_or_estimated(value, sigma, unit):
    text = f"{value:.4f} ± {sigma:.4f} {unit}, estimated" if sigma else f"{value:g} {unit}"
    return " ".join(text.split())


def _size(value, axis):
    """A length or an angle in the unit that reports use, with two digits that matter."""
    value, unit = (100 * value, " cm") if axis in "xyz" else (math.degrees(value), "°")
    return f"{_two_digits(value)}{unit}"


def _length(value_m):
    return (
        f"{_two_digits(100 * value_m)} cm"
        if value_m < 1
        else f"{value_m:,.{1 if value_m < 100 else 0}f} m"
    )


def _two_digits(value):
    if value == 0 or abs(value) < 1e-4:
        return "less than 0.0001" if value else "0"
    return f"{value:.{max(1 - math.floor(math.log10(abs(value))), 0)}f}"


def _duration(seconds):
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def _share(share):
    return f"{share:.1%}" if share < 0.1 else f"{share:.0%}"


def _list(words):
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))
