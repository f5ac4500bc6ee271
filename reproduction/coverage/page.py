"""The study as a page: tables, goals, and the comparison with version 0.1."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reproduction.coverage.classes import CLASSES, REFUSED
from reproduction.coverage.measures import KINDS, LEAST, POOLED, Row
from reproduction.writing import markdown_table

_COLUMNS = {
    "simulated": ("bound", "bound_t", "bound_r", "nees", "covers", "answered", "refused"),
    "mixed": ("bound", "bound_t", "bound_r", "nees", "covers", "answered"),
    "levels": ("mm", "deg", "covers", "answered"),
    "known answer": ("mm", "deg", "z", "covers", "covers_floor", "covers_truth"),
    "rig": ("scatter",),
    "parts": ("scatter",),
    "cycle": ("mm", "deg", "chi2"),
    "refused": ("refused",),
}
_TITLES = {
    "simulated": "Simulated recordings",
    "mixed": "Simulated recordings, noise drawn at random",
    "levels": "The published trajectories of the paper",
    "known answer": "Real recordings with a known answer",
    "rig": "Recordings of one rig against each other",
    "parts": "Halves and thirds of a recording against each other",
    "cycle": "Three devices in a cycle",
    "refused": "Real recordings whose motion leaves something open",
}
_ABOUT = {
    "simulated": (
        "Errors are in units of the Cramer-Rao bound under the true noise: "
        "sqrt(median(e' C^-1 e) / 5.35), 1 is efficient. NEES is the squared error under the "
        "stated covariance: 5.35 is honest. The pooled row has the geometric mean of the errors."
    ),
    "mixed": (
        "The same measures where every recording has another mixture of noise, rate and lever arm: "
        "a check that the estimator is not tuned to the classes above."
    ),
    "levels": "Medians over the 38 trajectories of each level of noise, outliers and drift.",
    "known answer": (
        "Errors over the axes that the truth and the motion both know. The last column adds the "
        "uncertainty of the truth itself to the stated one."
    ),
    "rig": "Standard deviation of the answers over the stated one; 1 is honest.",
    "parts": "The same, three degrees of freedom per axis and recording.",
    "cycle": (
        "What the product of the three answers misses the identity by, and that over the stated "
        "covariances: below 12.6 in 95 % of honest cases."
    ),
    "refused": "A vehicle on a flat road, an arm that turns about one axis: no answer may be `ok`.",
}
_PERCENT = ("covers", "covers_floor", "covers_truth", "answered", "refused")


@dataclass(frozen=True)
class Goal:
    """Something that was aimed at, and whether it is reached."""

    text: str
    value: str
    is_met: bool


def page(rows: Sequence[Row], earlier: Mapping[str, Row], absent: Sequence[str], seeds: int) -> str:
    """The page in Markdown, from rows, those of version 0.1 by key, folders of recordings that were
    not there, and the number of recordings per class.
    """
    blocks = [
        "# Certified coverage",
        "Made by `make coverage-study`; do not edit. Is the error as small as it can be, and does "
        "the stated uncertainty hold? On simulated recordings the least possible error is known, "
        "on real ones sometimes the answer. Wherever it is not, repeats and cycles tell.",
        f"Absent, and left out: {', '.join(absent)}." if absent else "",
    ]
    methods = list(dict.fromkeys(row.method for row in rows))
    blocks += ["## Goals", _goal_table({one: goals(rows, one, earlier) for one in methods})]
    for table, columns in _COLUMNS.items():
        chosen = [row for row in rows if row.table == table]
        if chosen:
            blocks += [f"## {_TITLES[table]}", _ABOUT[table], _table(chosen, columns)]
    blocks += ["## The simulated classes", _class_table(seeds)]
    return "\n\n".join(block for block in blocks if block) + "\n"


def _goal_table(found: Mapping[str, Sequence[Goal]]) -> str:
    """A column per method; what is missed is bold."""
    values: dict[str, dict[str, str]] = {}
    for method, reached in found.items():
        for goal in reached:
            value = goal.value if goal.is_met else f"**{goal.value}**"
            values.setdefault(goal.text, {})[method] = value
    rows = (
        {"goal": text} | {each: by.get(each, "") for each in found} for text, by in values.items()
    )
    return "Bold is missed.\n\n" + markdown_table(rows)


def _table(rows: Iterable[Row], columns: Sequence[str]) -> str:
    by_name: dict[str, list[Row]] = {}
    for row in rows:
        by_name.setdefault(row.name, []).append(row)
    return markdown_table(
        {"": row.name, "method": row.method}
        | {KINDS[kind].title: cell(row, kind) for kind in columns}
        | {"CPU (s)": f"{row.seconds:.2f}"}
        for same in by_name.values()
        for row in same
    )


def cell(row: Row, kind: str) -> str:
    """A measure as text; empty if it was not taken."""
    value = row.value(kind)
    if np.isnan(value):
        return ""
    if kind in _PERCENT:
        return f"{100.0 * value:.0f} %"
    return f"{value:.3f}" if kind == "deg" else f"{value:.2f}" if value < 100 else f"{value:.0f}"


def _class_table(seeds: int) -> str:
    rows = (
        {
            "class": name,
            "duration (s)": f"{kind.duration_s:g}",
            "rate (Hz)": f"{kind.rate_hz:g}",
            "lever arm (m)": f"{kind.lever_m:g}",
            "bound": kind.bound_from,
        }
        for name, kind in CLASSES.items()
    )
    return (
        f"{seeds} recordings each; motions in `reproduction/coverage/motions.py`, noise in "
        f"`reproduction/coverage/classes.py`.\n\n{markdown_table(rows)}"
    )


def goals(rows: Sequence[Row], method: str, earlier: Mapping[str, Row]) -> list[Goal]:
    """What was aimed at, for one method."""
    tables: dict[str, dict[str, Row]] = {table: {} for table in _COLUMNS}
    for row in rows:
        if row.method == method:
            tables[row.table][row.name] = row
    reached: list[Goal] = []
    if POOLED["simulated"] in tables["simulated"]:
        reached += _class_goals(tables["simulated"])
    if POOLED["known answer"] in tables["known answer"]:
        reached += _truth_goals(tables["known answer"])
    if POOLED["rig"] in tables["rig"]:
        scatter = tables["rig"][POOLED["rig"]].value("scatter")
        reached.append(_between("scatter of rigs over sigma 0.8 to 1.25", scatter, 0.8, 1.25))
    for row in tables["cycle"].values():
        reached.append(_between(f"{row.name} closes to 0.10 deg", row.value("deg"), 0, 0.1))
        reached.append(_between("its chi2 is below 12.6", row.value("chi2"), 0, 12.6))
    if POOLED["refused"] in tables["refused"]:
        share = tables["refused"][POOLED["refused"]].value("refused")
        reached.append(_between("what leaves something open is refused", share, 1.0, 1.0))
    reached += _level_goals(tables["levels"].values(), earlier)
    return reached + _progress(
        [*tables["simulated"].values(), *tables["known answer"].values()], earlier
    )


def _class_goals(found: Mapping[str, Row]) -> list[Goal]:
    together = found[POOLED["simulated"]]
    each = [row for name, row in found.items() if name in CLASSES and name not in REFUSED]
    worst = max(each, key=lambda row: row.value("bound"))
    least = min(each, key=lambda row: row.value("covers"))
    return [
        _between("error over bound, geometric mean at most 1.10", together.value("bound"), 0, 1.1),
        _between("no class above 1.5", worst.value("bound"), 0, 1.5, worst.name),
        _between("median NEES 4.5 to 6.5", together.value("nees"), 4.5, 6.5),
        _between("90 % intervals cover 0.87 to 0.93", together.value("covers"), 0.87, 0.93),
        _between("at least 0.80 in every class", least.value("covers"), 0.8, 1.0, least.name),
        *(
            _between(f"{name} is refused", found[name].value("refused"), 1.0, 1.0)
            for name in REFUSED
            if name in found
        ),
    ]


def _truth_goals(found: Mapping[str, Row]) -> list[Goal]:
    together = found[POOLED["known answer"]]
    text = "real 90 % intervals with the floor cover at least 0.85"
    reached = [_between(text, together.value("covers_floor"), 0.85, 1.0)]
    stereo = [row for name, row in found.items() if name.startswith("euroc_stereo ")]
    if stereo:
        mm, deg = (max(row.value(kind) for row in stereo) for kind in ("mm", "deg"))
        reached.append(_between("EuRoC stereo within 20 mm", mm, 0, 20))
        reached.append(_between("EuRoC stereo within 0.30 deg", deg, 0, 0.30))
    return reached


def _level_goals(rows: Iterable[Row], earlier: Mapping[str, Row]) -> list[Goal]:
    """Errors at each level of the paper over those of ``adaptive`` in version 0.1."""
    ratios, rows = {}, list(rows)
    for row in rows:
        before = earlier[replace(row, method="adaptive").key]
        for kind, least in LEAST.items():
            now, was = (max(one.value(kind), least) for one in (row, before))
            ratios[f"{row.name}, {kind}"] = now / was
    if not ratios:
        return []
    worst = max(ratios, key=lambda name: ratios[name])
    text = "each level of the paper over adaptive of 0.1, medians, at most 1.05"
    return [_between(text, ratios[worst], 0, 1.05, worst), *_paired_level_goal(rows, earlier)]


def _paired_level_goal(rows: Iterable[Row], earlier: Mapping[str, Row]) -> Iterator[Goal]:
    """The same, trajectory by trajectory: medians of 38 scatter by a tenth."""
    paired = {}
    for row in rows:
        before = earlier[replace(row, method="adaptive").key].cases
        for kind, least in LEAST.items():
            now, was = row.cases[kind], before[kind]
            logs = [
                np.log(max(now[key], least) / max(was[key], least)) for key in was if key in now
            ]
            error = float(np.std(logs)) / max(len(logs), 1) ** 0.5
            paired[f"{row.name}, {kind}"] = (float(np.exp(np.mean(logs))), error)
    worst = max(paired, key=lambda name: paired[name][0])
    ratio, error = paired[worst]
    text = "the same trajectory by trajectory, geometric means"
    yield _between(text, ratio, 0, 1.05, f"+- {ratio * error:.2g}, {worst}")


def _between(text: str, value: float, low: float, high: float, where: str = "") -> Goal:
    said = f"{value:.3g}" + (f" ({where})" if where else "")
    return Goal(text, said, bool(low <= value <= high))


def _progress(rows: Iterable[Row], earlier: Mapping[str, Row]) -> list[Goal]:
    """Errors over those of ``dnlo`` with reference auto in version 0.1."""
    ratios = {
        (kind, row.table, row.name): ratio
        for row in rows
        for kind in ("mm", "deg")
        if (ratio := _against_earlier(row, kind, earlier)) is not None
    }
    real = {key: ratio for key, ratio in ratios.items() if key[1] == "known answer"}
    if not real:
        return []
    mm, deg = (
        float(np.exp(np.mean([np.log(ratio) for key, ratio in ratios.items() if key[0] == kind])))
        for kind in ("mm", "deg")
    )
    worst = max(real, key=lambda key: real[key])
    where = f"{worst[2]}, {worst[0]}"
    return [
        _between("translation error over dnlo of 0.1, at most 0.90", mm, 0, 0.90),
        _between("rotation error over dnlo of 0.1, at most 0.55", deg, 0, 0.55),
        _between("no real set worse than 1.3 times", real[worst], 0, 1.3, where),
    ]


def _against_earlier(row: Row, kind: str, earlier: Mapping[str, Row]) -> float | None:
    """An error over that of ``dnlo`` in version 0.1; what is smaller than the uncertainty of the
    truth counts as that.
    """
    before = earlier.get(replace(row, method="dnlo").key)
    if before is None or kind not in row.cases or kind not in before.cases:
        return None
    known_to = float(np.nan_to_num(row.value(f"{kind}_truth")))
    return max(row.value(kind), known_to) / max(before.value(kind), known_to)
