"""Study of faults: each one in simulated and real recordings, in three severities. Which finding
names it, what the verdict is, and how wrong the answer is, in its own standard deviations.

``python -m reproduction faults --data-folder DIR --page docs/faults.md`` writes the page. A run
that was interrupted goes on from ``faults.jsonl``. ``--clean`` solves the clean recordings alone.
"""

import argparse
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from itertools import chain
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
# Simulated drives that faults are put into.
_N_DRIVES = 2
_NOISE = NoiseConfig(gaussian=0.003)
_TANGO = ("tango_caligula_mars",)
_LIMIT_Z = 3.3

# Poses are downsampled to so many for the solves; the checks see all.
_MAX_PAIRS = 400

_NO_ANSWER = "no answer"
_SHORT = {"DO NOT USE": "no", "USE WITH CARE": "care", "USE": "use"}

# Fault of a case without one, in a recording that the faults are put into, and in a clean one.
_SOUND = "none"
_CLEAN = "clean"

# Groups of the page: title to faults.
GROUPS = {
    "Faults": FAULTS,
    "Faults that were built later, without a limit for them": LATER,
    "Faults that were silent before their columns": SILENT,
}
_FAULTS = {fault.code: fault for fault in chain(*GROUPS.values())}

# Rules of the verdict that state how a recording is, not that something is wrong.
_PHYSICAL = frozenset(
    {
        "unobservable",
        "nothing_known",
        "target",
        "floor",
        "outliers",
        "warning_finding",
    }
    | {"error_finding"}
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is solved: a fault, or none, in one recording, by one method."""

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
    """How a case ended."""

    key: str
    verdict: str
    # Codes of errors and warnings, ``note:`` before those of notes.
    findings: list[str]
    # Error of the answer.
    metres: float = math.nan
    degrees: float = math.nan
    # Largest error of an axis in its stated standard deviations; axes that are stated as
    # unobservable do not count.
    z: float = math.nan
    # Of the verdict's reasons.
    rules: list[str] = field(default_factory=list)


def run(arguments: argparse.Namespace) -> str:
    """Solve the cases, and write the text about them and those solved before into the page; returns
    the text.
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
    """Names of the recordings that faults are put into; simulated drives from a seed on."""
    seeds = range(first_seed, first_seed + _N_DRIVES)
    names = [f"hilly_{seed}" for seed in seeds]
    if folder:
        names += _TANGO
    return names


def cases(folder: Path | None, first_seed: int = 0) -> list[Case]:
    """All cases of the study: recordings without faults, with each fault, and clean recordings."""
    names = recordings(folder, first_seed)
    cases_of_study = _cases(_SOUND, 1, names)
    for code, fault in _FAULTS.items():
        cases_of_study += _cases(code, len(fault.severities), names)
    return cases_of_study + clean_cases(folder)


def clean_cases(folder: Path | None) -> list[Case]:
    """The clean recordings, by the default method."""
    names = clean_recordings.names(folder)
    return _cases(_CLEAN, 1, names, methods=("auto",))


def _cases(
    fault: str,
    n_severities: int,
    names: Sequence[str],
    methods: Sequence[MethodName] = METHODS,
) -> list[Case]:
    return [
        Case(fault=fault, severity=severity, recording=name, method=method)
        for severity in range(n_severities)
        for name in names
        for method in methods
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
    # All poses of real recordings, as a user would.
    options = clean.options if clean.is_real else {"max_pairs": _MAX_PAIRS}
    result = calibrate(clean.parent, clean.child, method=case.method, **options)
    return _judged(case.key, result, clean.T_parent_child)


def _named(findings: Iterable[Any]) -> list[str]:
    """Codes of findings; ``note:`` precedes the codes of notes."""
    codes = []
    for finding in findings:
        is_note = finding.severity is Severity.NOTE
        codes.append(f"note:{finding.code}" if is_note else finding.code)
    return codes


def _judged(
    key: str, result: Calibration, T_parent_child: FloatArray | None
) -> Outcome:
    """Outcome of a result; without a truth, errors are NaN."""
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
    is_seen = np.isfinite(result.sigmas)
    sigmas = np.maximum(result.sigmas[is_seen], 1e-9)
    ratios = np.abs(errors[is_seen]) / sigmas
    radians = np.linalg.norm(xi[3:])
    return replace(
        outcome,
        metres=float(np.linalg.norm(translation_errors[is_seen[:3]])),
        degrees=float(np.degrees(radians)),
        z=float(ratios.max(initial=0.0)),
    )


class _Sound(NamedTuple):
    """A recording without a fault, and its answer."""

    parent: Trajectory
    child: Trajectory
    T_parent_child: FloatArray


@cache
def _sound(name: str, method: MethodName, folder: Path | None) -> _Sound:
    """Return a recording without a fault; the answer of a real one has no fault either."""
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
    offset = next(f for f in checked.findings if f.code == "time_offset")
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
        fault, *_ = outcome.key.split()
        by_fault.setdefault(fault, []).append(outcome)
    clean = by_fault.pop(_CLEAN, [])
    sound = by_fault.pop(_SOUND, [])
    faulty = list(chain.from_iterable(by_fault.values()))
    parts = []
    if faulty:
        parts += [_about(faulty), _unsafe_text(faulty), _sound_text(sound)]
    for title, faults in GROUPS.items():
        rows = []
        for case in faults:
            if case.code in by_fault:
                rows.append(_row(case, by_fault[case.code]))
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
        "whose answer without the fault counts as the truth. z is the largest error of an "
        "axis, divided by its standard deviation with the allowance. Verdicts "
        "and the three most frequent findings are counted: `no` is DO NOT USE, "
        "`care` USE WITH CARE."
    )


def _unsafe_text(faulty: Sequence[Outcome]) -> str:
    """Return the text about wrong results that may be used, with a line for each."""
    lines = []
    for outcome in faulty:
        if outcome.verdict == "USE" and outcome.z > _LIMIT_Z:
            millimetres = 1e3 * outcome.metres
            lines.append(
                f"- {outcome.key}: z {outcome.z:.1f}, {millimetres:.0f} mm, "
                f"{outcome.degrees:.2f} deg"
            )
    end = ":" if lines else "."
    about = (
        f"{len(lines)} of them are more than {_LIMIT_Z:g} standard deviations off and called "
        f"USE{end}"
    )
    listed = "\n".join(lines)
    return f"{about}\n{listed}"


def _sound_text(sound: Sequence[Outcome]) -> str:
    """Return the text about the same recordings without a fault."""
    largest = max((outcome.z for outcome in sound), default=0.0)
    return (
        f"Without a fault, these recordings end in {_verdicts_in_full(sound)}; z is "
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
        """Whether a finding is wrong, a reason is not physical, or an error is large."""
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
    """Whether all reasons of the verdict state how the recording is."""
    return _PHYSICAL.issuperset(outcome.rules)


def _clean_groups(
    outcomes: Sequence[Outcome], folder: Path | None
) -> dict[str, _CleanGroup]:
    """Return the clean recordings by kind; only the first wrong finding of each counts."""
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
    """Return how clean recordings end, and which findings in them are wrong."""
    groups = _clean_groups(outcomes, folder)
    n_wrong = sum(len(group.wrong_codes) for group in groups.values())
    n_own = sum(_is_physical(outcome) for outcome in outcomes)
    rows = [
        group.row(kind) for kind, group in groups.items() if group.is_listed()
    ]
    return (
        f"Wrong findings in {n_wrong} of {len(outcomes)} clean recordings, solved with the default "
        f"method. {n_own} of {len(outcomes)} results are called USE or have reasons that the "
        "recording itself has: an axis that the motion does not show, or less well than the "
        "target, the common-mode floor, outliers, a finding that is right. Listed are the others, "
        f"and what is more than {_LIMIT_Z:g} standard deviations off.\n\n{markdown_table(rows)}"
    )
