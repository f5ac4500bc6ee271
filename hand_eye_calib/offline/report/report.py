"""Write ``report.html``: one self-contained page with the extrinsic, its sigma and the evidence."""

import html
import math
import re
from collections.abc import Callable, Iterable, Sequence
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
from hand_eye_calib.core.base.registry import REPORT_PICTURES
from hand_eye_calib.core.base.spelling import (
    Interface,
    spelled,
    spelled_options,
)
from hand_eye_calib.core.base.version import version_of
from hand_eye_calib.core.engine.snapshot import Snapshot, options_of_streams
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.axes import target_of
from hand_eye_calib.core.results.calibration import Calibration, Verdict
from hand_eye_calib.core.results.document import (
    Notation,
    allowance_in_words,
    angles_in_words,
    extra_transforms,
    parts_of_sigmas,
    printed_numbers,
    summary,
    transforms_of,
    usable_numbers,
)
from hand_eye_calib.core.results.parts import advice_of, facts_of
from hand_eye_calib.core.results.records import ROTATIONS, TRANSLATIONS
from hand_eye_calib.core.results.verdict import shown
from hand_eye_calib.offline.report.evidence import Evidence, gather, summarise
from hand_eye_calib.offline.report.figures import figures_of
from hand_eye_calib.offline.report.style import LOOK, Drawn
from hand_eye_calib.offline.report.views import figure_of_views

# Sign of each tone. A tone is also a class in page.css.
MARKS = {"good": "✓", "warn": "!", "bad": "✗"}
TONES = {
    Verdict.USE.value: "good",
    Verdict.USE_WITH_CARE.value: "warn",
    Verdict.DO_NOT_USE.value: "bad",
}

# Word and explanation of each verdict on an axis.
_WORDS = {
    "observed": ("observed", "determined by the motion"),
    "above": ("above the target", "determined, but less well than the target"),
    "weak": ("weak", "determined, but not well"),
    "unobservable": ("unknown", "do not use this value"),
    "prior": ("prior", "mostly from a prior or the ground"),
}
_AXIS_NAMES = {
    "x": "along x",
    "y": "along y",
    "z": "along z",
    "roll": "about x (roll)",
    "pitch": "about y (pitch)",
    "yaw": "about z (yaw)",
}

# Frames of sensors that have no name.
_DEFAULT_FRAMES = ("parent_sensor", "child_sensor")
# Figures at the top of the page. All other figures are in the section Evidence.
_TOP_FIGURES = ("views", "track", "trajectories")

# Space before an option in a command. The page may break lines only there.
_OPTION_BEGINS = re.compile(r" (?=--)")
# Option in a sentence. The page does not break its line at a hyphen.
_OPTION = re.compile(r"--[a-z][\w-]*")

_FOLDER = Path(__file__).parent / "templates"
_TEMPLATES = jinja2.Environment(
    loader=jinja2.FileSystemLoader(_FOLDER),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def _with_whole_options(sentence: str) -> str:
    """Return a sentence as safe HTML whose options are not broken over two lines."""
    return _OPTION.sub(
        r'<span class="nowrap">\g<0></span>', html.escape(sentence)
    )


_TEMPLATES.filters |= {
    "number": text.fixed,
    "printable": printable,
    "spelled": spelled,
    "whole_options": _with_whole_options,
}
_TEMPLATES.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
_TEMPLATES.globals |= dict(
    amount=text.amount,
    change=text.change,
    counted=text.counted,
    capital=text.capital,
)
_TEMPLATES.globals["axis_names"] = _AXIS_NAMES


@cache
def _template(path: Path) -> jinja2.Template:
    """Return a compiled template. It may extend or import other templates of this package."""
    return _TEMPLATES.from_string(path.read_text(encoding="utf-8"))


def page(
    template: Path,
    tone: str,
    verdict: str,
    sentence: str,
    interface: Interface = Interface.TERMINAL,
    **values: Any,
) -> str:
    """Return a page as HTML. Every page begins with a verdict.

    Parameters
    ----------
    template : Path
    tone : {"good", "warn", "bad"}
        Colour and sign of the verdict.
    verdict : str
        One or two words.
    sentence : str
        The verdict in a sentence.
    interface : Interface
        Interface of the user, which decides the spelling of options.
    **values
        Other variables of the template.
    """
    return _template(template).render(
        **values,
        tone=tone,
        mark=MARKS[tone],
        marks=MARKS,
        verdict=verdict,
        sentence=text.capital(spelled(sentence, interface)),
        interface=interface,
    )


def render(
    calibration: Calibration,
    snapshot: Snapshot | None,
    inputs: Document | None = None,
    interface: Interface = Interface.TERMINAL,
    pictures: Sequence[Callable[[Calibration], list[Drawn]]] = (),
) -> str:
    """Return the report of a result as HTML.

    Parameters
    ----------
    calibration : Calibration
    snapshot : Snapshot or None
        Poses and options of the result; None for the stops of an arm.
    inputs : dict, optional
        Origin of the data, such as paths and topics, in plain values.
    interface : Interface
        Interface of the user, which decides the spelling of options.
    pictures : sequence of callable
        Functions that draw further figures from the result, such as images of an arm's target.
    """
    inputs = inputs or {}
    command = calibration.static_transform_command()
    calibration = _with_sensor_names(calibration, inputs)
    parent = printable(calibration.parent_frame)
    child = printable(calibration.child_frame)
    evidence = gather(calibration, snapshot) if snapshot else None
    parent_is_positions = (
        evidence is not None and evidence.has_positions_of_parent
    )
    return page(
        _FOLDER / "report.html",
        TONES[calibration.verdict.value],
        calibration.verdict.value,
        calibration.sentence,
        interface,
        calibration=calibration,
        at_distance=_at_distance(calibration),
        document=calibration.to_dict(),
        parent=parent,
        child=child,
        rotating=child if parent_is_positions else parent,
        kind=_kind_of_result(calibration),
        stops=calibration.parts.get("stops"),
        facts=facts_of(calibration, "stops"),
        advice=_advice(calibration, evidence),
        command=_OPTION_BEGINS.split(command) if command else [],
        unknown=text.listing(_numbers_by_hand(calibration)),
        target=_targets(calibration),
        reasons=shown(calibration.reasons),
        figures=figures_of(calibration, evidence),
        pictures=_drawn(calibration, snapshot, pictures),
        top_figures=_TOP_FIGURES,
        **_numbers(calibration, interface),
        **_data(calibration, snapshot, evidence, inputs, interface),
    )


def _numbers(calibration: Calibration, interface: Interface) -> dict[str, Any]:
    """Return the transforms of a result, and the functions that format their numbers."""
    return {
        "directions": [*transforms_of(calibration).values()][:2],
        "others": _other_transforms(calibration),
        "numbers_of": partial(
            printed_numbers, out_of_reach=calibration.out_of_reach, sign="±"
        ),
        "parts_of": parts_of_sigmas,
        "angles_of": partial(angles_in_words, result=calibration),
        "axes": list(_axes(calibration)),
        "allowance": spelled(allowance_in_words(calibration), interface),
    }


def _drawn(
    calibration: Calibration,
    snapshot: Snapshot | None,
    pictures: Sequence[Callable[[Calibration], list[Drawn]]],
) -> list[Drawn]:
    """Return the further figures of a result, from the caller and from extras."""
    drawings = []
    for draw in pictures:
        drawings += draw(calibration)
    return drawings + pictures_of_extras(calibration, snapshot)


def pictures_of_extras(
    calibration: Calibration, snapshot: Snapshot | None, suffix: str = ""
) -> list[Drawn]:
    """Return the figures of all extras. Their names end in ``suffix``."""
    figures = []
    for draw in REPORT_PICTURES.values():
        figures += draw(calibration, snapshot, suffix)
    return figures


def _advice(calibration: Calibration, evidence: Evidence | None) -> str:
    """Return the next steps of the user: motion that is missing, and advice in the reasons."""
    advice = []
    if evidence and calibration.verdict is not Verdict.DO_NOT_USE:
        advice.append(what_is_missing(evidence.excitation, calibration))
    if calibration.verdict is not Verdict.USE:
        advice += advice_of(calibration)
    return "; ".join(filter(None, advice))


def _numbers_by_hand(calibration: Calibration) -> list[str]:
    """Return the names of the numbers that the user must measure by hand."""
    numbers = usable_numbers(calibration).values()
    return [number for number in numbers if isinstance(number, str)]


def render_brief(calibration: Calibration) -> str:
    """Return headline, pose and the three views of a result as HTML for a notebook."""
    transform = transforms_of(calibration)["T_parent_child"]
    return _template(_FOLDER / "brief.html").render(
        calibration=calibration,
        numbers=printed_numbers(transform, calibration.out_of_reach, "±"),
        parts=parts_of_sigmas(transform),
        angles=angles_in_words(transform, calibration),
        allowance=spelled(allowance_in_words(calibration), Interface.PYTHON),
        views=figure_of_views([calibration]),
    )


def _other_transforms(
    calibration: Calibration,
) -> list[tuple[Notation, tuple[str, str]]]:
    """Return further transforms of the result with the names of their source and target frames.

    The stops of an arm have one, for example: the pose of the target in the base.
    """
    transforms = transforms_of(calibration)
    return [
        (transforms[name], (printable(extra.source), printable(extra.target)))
        for name, extra in extra_transforms(calibration).items()
    ]


def _kind_of_result(calibration: Calibration) -> str:
    """Return "Pose"; "Position" or "Orientation" if the streams determine only this part."""
    unknown = {*calibration.out_of_reach}
    if unknown >= {*ROTATIONS}:
        return "Position"
    return "Orientation" if unknown >= {*TRANSLATIONS} else "Pose"


def _with_sensor_names(
    calibration: Calibration, inputs: Document
) -> Calibration:
    """Return the result with the names of its sensors as frames."""
    return replace(
        calibration,
        parent_frame=_sensor_name(
            calibration.parent_frame, inputs.get("parent", {})
        ),
        child_frame=_sensor_name(
            calibration.child_frame, inputs.get("child", {})
        ),
    )


def _sensor_name(frame: str, origin: Document) -> str:
    """Return the frame of a sensor; if it is a default name, its topic or file."""
    source = str(origin.get("topic") or Path(str(origin.get("file", ""))).stem)
    return source if frame in _DEFAULT_FRAMES and source else frame


def _at_distance(calibration: Calibration) -> str:
    """Return a sentence about the position error of an object seen by the child sensor.

    The sentence is empty if a standard deviation is unknown, or if the result must not be used.
    """
    is_bad = calibration.verdict is Verdict.DO_NOT_USE
    if is_bad or not np.isfinite(calibration.sigmas).all():
        return ""
    # The objects of an arm are near, and its stops have no errors of odometry.
    are_stops = calibration.reference == "stops"
    distance_m = LOOK.near_object_m if are_stops else LOOK.object_m
    errors = ""
    if not are_stops:
        errors = ", constant odometry errors included"
    # Put the object on each axis of the child sensor, and use the direction with the largest error.
    variances = []
    for point in distance_m * np.eye(3):
        # Derivative of the object's position with respect to the error of the pose.
        J = np.hstack([np.eye(3), -se3.skew(point)])
        variances.append(
            np.linalg.eigvalsh(J @ calibration.covariance @ J.T)[-1]
        )
    child = printable(calibration.child_frame)
    return (
        f"The position of an object {distance_m:g} m from {child} has a standard deviation of "
        f"{text.length(float(np.sqrt(max(variances))))} in its worst direction{errors}."
    )


def _targets(calibration: Calibration) -> str:
    """Return the targets of translation and rotation, and different targets of single axes."""
    targets = [
        text.length(calibration.target_translation),
        text.angle(calibration.target_rotation),
    ]
    for axis, target in calibration.target_axes.items():
        targets.append(f"{axis} {text.amount(axis, target)}")
    return text.listing(targets)


class AxisRow(NamedTuple):
    """Row of the table of uncertainties, for one axis.

    Attributes
    ----------
    name, title : str
        Name of the axis, such as "roll", and its title, such as "about x (roll)".
    sigma : str
        Standard deviation with its unit.
    verdict, word, words : str
        Verdict on the axis, its printed word, and its explanation.
    bar : float
        Length of the bar of the standard deviation (per cent).
    measured : float
        Length of the dark part of the bar (per cent): the measured share of the variance.
    """

    name: str
    title: str
    sigma: str
    verdict: str
    word: str
    words: str
    bar: float
    measured: float


def _axes(calibration: Calibration) -> Iterable[AxisRow]:
    """Yield the rows of the table of uncertainties, along and about the parent's axes."""
    is_bad = calibration.verdict is Verdict.DO_NOT_USE
    sigmas_measured = calibration.sigmas_measured.tolist()
    for dof, measured in zip(
        calibration.observability, sigmas_measured, strict=True
    ):
        if dof.name not in calibration.out_of_reach:
            target = target_of(dof.name, calibration)
            verdict = dof.verdict.value
            if verdict == "observed" and dof.sigma > target:
                verdict = "above"
            bar = _bar(dof.sigma / target)
            measured_share = 1.0
            if 0.0 < dof.sigma < math.inf:
                measured_share = min((measured / dof.sigma) ** 2, 1.0)
            yield AxisRow(
                dof.name,
                _AXIS_NAMES[dof.name],
                text.amount(dof.name, dof.sigma),
                verdict,
                _WORDS[verdict][0],
                _WORDS["unobservable" if is_bad else verdict][1],
                bar,
                bar * measured_share,
            )


def _bar(ratio: float) -> float:
    """Return the length of a logarithmic bar (per cent) from the ratio of sigma to its target."""
    with np.errstate(divide="ignore"):
        decades = LOOK.decades_above - np.log10(ratio)
    return float(np.clip(100 * (1 - decades / LOOK.bar_decades), 1, 100))


# ---------------------------------------------------------------- data and solution


def _data(
    calibration: Calibration,
    snapshot: Snapshot | None,
    evidence: Evidence | None,
    inputs: Document,
    interface: Interface,
) -> Document:
    """Return the variables of the section "Data and solution" of the template."""
    defaults = CalibratorConfig().to_options()
    options = snapshot.config.to_options() if snapshot else defaults
    implied = options_of_streams(*snapshot.streams) if snapshot else {}
    changed = [
        (name, value)
        for name, value in options.items()
        if value not in (defaults[name], implied.get(name))
    ]
    kind = "stops"
    if evidence:
        kind = f"synchronised pose pairs over {text.duration(evidence.times_s[-1])}"
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    streams: dict[str, Trajectory] = {}
    if snapshot:
        streams = dict(zip(("parent", "child"), snapshot.streams, strict=True))
    rows = []
    for name in ("parent", "child", "samples"):
        if name in streams or name in inputs:
            rows.append(_stream(name, inputs.get(name, {}), streams.get(name)))
    return {
        "labels": inputs.get("labels", {}),
        "summary": {
            **summary(calibration),
            "Poses": f"{calibration.n_poses:,} {kind}",
            "Options": spelled_options(changed, interface) or "defaults",
            "Written": f"{now}, hand_eye_calib {version_of()}; extrinsic.yaml has the rest",
        },
        "streams": rows,
    }


def _stream(
    name: str, origin: Document, stream: Trajectory | None
) -> dict[str, str]:
    """Return the row of a stream: source, poses, duration, rate, longest gap and path length.

    An unknown value is "-".
    """
    count = origin.get("messages", origin.get("poses"))
    row = {
        "name": name,
        "source": origin.get("topic") or Path(origin.get("file", "-")).name,
    }
    row |= dict.fromkeys(("poses", "rate", "duration", "gap", "path"), "-")
    ends_ns = [
        origin[key]
        for key in ("first_stamp_ns", "last_stamp_ns")
        if origin.get(key)
    ]
    if count and ends_ns:
        duration_s = (ends_ns[-1] - ends_ns[0]) * 1e-9
        if duration_s:
            row["duration"] = text.duration(duration_s)
            row["rate"] = f"{(count - 1) / duration_s:.1f} Hz"
    # The stream from a bag contains only the poses of pairs; from a long bag, only the newest. Its
    # gaps are then not the gaps of the topic, so the values of ``origin`` are kept.
    if stream is not None and len(stream) >= max(2, count or 0):
        whole = summarise(stream)
        count = len(stream)
        row["gap"] = f"{whole.longest_interval_s:.2f} s"
        row["rate"] = f"{whole.rate_hz:.1f} Hz"
        row["duration"] = text.duration(whole.duration_s)
        if whole.path_m is not None:
            row["path"] = text.length(whole.path_m)
    if count is not None:
        row["poses"] = f"{count:,}"
    return row
