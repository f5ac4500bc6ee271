"""Study of faults: each one in simulated and real recordings, in three severities. Which finding
names it, what the verdict is, and how wrong the answer is, in its own standard deviations.

``python -m reproduction faults --data-folder DIR --page docs/faults.md`` writes the page. A run
that was interrupted goes on from ``faults.jsonl``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.calibration import Calibration
from hand_eye_calib.checks.check import check_streams
from hand_eye_calib.checks.findings import Severity
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.errors import HandEyeCalibError
from hand_eye_calib.geometry import se3
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.simulation.drive import simulate_drive
from hand_eye_calib.simulation.options import HILLY_DRIVE, NoiseConfig
from reproduction.coverage.classes import CLASSES, make
from reproduction.coverage.real_sets import Rig, real_rigs
from reproduction.fault_cases import FAULTS, UNTUNED, Fault
from reproduction.writing import markdown_table, put_into_page

METHODS = ("dnlo", "auto")
_SEEDS, _CLEAN_SEEDS = (0, 1, 2), range(5)
_NOISE = NoiseConfig(gaussian=0.003)
_TANGO = ("tango_caligula_mars", "tango_mars_nero")
_LIMIT_Z = 3.0

# Poses are downsampled to so many for the solves; the checks see all.
_MAX_PAIRS = 400

_NO_ANSWER = "no answer"

# What is really there in recordings: of others, what their options say.
_KNOWN = {
    "hand_mixture_30s": frozenset({"jumps"}),
    "primesense": frozenset({"jumps", "time_offset"}),
    "robot_arm": frozenset({"time_offset"}),
    "kitti_long": frozenset({"scale"}),
}


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is solved: a fault in one recording, by one method. No fault for "clean"."""

    fault: str
    severity: int
    recording: str
    method: str

    @property
    def key(self) -> str:
        """Its name."""
        return f"{self.fault} {self.severity} {self.recording} {self.method}"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a case ended.

    Attributes
    ----------
    key : str
    verdict : str
    findings : list of str
        Codes of errors and warnings, ``note:`` before those of notes.
    metres, degrees : float
        Error of the answer.
    z : float
        Largest error of an axis in its stated standard deviations; axes that are stated as
        unobservable do not count.
    """

    key: str
    verdict: str
    findings: list[str]
    metres: float = math.nan
    degrees: float = math.nan
    z: float = math.nan


def run(
    folder: Path | None, out: Path, page: Path | None, jobs: int, advance: Callable[[str], None]
) -> str:
    """Run the study, and write its text into the page; returns the text."""
    out.mkdir(parents=True, exist_ok=True)
    store = out / "faults.jsonl"
    known = _stored(store)
    todo = [case for case in cases(folder) if case.key not in known]
    with ProcessPoolExecutor(jobs) as pool, open(store, "a", encoding="utf-8") as file:
        solving = [pool.submit(outcome, case, folder) for case in todo]
        for solved in as_completed(solving):
            found = solved.result()
            known[found.key] = found
            file.write(json.dumps(asdict(found)) + "\n")
            file.flush()
            advance(found.key)
    text = report(list(known.values()), false_alarms(folder))
    (out / "faults.md").write_text(text, encoding="utf-8")
    if page is not None:
        put_into_page(page, "faults", text)
    return text


def _stored(store: Path) -> dict[str, Outcome]:
    if not store.exists():
        return {}
    lines = store.read_text(encoding="utf-8").splitlines()
    return {found.key: found for found in (Outcome(**json.loads(line)) for line in lines)}


def recordings(folder: Path | None) -> list[str]:
    """Names of the recordings that faults are put into."""
    return [f"hilly_{seed}" for seed in _SEEDS] + list(_TANGO if folder else ())


def cases(folder: Path | None) -> list[Case]:
    """All cases of the study."""
    return [
        Case(fault=code, severity=severity, recording=recording, method=method)
        for code, count in _severities().items()
        for severity in range(count)
        for recording in recordings(folder)
        for method in METHODS
    ]


def _severities() -> dict[str, int]:
    """Number of severities of each fault, and one of no fault."""
    return {"clean": 1} | {fault.code: len(fault.severities) for fault in (*FAULTS, *UNTUNED)}


def outcome(case: Case, folder: Path | None) -> Outcome:
    """Solve a case."""
    parent, child, T_parent_child, options = _sound(case.recording, case.method, folder)
    fault = _FAULTS.get(case.fault)
    if fault:
        random = np.random.default_rng(sum(map(ord, case.recording)))
        parent, child = fault.damage(parent, child, fault.severities[case.severity], random)
        options = options | fault.options
    try:
        result = calibrate(parent, child, method=case.method, max_pairs=_MAX_PAIRS, **options)
    except HandEyeCalibError:
        return Outcome(key=case.key, verdict=_NO_ANSWER, findings=_codes(parent, child))
    return _judged(case.key, result, T_parent_child)


_FAULTS: dict[str, Fault] = {fault.code: fault for fault in (*FAULTS, *UNTUNED)}


def _codes(parent: Trajectory, child: Trajectory) -> list[str]:
    return _named(found.to_dict() for found in check_streams(parent, child).findings)


def _named(findings: Iterable[Any]) -> list[str]:
    return [
        ("note:" if found["severity"] == Severity.NOTE.value else "") + found["code"]
        for found in findings
    ]


def _judged(key: str, result: Calibration, T_parent_child: FloatArray) -> Outcome:
    error = se3.inverse(T_parent_child) @ result.T_parent_child
    xi = se3.log(se3.inverse(T_parent_child) @ result.T_parent_child)
    rotation = T_parent_child[:3, :3]
    along = np.concatenate([rotation @ xi[:3], rotation @ xi[3:]])
    known = np.isfinite(result.sigmas)
    ratios = np.abs(along[known]) / np.maximum(result.sigmas[known], 1e-9)
    return Outcome(
        key=key,
        verdict=result.verdict.value,
        findings=_named(result.findings),
        metres=float(np.linalg.norm(along[:3][known[:3]])),
        degrees=float(np.degrees(se3.rotation_angle(error[:3, :3]))),
        z=float(ratios.max(initial=0.0)),
    )


_Sound = tuple[Trajectory, Trajectory, FloatArray, dict[str, Any]]


@cache
def _sound(name: str, method: str, folder: Path | None) -> _Sound:
    """A recording without a fault, its answer and the options that it needs."""
    if name.startswith("hilly"):
        drive = simulate_drive(int(name.rsplit("_", 1)[1]), HILLY_DRIVE, _NOISE)
        return drive.parent, drive.child, drive.T_parent_child, {}
    rig = next(rig for rig in _rigs(folder) if rig.name == name)
    (recording,) = rig.recordings.values()
    found = check_streams(recording.parent, recording.child)
    parent, child = recording.parent, recording.child
    offset = next(f for f in found.findings if f.code == "time_offset")
    child = child.shifted(dict(offset.options)["time_offset"])
    fit = found.fit
    child = child.scaled(fit.scale if fit else 1.0)
    result = calibrate(parent, child, method=method, max_pairs=_MAX_PAIRS)
    return parent, child, result.T_parent_child, {}


@cache
def _rigs(folder: Path | None) -> tuple[Rig, ...]:
    return tuple(real_rigs(folder)[0]) if folder else ()


def false_alarms(folder: Path | None) -> list[tuple[str, int, list[str]]]:
    """Of clean recordings: kind, number, and what was found in them besides notes and besides
    offsets, scales and jumps that are known to be there.
    """
    rows = []
    for name in CLASSES:
        found = []
        for seed in _CLEAN_SEEDS:
            made = make(name, seed)
            found += _unknown(_serious(made.parent, made.child), _KNOWN.get(name, frozenset()))
        rows.append((name, len(_CLEAN_SEEDS), found))
    for rig in _rigs(folder):
        found = []
        known = _KNOWN.get(rig.name, frozenset()) | rig.options.keys()
        for recording in rig.recordings.values():
            found += _unknown(_serious(recording.parent, recording.child), known)
        rows.append((rig.name, len(rig.recordings), found))
    return rows


def _unknown(found: list[str], known: Iterable[str]) -> list[str]:
    return [each for each in found if each.split()[-1] not in known]


def _serious(parent: Trajectory, child: Trajectory) -> list[str]:
    return [
        f"{finding.severity.value} {finding.code}"
        for finding in check_streams(parent, child).findings
        if finding.severity is not Severity.NOTE
    ]


# ------------------------------------------------------------------ the page


def report(outcomes: Sequence[Outcome], alarms: Sequence[tuple[str, int, list[str]]]) -> str:
    """Text of the page."""
    by_key = {found.key: found for found in outcomes}
    parts = [
        f"{len(outcomes)} calibrations with `{'` or `'.join(METHODS)}`: of simulated hilly drives "
        "of 120 s at 1.5 m/s (hilly), and of recordings of hand-held devices (tango), whose answer "
        "without the fault counts as the truth. z is the largest error of an axis in its stated "
        "standard deviations; z and the error are the largest of all recordings and methods. "
        "Findings and verdicts are counted over recordings and methods, so that the verdicts say "
        "how many there are.",
        _unsafe_text(outcomes),
        "### Faults\n\n" + _table(FAULTS, by_key),
    ]
    if any(found.key.startswith(UNTUNED[0].code + " ") for found in outcomes):
        parts.append("### Faults that no limit was set with\n\n" + _table(UNTUNED, by_key))
    clean = [found for found in outcomes if found.key.startswith("clean ")]
    parts.append(
        "### No false alarms\n\nWithout a fault, the recordings above end in "
        f"{_counted(found.verdict for found in clean)}; z is at most "
        f"{max((found.z for found in clean), default=0.0):.1f}.\n\n" + _alarm_table(alarms)
    )
    return "\n\n".join(parts)


def _unsafe_text(outcomes: Sequence[Outcome]) -> str:
    faulty = [found for found in outcomes if not found.key.startswith("clean ")]
    unsafe = [found for found in faulty if found.verdict == "USE" and found.z > _LIMIT_Z]
    listed = "".join(
        f"\n- {found.key}: z {found.z:.1f}, {1e3 * found.metres:.0f} mm, {found.degrees:.2f} deg"
        for found in unsafe
    )
    return (
        f"Of {len(faulty)} calibrations with a fault, {len(unsafe)} are more than {_LIMIT_Z:g} "
        f"standard deviations off and called USE{':' if unsafe else '.'}{listed}"
    )


def _table(faults: Sequence[Fault], by_key: dict[str, Outcome]) -> str:
    header = ["", "fault", "severity", "recordings", "findings", "verdict", "error", "largest z"]
    rows = [row for fault in faults for row in _rows(fault, by_key)]
    return markdown_table(header, rows)


def _rows(fault: Fault, by_key: dict[str, Outcome]) -> Iterator[list[str]]:
    for index, severity in enumerate(fault.severities):
        for group in ("hilly", "tango"):
            found = [
                one
                for key, one in by_key.items()
                if key.startswith(f"{fault.code} {index} {group}")
            ]
            if not found:
                continue
            named = _counted(
                code.removeprefix("note:")
                for one in found
                for code in dict.fromkeys(one.findings)
                if not code.endswith(("gaps", "one_axis"))
            )
            answered = [one for one in found if math.isfinite(one.z)]
            yield [
                fault.code,
                fault.what,
                f"{severity:g} {fault.unit}".strip(),
                group,
                named or "none",
                _counted(one.verdict for one in found),
                _largest(answered),
                f"{max(one.z for one in answered):.1f}" if answered else "",
            ]


def _largest(found: Sequence[Outcome]) -> str:
    if not found:
        return ""
    metres, degrees = (max(getattr(one, name) for one in found) for name in ("metres", "degrees"))
    return f"{1e3 * metres:.0f} mm, {degrees:.2g} deg"


def _counted(words: Iterable[str]) -> str:
    """Words with how often they occur, the most frequent first."""
    counts: dict[str, int] = {}
    for word in words:
        counts[word] = counts.get(word, 0) + 1
    ranked = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{word} {count}" for word, count in ranked)


def _alarm_table(alarms: Sequence[tuple[str, int, list[str]]]) -> str:
    total, wrong = sum(count for _, count, _ in alarms), sum(len(found) for *_, found in alarms)
    rows = [[name, count, ", ".join(found) or "none"] for name, count, found in alarms]
    return f"{wrong} findings in {total} recordings:\n\n" + markdown_table(
        ["clean recordings", "number", "errors and warnings"], rows
    )
