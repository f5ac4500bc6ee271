"""Study of faults: each one in simulated and real recordings, in three severities. Which finding
names it, what the verdict is, and how wrong the answer is, in its own standard deviations.

``python -m reproduction faults --data-folder DIR --page docs/faults.md`` writes the page. A run
that was interrupted goes on from ``faults.jsonl``. ``--clean`` solves the clean recordings alone.
"""

import argparse
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

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
from reproduction.fault_cases import GROUPS, Fault
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

_FAULTS = {fault.code: fault for fault in chain(*GROUPS.values())}

# Rules of the verdict that state how a recording is, not that something is wrong.
_PHYSICAL = frozenset(
    {"unobservable", "nothing_known", "target", "floor", "outliers", "warning_finding"}
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
        """Its name."""
        return f"{self.fault} {self.severity} {self.recording} {self.method}"


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
    todo = clean_cases(folder) if arguments.clean else cases(folder, arguments.seed)
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
    return [f"hilly_{seed}" for seed in seeds] + list(_TANGO if folder else ())


def cases(folder: Path | None, first_seed: int = 0) -> list[Case]:
    """All cases of the study: recordings without faults, with each fault, and clean recordings."""
    names = recordings(folder, first_seed)
    faulty = (
        _cases(code, len(fault.severities), names) for code, fault in _FAULTS.items()
    )
    return [
        *_cases(_SOUND, 1, names),
        *chain.from_iterable(faulty),
        *clean_cases(folder),
    ]


def clean_cases(folder: Path | None) -> list[Case]:
    """The clean recordings, by the default method."""
    return _cases(_CLEAN, 1, clean_recordings.names(folder), ("auto",))


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
    parent, child, T_parent_child, options = _sound(case.recording, case.method, folder)
    fault = _FAULTS.get(case.fault)
    if fault:
        random = np.random.default_rng(sum(map(ord, case.recording)))
        parent, child = fault.damage(
            parent, child, fault.severities[case.severity], random
        )
        options = {**options, **fault.options}
    try:
        result = calibrate(
            parent, child, method=case.method, max_pairs=_MAX_PAIRS, **options
        )
    except HandEyeCalibError:
        return Outcome(
            key=case.key,
            verdict=_NO_ANSWER,
            findings=_named(check_streams(parent, child).findings),
        )
    return _judged(case.key, result, T_parent_child)


def _of_clean(case: Case, folder: Path | None) -> Outcome:
    clean = clean_recordings.recording(case.recording, folder)
    # All poses of real recordings, as a user would.
    options = clean.options if clean.is_real else {"max_pairs": _MAX_PAIRS}
    result = calibrate(clean.parent, clean.child, method=case.method, **options)
    return _judged(case.key, result, clean.T_parent_child)


def _named(findings: Iterable[Any]) -> list[str]:
    return [
        ("note:" if finding.severity is Severity.NOTE else "") + finding.code
        for finding in findings
    ]


def _judged(
    key: str, result: Calibration, T_parent_child: FloatArray | None
) -> Outcome:
    outcome = Outcome(
        key=key,
        verdict=result.verdict.value,
        findings=_named(result.findings),
        rules=[reason.rule for reason in result.reasons],
    )
    if T_parent_child is None:
        return outcome
    xi = se3.log(se3.inverse(T_parent_child) @ result.T_parent_child)
    rotation = T_parent_child[:3, :3]
    along = np.concatenate([rotation @ xi[:3], rotation @ xi[3:]])
    seen = np.isfinite(result.sigmas)
    ratios = np.abs(along[seen]) / np.maximum(result.sigmas[seen], 1e-9)
    return replace(
        outcome,
        metres=float(np.linalg.norm(along[:3][seen[:3]])),
        degrees=float(np.degrees(np.linalg.norm(xi[3:]))),
        z=float(ratios.max(initial=0.0)),
    )


_Sound = tuple[Trajectory, Trajectory, FloatArray, dict[str, Any]]


@cache
def _sound(name: str, method: MethodName, folder: Path | None) -> _Sound:
    """A recording without a fault, its answer and the options that it needs."""
    if name.startswith("hilly"):
        drive = simulate_drive(int(name.rsplit("_", 1)[1]), HILLY_DRIVE, _NOISE)
        return drive.parent, drive.child, drive.T_parent_child, {}
    rig = next(rig for rig in real_rigs(folder or Path())[0] if rig.name == name)
    (recording,) = rig.recordings.values()
    checked = check_streams(recording.parent, recording.child)
    parent = recording.parent
    child = recording.child
    offset = next(f for f in checked.findings if f.code == "time_offset")
    child = child.shifted(float(offset.options["time_offset"]))
    fit = checked.fit
    child = child.scaled(fit.scale if fit else 1.0)
    result = calibrate(parent, child, method=method, max_pairs=_MAX_PAIRS)
    return parent, child, result.T_parent_child, {}


# ------------------------------------------------------------------ the page


def report(outcomes: Sequence[Outcome], folder: Path | None) -> str:
    """Text of the page."""
    by_fault: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        by_fault.setdefault(outcome.key.split()[0], []).append(outcome)
    clean = by_fault.pop(_CLEAN, [])
    sound = by_fault.pop(_SOUND, [])
    faulty = list(chain.from_iterable(by_fault.values()))
    unsafe = [
        outcome
        for outcome in faulty
        if outcome.verdict == "USE" and outcome.z > _LIMIT_Z
    ]
    parts = []
    if faulty:
        parts += [
            f"{len(faulty)} calibrations with `{'` or `'.join(METHODS)}`: of simulated hilly "
            "drives of 120 s at 1.5 m/s (hilly), and of recordings of hand-held devices (tango), "
            "whose answer without the fault counts as the truth. z is the largest error of an axis "
            "in its standard deviations with the floor. Verdicts and the three most frequent "
            "findings are counted: `no` is DO NOT USE, `care` USE WITH CARE.",
            f"{len(unsafe)} of them are more than {_LIMIT_Z:g} standard deviations off and called "
            f"USE{':' if unsafe else '.'}\n"
            + "\n".join(
                f"- {outcome.key}: z {outcome.z:.1f}, {1e3 * outcome.metres:.0f} mm, "
                f"{outcome.degrees:.2f} deg"
                for outcome in unsafe
            ),
            f"Without a fault, these recordings end in {counted(f.verdict for f in sound)}; z is "
            f"at most {max((f.z for f in sound), default=0.0):.1f}.",
        ]
    for title, faults in GROUPS.items():
        rows = [
            _row(fault, by_fault[fault.code])
            for fault in faults
            if fault.code in by_fault
        ]
        if rows:
            parts.append(f"### {title}\n\n" + markdown_table(rows))
    if clean:
        parts.append("### No false alarms\n\n" + _clean_text(clean, folder))
    return "\n\n".join(parts)


def _row(fault: Fault, outcomes: Sequence[Outcome]) -> dict[str, str]:
    named = (
        code.removeprefix("note:")
        for outcome in outcomes
        for code in dict.fromkeys(outcome.findings)
        if not code.endswith(("gaps", "one_axis"))
    )
    answered = [outcome for outcome in outcomes if math.isfinite(outcome.z)]
    return {
        "": fault.code,
        "fault": fault.what,
        "findings": counted(named, most=3) or "none",
        "verdicts": counted(
            _SHORT.get(outcome.verdict, outcome.verdict) for outcome in outcomes
        ),
        "largest z": f"{max(outcome.z for outcome in answered):.1f}"
        if answered
        else "",
    }


def _clean_text(outcomes: Sequence[Outcome], folder: Path | None) -> str:
    """How clean recordings end, and what was found in them that is not there."""
    kinds: dict[str, list[Outcome]] = {}
    wrong: dict[str, list[str]] = {}
    for outcome in outcomes:
        name = outcome.key.split(" ", 2)[2].rpartition(" ")[0]
        known_codes = clean_recordings.known_in(name, folder)
        codes = [
            c
            for c in outcome.findings
            if not c.startswith("note:") and c not in known_codes
        ]
        kinds.setdefault(clean_recordings.kind_of(name), []).append(outcome)
        wrong.setdefault(clean_recordings.kind_of(name), []).extend(codes[:1])
    n_wrong = sum(map(len, wrong.values()))
    n_own = sum(not set(outcome.rules) - _PHYSICAL for outcome in outcomes)
    rows = [
        {
            "clean recordings": kind,
            "solved": len(group),
            "wrong findings": counted(wrong[kind]) or "none",
            "verdict": counted(
                _SHORT.get(outcome.verdict, outcome.verdict) for outcome in group
            ),
            "reasons": counted(
                rule for outcome in group for rule in dict.fromkeys(outcome.rules)
            ),
            "largest z": f"{max((o.z for o in group if o.z == o.z), default=0.0):.1f}",
        }
        for kind, group in kinds.items()
        if wrong[kind]
        or any(
            set(outcome.rules) - _PHYSICAL or outcome.z > _LIMIT_Z for outcome in group
        )
    ]
    return (
        f"Wrong findings in {n_wrong} of {len(outcomes)} clean recordings, solved with the default "
        f"method. {n_own} of {len(outcomes)} results are called USE or have reasons that the "
        "recording itself has: an axis that the motion does not show, or less well than the "
        "target, the common-mode floor, outliers, a finding that is right. Listed are the others, "
        f"and what is more than {_LIMIT_Z:g} standard deviations off.\n\n{markdown_table(rows)}"
    )
