"""``report.html``: one self-contained page with the extrinsic, its uncertainty and the evidence."""

from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np

from hand_eye_calib.core.assessment.excitation import what_is_missing
from hand_eye_calib.core.base import text
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.errors import printable
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.base.version import version_of
from hand_eye_calib.core.engine.snapshot import Snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.document import (
    allowance_in_words,
    printed_numbers,
    summary,
    transforms_of,
    usable_numbers,
)
from hand_eye_calib.core.results.records import ROTATIONS, TRANSLATIONS
from hand_eye_calib.core.results.verdict import shown, target_of
from hand_eye_calib.offline.report.evidence import Evidence, gather, summarise
from hand_eye_calib.offline.report.figures import LOOK, figures_of

MARKS = {"good": "✓", "warn": "!", "bad": "✗"}
TONES = {
    Verdict.USE.value: "good",
    Verdict.USE_WITH_CARE.value: "warn",
    Verdict.DO_NOT_USE.value: "bad",
}

_WORDS = {
    "observed": "determined by the motion",
    "weak": "determined, but not well",
    "unobservable": "do not use this value",
    "prior": "mostly from the prior",
}
_AXIS_NAMES = {axis: f"along {axis}" for axis in TRANSLATIONS}
_AXIS_NAMES |= {"roll": "about x (roll)", "pitch": "about y (pitch)", "yaw": "about z (yaw)"}

# Names of sensors that came without one.
_NAMELESS = ("parent_sensor", "child_sensor")
# Figures for whoever uses the result; the others are evidence for whoever doubts it.
_SHOWN_FIRST = ("views", "trajectories")

_FOLDER = Path(__file__).parent / "templates"
_TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(_FOLDER),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.filters |= {"number": text.fixed, "printable": printable}
_TEMPLATES.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
_TEMPLATES.globals |= dict(amount=text.amount, change=text.change, counted=text.counted)
_TEMPLATES.globals["axis_names"] = _AXIS_NAMES


@cache
def _template(path: Path) -> jinja2.Template:
    """Compile a template once; what it extends or imports is among the templates here."""
    return _TEMPLATES.from_string(path.read_text(encoding="utf-8"))


def page(template: Path, tone: str, verdict: str, said: str, **values: Any) -> str:
    """A page from its template: every page begins with a verdict, in words and by a tone.

    Parameters
    ----------
    template : Path
    tone : {"good", "warn", "bad"}
    verdict, said : str
        In a word and in a sentence.
    **values
        What else the template shows.
    """
    values |= {"tone": tone, "mark": MARKS[tone], "marks": MARKS, "verdict": verdict}
    return _template(template).render(**values, said=text.capital(said))


def render(
    calibration: Calibration, snapshot: Snapshot | None, inputs: Document | None = None
) -> str:
    """The report as HTML, of a result and the poses and options that gave it (none for stops);
    ``inputs`` say in plain values where the data came from.
    """
    inputs = inputs or {}
    command = calibration.static_transform_command()
    calibration = replace(
        calibration,
        parent_frame=_named(calibration.parent_frame, inputs.get("parent", {})),
        child_frame=_named(calibration.child_frame, inputs.get("child", {})),
    )
    parent = printable(calibration.parent_frame)
    child = printable(calibration.child_frame)
    verdict, _, said = calibration.headline.partition(": ")
    document = calibration.to_dict()
    by_hand = [each for each in usable_numbers(calibration).values() if isinstance(each, str)]
    evidence = gather(calibration, snapshot) if snapshot else None
    advice = ""
    unknown = {*calibration.out_of_reach}
    if evidence and calibration.verdict is not Verdict.DO_NOT_USE:
        advice = what_is_missing(evidence.excitation, calibration)
    return page(
        _FOLDER / "report.html",
        TONES[calibration.verdict.value],
        verdict,
        said,
        calibration=calibration,
        at_distance=_at_distance(calibration),
        document=document,
        parent=parent,
        child=child,
        rotating=child if evidence and evidence.has_positions_of_parent else parent,
        kind="Position" if unknown & {*ROTATIONS} else "Orientation" if unknown else "Pose",
        directions=[*transforms_of(calibration).values()][:2],
        numbers_of=partial(printed_numbers, out_of_reach=calibration.out_of_reach, sign="±"),
        axes=list(_axes(calibration)),
        allowance=allowance_in_words(calibration),
        advice=advice,
        command=command,
        unknown=text.listing(by_hand),
        target=_targets(calibration),
        reasons=shown(calibration.reasons),
        figures=figures_of(calibration, evidence),
        shown_first=_SHOWN_FIRST,
        **_data(calibration, snapshot, evidence, inputs),
    )


def _named(frame: str, known: Document) -> str:
    """The name of a sensor: its frame, or where its poses came from if they name none."""
    source = str(known.get("topic") or Path(str(known.get("file", ""))).stem)
    return source if frame in _NAMELESS and source else frame


def _at_distance(calibration: Calibration) -> str:
    """What the standard deviations do to an object at a distance; empty if one is unknown."""
    if not np.isfinite(calibration.sigmas).all():
        return ""
    errors = []
    for point in LOOK.distance_m * np.eye(3):
        J = np.hstack([np.eye(3), -se3.skew(point)])
        errors.append(np.linalg.eigvalsh(J @ calibration.covariance @ J.T)[-1])
    child = printable(calibration.child_frame)
    return (
        f"An object {LOOK.distance_m:.0f} m from {child} is misplaced by up to "
        f"{text.length(float(np.sqrt(max(errors))))} (one standard deviation, constant odometry "
        "errors included)."
    )


def _targets(calibration: Calibration) -> str:
    """Target of x, y and z, of the rotations, and of the axes that have their own."""
    of_all = text.length(calibration.target_translation), text.angle(calibration.target_rotation)
    single = [f"{axis} {text.amount(axis, each)}" for axis, each in calibration.target_axes.items()]
    return text.listing([*of_all, *single])


class AxisRow(NamedTuple):
    """A row of the table of uncertainties: ``bar`` is its length in per cent."""

    name: str
    title: str
    sigma: str
    verdict: str
    words: str
    bar: float


def _axes(calibration: Calibration) -> Iterable[AxisRow]:
    """Rows of the table of uncertainties, along and about the parent's axes."""
    is_bad = calibration.verdict is Verdict.DO_NOT_USE
    for dof in calibration.observability:
        if dof.name not in calibration.out_of_reach:
            yield AxisRow(
                dof.name,
                _AXIS_NAMES[dof.name],
                text.amount(dof.name, dof.sigma),
                dof.verdict.value,
                _WORDS["unobservable" if is_bad else dof.verdict.value],
                _bar(dof.sigma / target_of(dof.name, calibration)),
            )


def _bar(ratio: float) -> float:
    """Length in per cent of the bar for a standard deviation, from its ratio to the target."""
    with np.errstate(divide="ignore"):
        decades = LOOK.bar_above - np.log10(ratio)
    return float(np.clip(100 * (1 - decades / LOOK.bar_decades), 1, 100))


# ---------------------------------------------------------------- data and solution


def _data(
    calibration: Calibration, snapshot: Snapshot | None, evidence: Evidence | None, inputs: Document
) -> Document:
    """What the result comes from, for the template."""
    options = snapshot.config.to_options() if snapshot else {}
    usual = CalibratorConfig().to_options()
    given = [f"{name} {each}" for name, each in options.items() if each != usual[name]]
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    rows = summary(calibration)
    kind = "stops"
    if evidence:
        kind = f"synchronised pose pairs over {text.duration(evidence.times_s[-1])}"
    streams = dict(zip(("parent", "child"), snapshot.streams, strict=True)) if snapshot else {}
    names = [name for name in ("parent", "child") if name in streams or name in inputs]
    return {
        "labels": inputs.get("labels", {}),
        "summary": rows
        | {"Poses": f"{calibration.n_poses:,} {kind}", "Options": ", ".join(given) or "defaults"}
        | {"Written": f"{now}, hand_eye_calib {version_of()}; extrinsic.yaml has the rest"},
        "streams": [_stream(name, inputs, streams.get(name)) for name in names],
    }


def _stream(name: str, inputs: Document, stream: Trajectory | None) -> dict[str, str]:
    """Where a stream came from, how many poses, their rate, the longest gap, the path length."""
    known = inputs.get(name, {})
    count = known.get("messages", known.get("poses"))
    row = {"name": name, "source": known.get("topic") or Path(known.get("file", "-")).name}
    row |= dict.fromkeys(("poses", "rate", "duration", "gap", "path"), "-")
    # Of a bag only poses of pairs are at hand, of a long one the newest: they say nothing of gaps.
    ends_ns = [known[name] for name in ("first_stamp_ns", "last_stamp_ns") if known.get(name)]
    if count and ends_ns and (seconds := (ends_ns[-1] - ends_ns[0]) * 1e-9):
        row |= {"duration": text.duration(seconds), "rate": f"{(count - 1) / seconds:.1f} Hz"}
    if stream is not None and len(stream) >= max(2, count or 0):
        whole = summarise(stream)
        count = len(stream)
        row |= {"gap": f"{whole.longest_interval_s:.2f} s", "rate": f"{whole.rate_hz:.1f} Hz"}
        row |= {"duration": text.duration(whole.duration_s)}
        row |= {"path": "-" if whole.path_m is None else text.length(whole.path_m)}
    return row if count is None else row | {"poses": f"{count:,}"}
