"""Study of deliberate faults in simulated and real recordings, in up to three severities.

The study counts the findings and verdicts of each fault, and computes the largest error in standard
deviations.

``python -m reproduction faults --data-folder DIR --page docs/faults.md`` writes the page. An
interrupted run continues from ``faults.jsonl``. ``--clean`` solves the clean recordings alone.
"""

import argparse
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import HandEyeCalibError
from hand_eye_calib.core.checks.check import check_streams
from hand_eye_calib.core.checks.findings import Severity
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import HILLY_DRIVE, NoiseConfig
from hand_eye_calib.offline.calibrate import MethodName, calibrate
from reproduction import clean_recordings
from reproduction.fault_cases import FAULTS
from reproduction.fault_entry import Fault
from reproduction.later_faults import LATER, SILENT
from reproduction.recordings import real_rigs
from reproduction.runner import kept
from reproduction.writing import counted, markdown_table, put_into_page

METHODS: tuple[MethodName, ...] = ("dnlo", "auto")
# Number of simulated drives that get faults.
_N_DRIVES = 2
_NOISE = NoiseConfig(gaussian=0.003)
# Real recordings that get faults.
_TANGO = ("tango_caligula_mars",)
# Errors above this number of standard deviations are listed.
_LIMIT_Z = 3.3

# Number of pose pairs for the solves; the checks use all poses.
_MAX_PAIRS = 400

_NO_ANSWER = "no answer"
# Words of the tables for the verdicts.
_SHORT = {"DO NOT USE": "no", "USE WITH CARE": "care", "USE": "use"}

# ``Case.fault`` of a recording that gets faults in other cases, here without a fault.
_SOUND = "none"
# ``Case.fault`` of a clean recording.
_CLEAN = "clean"

# Faults by the titles of the tables of the page.
GROUPS = {
    "Faults": FAULTS,
    "Faults added after the limits of the checks were set": LATER,
    "Faults without a finding before the check estimated a parameter for them": SILENT,
}
_FAULTS = {fault.code: fault for fault in chain(*GROUPS.values())}

# Rules of the verdict that describe a sound recording: its motion, its outliers, its findings.
_PHYSICAL = frozenset(
    {
        "unobservable",
        "nothing_known",
        "target",
        "floor",
        "outliers",
        "warning_finding",
        "error_finding",
    }
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A calibration of the study: a recording with or without a fault, and a method."""

    fault: str
    severity: int
    recording: str
    method: MethodName

    @property
    def key(self) -> str:
        """Name of the case."""
        words = (self.fault, str(self.severity), self.recording, self.method)
        return " ".join(words)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of a case."""

    # Name of the case.
    key: str
    verdict: str
    # Codes of findings; ``note:`` precedes the codes of notes.
    findings: list[str]
    # Errors of the extrinsic.
    metres: float = math.nan
    degrees: float = math.nan
    # Largest error of an observable axis, in standard deviations.
    z: float = math.nan
    # Rules of the verdict's reasons.
    rules: list[str] = field(default_factory=list)


def run(arguments: argparse.Namespace) -> str:
    """Solve the cases that the file does not contain, and return the text about all cases.

    The text is written into the page, if a page is given.
    """
    folder = arguments.data_folder
    out = arguments.out
    todo = (
        clean_cases(folder)
        if arguments.clean
        else cases(folder, arguments.seed)
    )
    tasks = {case.key: (case, folder) for case in todo}
    records = kept(out / "faults.jsonl", _plain_outcome, tasks, arguments.jobs)
    text = report([Outcome(**record) for record in records.values()], folder)
    if arguments.page is not None:
        put_into_page(arguments.page, "faults", text)
    return text


def _plain_outcome(case: Case, folder: Path | None) -> dict[str, Any]:
    return asdict(outcome(case, folder))


def recordings(folder: Path | None, first_seed: int = 0) -> list[str]:
    """Return the names of the recordings that get faults; ``first_seed`` is for the drives."""
    seeds = range(first_seed, first_seed + _N_DRIVES)
    names = [f"hilly_{seed}" for seed in seeds]
    if folder:
        names += _TANGO
    return names


def cases(folder: Path | None, first_seed: int = 0) -> list[Case]:
    """Return all cases: recordings without a fault, with each fault, and clean recordings."""
    names = recordings(folder, first_seed)
    cases_of_study = _cases(_SOUND, 1, names)
    for code, fault in _FAULTS.items():
        cases_of_study += _cases(code, len(fault.severities), names)
    return cases_of_study + clean_cases(folder)


def clean_cases(folder: Path | None) -> list[Case]:
    """Return the cases of the clean recordings, for the default method."""
    names = clean_recordings.names(folder)
    return _cases(_CLEAN, 1, names, methods=("auto",))


def _cases(
    fault: str,
    n_severities: int,
    names: Sequence[str],
    methods: Sequence[MethodName] = METHODS,
) -> list[Case]:
    """Return the cases of a fault in all recordings, with all severities and methods."""
    return [
        Case(fault=fault, severity=severity, recording=name, method=method)
        for severity, name, method in product(
            range(n_severities), names, methods
        )
    ]


def outcome(case: Case, folder: Path | None) -> Outcome:
    """Solve a case."""
    if case.fault == _CLEAN:
        return _of_clean(case, folder)
    parent, child, T_parent_child = _sound(case.recording, case.method, folder)
    options: Mapping[str, Any] = {}
    fault = _FAULTS.get(case.fault)
    if fault:
        seed = sum(map(ord, case.recording))
        random = np.random.default_rng(seed)
        severity = fault.severities[case.severity]
        parent, child = fault.damage(parent, child, severity, random)
        options = fault.options
    try:
        result = calibrate(
            parent, child, method=case.method, max_pairs=_MAX_PAIRS, **options
        )
    except HandEyeCalibError:
        findings = _named(check_streams(parent, child).findings)
        return Outcome(key=case.key, verdict=_NO_ANSWER, findings=findings)
    return _judged(case.key, result, T_parent_child)


def _of_clean(case: Case, folder: Path | None) -> Outcome:
    clean = clean_recordings.recording(case.recording, folder)
    # Real recordings are solved with all poses, as by a user.
    options = clean.options if clean.is_real else {"max_pairs": _MAX_PAIRS}
    result = calibrate(clean.parent, clean.child, method=case.method, **options)
    return _judged(case.key, result, clean.T_parent_child)


def _named(findings: Iterable[Any]) -> list[str]:
    """Return the codes of findings; ``note:`` precedes the codes of notes."""
    codes = []
    for finding in findings:
        is_note = finding.severity is Severity.NOTE
        codes.append(f"note:{finding.code}" if is_note else finding.code)
    return codes


def _judged(
    key: str, result: Calibration, T_parent_child: FloatArray | None
) -> Outcome:
    """Return the outcome of a result; errors are NaN if the truth is not known."""
    outcome = Outcome(
        key=key,
        verdict=result.verdict.value,
        findings=_named(result.findings),
        rules=[reason.rule for reason in result.reasons],
    )
    if T_parent_child is None:
        return outcome
    xi = se3.log(se3.inverse(T_parent_child) @ result.T_parent_child)
    rotation = se3.rotation_of(T_parent_child)
    translation_errors = rotation @ xi[:3]
    errors = np.concatenate([translation_errors, rotation @ xi[3:]])
    is_observed = np.isfinite(result.sigmas)
    sigmas = np.maximum(result.sigmas[is_observed], 1e-9)
    ratios = np.abs(errors[is_observed]) / sigmas
    radians = np.linalg.norm(xi[3:])
    return replace(
        outcome,
        metres=float(np.linalg.norm(translation_errors[is_observed[:3]])),
        degrees=float(np.degrees(radians)),
        z=float(ratios.max(initial=0.0)),
    )


class _Sound(NamedTuple):
    """A recording without a fault, and its extrinsic."""

    parent: Trajectory
    child: Trajectory
    T_parent_child: FloatArray


@cache
def _sound(name: str, method: MethodName, folder: Path | None) -> _Sound:
    """Return a recording without a fault, and its extrinsic.

    The clock offset and the scale of a real recording are corrected. Its extrinsic is estimated
    from the corrected streams.
    """
    if name.startswith("hilly"):
        _, seed = name.rsplit("_", 1)
        drive = simulate_drive(int(seed), HILLY_DRIVE, _NOISE)
        return _Sound(drive.parent, drive.child, drive.T_parent_child)
    rigs, _ = real_rigs(folder or Path())
    rig = next(rig for rig in rigs if rig.name == name)
    (recording,) = rig.recordings.values()
    parent = recording.parent
    child = recording.child
    checked = check_streams(parent, child)
    offset = next(
        finding for finding in checked.findings if finding.code == "time_offset"
    )
    child = child.shifted(float(offset.options["time_offset"]))
    scale = checked.fit.scale if checked.fit else 1.0
    child = child.scaled(scale)
    result = calibrate(parent, child, method=method, max_pairs=_MAX_PAIRS)
    return _Sound(parent, child, result.T_parent_child)


# ------------------------------------------------------------------ the page


def report(outcomes: Sequence[Outcome], folder: Path | None) -> str:
    """Return the text of the page."""
    by_fault: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        code, *_ = outcome.key.split()
        by_fault.setdefault(code, []).append(outcome)
    clean = by_fault.pop(_CLEAN, [])
    sound = by_fault.pop(_SOUND, [])
    faulty = list(chain.from_iterable(by_fault.values()))
    parts = []
    if faulty:
        parts += [_about(faulty), _unsafe_text(faulty), _sound_text(sound)]
    for title, faults in GROUPS.items():
        rows = []
        for fault in faults:
            if fault.code in by_fault:
                rows.append(_row(fault, by_fault[fault.code]))
        if rows:
            parts.append(f"### {title}\n\n{markdown_table(rows)}")
    if clean:
        parts.append(f"### No false alarms\n\n{_clean_text(clean, folder)}")
    return "\n\n".join(parts)


def _about(faulty: Sequence[Outcome]) -> str:
    """Return the text about the recordings with faults."""
    methods = "` or `".join(METHODS)
    return (
        f"{len(faulty)} calibrations with `{methods}`: of simulated hilly "
        "drives of 120 s at 1.5 m/s (hilly), and of recordings of hand-held devices (tango), "
        "whose result without the fault counts as the truth. z is the largest error of an "
        "axis, divided by its standard deviation with the allowance. A number behind a finding or "
        "verdict is the number of calibrations; the three most frequent findings are listed. `no` "
        "is DO NOT USE, `care` is USE WITH CARE."
    )


def _unsafe_text(faulty: Sequence[Outcome]) -> str:
    """Return the text about wrong results with the verdict USE, with a line for each result."""
    lines = []
    for outcome in faulty:
        if outcome.verdict == "USE" and outcome.z > _LIMIT_Z:
            millimetres = 1e3 * outcome.metres
            lines.append(
                f"- {outcome.key}: z {outcome.z:.1f}, {millimetres:.0f} mm, "
                f"{outcome.degrees:.2f} deg"
            )
    about = (
        f"Results with the verdict USE and an error above {_LIMIT_Z:g} standard deviations: "
        f"{len(lines)}."
    )
    return "\n".join([about, *lines])


def _sound_text(sound: Sequence[Outcome]) -> str:
    """Return the text about the same recordings before they got faults."""
    largest = max((outcome.z for outcome in sound), default=0.0)
    return (
        f"Without a fault, the verdicts are {_verdicts_in_full(sound)}; z is "
        f"at most {largest:.1f}."
    )


def _verdicts_in_full(outcomes: Sequence[Outcome]) -> str:
    return counted(outcome.verdict for outcome in outcomes)


def _short_verdicts(outcomes: Sequence[Outcome]) -> str:
    """Return the verdicts in one word each, with their counts."""
    verdicts = [outcome.verdict for outcome in outcomes]
    return counted(_SHORT.get(verdict, verdict) for verdict in verdicts)


def _row(fault: Fault, outcomes: Sequence[Outcome]) -> dict[str, str]:
    """Return the row of a fault."""
    codes = []
    for outcome in outcomes:
        for code in dict.fromkeys(outcome.findings):
            if not code.endswith(("gaps", "one_axis")):
                codes.append(code.removeprefix("note:"))
    answered = [outcome.z for outcome in outcomes if math.isfinite(outcome.z)]
    return {
        "": fault.code,
        "fault": fault.what,
        "findings": counted(codes, most=3) or "none",
        "verdicts": _short_verdicts(outcomes),
        "largest z": f"{max(answered):.1f}" if answered else "",
    }


@dataclass(frozen=True)
class _CleanGroup:
    """Outcomes of the clean recordings of a kind, and the wrong findings in them."""

    outcomes: list[Outcome] = field(default_factory=list)
    wrong_codes: list[str] = field(default_factory=list)

    def is_listed(self) -> bool:
        """Whether a finding is wrong, an error is large, or a reason does not describe the
        recording.
        """
        are_far = [outcome.z > _LIMIT_Z for outcome in self.outcomes]
        are_physical = [_is_physical(outcome) for outcome in self.outcomes]
        return bool(self.wrong_codes) or any(are_far) or not all(are_physical)

    def row(self, kind: str) -> dict[str, object]:
        """Return the row of a kind of recordings."""
        rules: list[str] = []
        for outcome in self.outcomes:
            rules += dict.fromkeys(outcome.rules)
        answered = [o.z for o in self.outcomes if not math.isnan(o.z)]
        largest = max(answered, default=0.0)
        return {
            "clean recordings": kind,
            "solved": len(self.outcomes),
            "wrong findings": counted(self.wrong_codes) or "none",
            "verdict": _short_verdicts(self.outcomes),
            "reasons": counted(rules),
            "largest z": f"{largest:.1f}",
        }


def _is_physical(outcome: Outcome) -> bool:
    """Whether all reasons of the verdict describe the recording itself."""
    return _PHYSICAL.issuperset(outcome.rules)


def _clean_groups(
    outcomes: Sequence[Outcome], folder: Path | None
) -> dict[str, _CleanGroup]:
    """Return the clean recordings by kind; of each recording, only one wrong finding counts."""
    groups: dict[str, _CleanGroup] = {}
    for outcome in outcomes:
        # Fault, severity, name and method.
        _, _, name_and_method = outcome.key.split(" ", 2)
        name, _, _ = name_and_method.rpartition(" ")
        known_codes = clean_recordings.known_in(name, folder)
        wrong_codes = []
        for code in outcome.findings:
            if not code.startswith("note:") and code not in known_codes:
                wrong_codes.append(code)
        group = groups.setdefault(clean_recordings.kind_of(name), _CleanGroup())
        group.outcomes.append(outcome)
        group.wrong_codes.extend(wrong_codes[:1])
    return groups


def _clean_text(outcomes: Sequence[Outcome], folder: Path | None) -> str:
    """Return the text about clean recordings: wrong findings and verdicts."""
    groups = _clean_groups(outcomes, folder)
    n_wrong = sum(len(group.wrong_codes) for group in groups.values())
    n_own = sum(_is_physical(outcome) for outcome in outcomes)
    rows = [
        group.row(kind) for kind, group in groups.items() if group.is_listed()
    ]
    return (
        f"Wrong findings in {n_wrong} of {len(outcomes)} clean recordings, with the default "
        f"method. {n_own} of {len(outcomes)} results have the verdict USE, or only reasons that "
        "describe the recording: an axis that the motion does not determine, or not as well as the "
        "target asks; the common-mode floor; outliers; a correct finding. The table lists the "
        f"other results, and results with an error above {_LIMIT_Z:g} standard deviations."
        f"\n\n{markdown_table(rows)}"
    )
