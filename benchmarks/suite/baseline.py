"""Comparison of a run with the baseline, by ratios of times within the run.

Absolute times are not compared, because they depend on the machine.
"""

from suite.data import LONG, MESSAGES, SHORT

# Smallest share of the baseline's ratio that a ratio may have.
TOLERATED_RATIO = 1 / 3
# Largest share by which the objective of the fast backend may exceed Ipopt's, because of rounding.
TOLERATED_EXCESS = 1e-6

# Row for one pass of numpy over the bytes of the pairs. No method that reads all pairs is faster.
FLOOR = "floor"
OPENCV = "opencv, the fastest"
NUMPY = "import numpy"

# Aimed smallest ratios.
_AT_LEAST = {
    f"dnlo ipopt / dnlo fast, {SHORT}": 300,
    f"dnlo ipopt / dnlo fast, {LONG}": 1000,
    f"{OPENCV} / dnlo fast, {LONG}": 1000,
    "floor / dnlo fast, 100000": 1 / 20,
    f"{NUMPY} / files to result, {LONG + 5}": 1 / 4,
}
# Aimed largest times (s).
_BELOW_S = {
    "dnlo fast, 1000000": 5.0,
    f"add_pose, 99th percentile, {MESSAGES}": 50e-6,
    f"files to result, wall, {LONG + 5}": 1.0,
    "calibrate --help, 0": 0.3,
    "replay --help, 0": 0.3,
}
# Aimed largest memory (bytes) by number of pairs.
_MOST_BYTES = {1_000_000: 1e9}


def ratios(rows, memory):
    """Return the ratios of the times of other rows to the time of each row; larger is better.

    The keys are texts such as "slow / fast, size". Ratios of memory are included.

    Parameters
    ----------
    rows : iterable of Row
    memory : dict
        As of :func:`suite.processes.memory`.
    """
    seconds = {(row.name, row.size): row.seconds for row in rows}
    numpy_s = next((row.seconds for row in rows if row.name == NUMPY), None)
    ratio_of = {}
    for (name, size), own_s in seconds.items():
        for other in _measured_against(name):
            other_s = numpy_s if other == NUMPY else seconds.get((other, size))
            if other_s:
                ratio_of[f"{other} / {name}, {size}"] = other_s / own_s
    for size, (before, peak, data) in memory.items():
        solving = peak - before
        ratio_of[f"memory of the pairs / of solving them, {size}"] = (
            data / solving
        )
    return ratio_of


def _measured_against(name):
    """Return the names of the rows of the same size with which a row is compared."""
    if name.startswith("bag: read"):
        return ["rosbags alone," + name.partition(",")[2]]
    if " to result" in name or name.endswith("--help"):
        return [NUMPY] if "wall" not in name else []
    if name == FLOOR or name.startswith("opencv") or name.endswith("ipopt"):
        return []
    others = [FLOOR]
    if name.endswith(" fast"):
        others.append(name.replace("fast", "ipopt"))
    if name == "dnlo fast":
        others.append(OPENCV)
    return others


def failures(rows, ratios, stored):
    """Return a line for each ratio that is missing or too small, and each objective too large.

    ``stored`` contains the ratios of the baseline.
    """
    has_opencv = any(row.name.startswith("opencv") for row in rows)
    lines = []
    for name, ratio in stored.items():
        if name in ratios and ratios[name] < ratio * TOLERATED_RATIO:
            lines.append(
                f"{name}: {ratios[name]:.3g}, below a third of the baseline's {ratio:.3g}"
            )
        elif name not in ratios and (has_opencv or "opencv" not in name):
            lines.append(f"{name}: ratio is missing")
    by_key = {row.key: row for row in rows}
    for key, row in by_key.items():
        ipopt = by_key.get(key.replace(" fast", " ipopt"))
        if " fast" not in key or ipopt is None:
            continue
        if row.objective > ipopt.objective * (1 + TOLERATED_EXCESS):
            lines.append(
                f"{key}: objective {row.objective:.9g} is above ipopt's {ipopt.objective:.9g}"
            )
    return lines


def aims(rows, memory):
    """Return the aims of the package as texts: [row, aim, measured, whether the aim is met].

    Aims of rows that were not measured are left out.
    """
    measured = ratios(rows, memory)
    seconds = {row.key: row.seconds for row in rows}
    lines = []
    for name, aim in _AT_LEAST.items():
        if name in measured:
            ratio = measured[name]
            is_met = ratio >= aim
            lines.append((name, f"at least {aim:g}", f"{ratio:.3g}", is_met))
    for name, aim in _BELOW_S.items():
        if name in seconds:
            time_s = seconds[name]
            is_met = time_s < aim
            lines.append((name, f"below {aim:g} s", f"{time_s:.3g} s", is_met))
    for size, most in _MOST_BYTES.items():
        if size in memory:
            _, peak, _ = memory[size]
            name = f"peak memory, {size}"
            aim = f"below {most / 1e9:g} GB"
            lines.append((name, aim, f"{peak / 1e9:.2f} GB", peak < most))
    return [[*texts, "yes" if is_met else "no"] for *texts, is_met in lines]
