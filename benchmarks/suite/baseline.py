"""What a run is compared with: ratios within the run. Absolute times depend on the machine."""

from suite.data import LONG, MESSAGES, SHORT

# A ratio may fall to this share of the baseline's.
TOLERATED_RATIO = 1 / 3
# How far above Ipopt's the fast objective may end, relative: rounding.
TOLERATED_EXCESS = 1e-6

# One pass of numpy over the bytes of the pairs: nothing that looks at them all can be faster.
FLOOR = "floor"
OPENCV = "opencv, the fastest"
NUMPY = "import numpy"

# What is aimed at: ratios of at least, rows of less than so many seconds.
_AT_LEAST = {
    f"dnlo ipopt / dnlo fast, {SHORT}": 300,
    f"dnlo ipopt / dnlo fast, {LONG}": 1000,
    f"{OPENCV} / dnlo fast, {LONG}": 1000,
    "floor / dnlo fast, 100000": 1 / 20,
    f"{NUMPY} / files to result, {LONG + 5}": 1 / 4,
}
_BELOW_S = {
    "dnlo fast, 1000000": 5.0,
    f"add_pose, 99th percentile, {MESSAGES}": 50e-6,
    f"files to result, wall, {LONG + 5}": 1.0,
    "calibrate --help, 0": 0.3,
    "replay --help, 0": 0.3,
}
_MOST_BYTES = {1_000_000: 1e9}


def ratios(rows, memory):
    """How many times faster each row is than what it is measured against, a dict by "slow / fast,
    size"; more is better.

    Parameters
    ----------
    rows : iterable of Row
    memory : dict
        As of :func:`suite.processes.memory`.
    """
    seconds = {(row.name, row.size): row.seconds for row in rows}
    numpy_s = next((row.seconds for row in rows if row.name == NUMPY), None)
    found = {}
    for (name, size), own in seconds.items():
        for other in _measured_against(name):
            slow = numpy_s if other == NUMPY else seconds.get((other, size))
            if slow:
                found[f"{other} / {name}, {size}"] = slow / own
    for size, (before, peak, data) in memory.items():
        found[f"memory of the pairs / of solving them, {size}"] = data / (
            peak - before
        )
    return found


def _measured_against(name):
    """Which other rows of the same size tell whether a row is slow."""
    if name.startswith("bag: read"):
        return ["rosbags alone," + name.partition(",")[2]]
    if " to result" in name or name.endswith("--help"):
        return [NUMPY] if "wall" not in name else []
    if name == FLOOR or name.startswith("opencv") or name.endswith("ipopt"):
        return []
    found = [FLOOR]
    if name.endswith(" fast"):
        found.append(name.replace("fast", "ipopt"))
    return found + [OPENCV] * (name == "dnlo fast")


def failures(rows, ratios, known):
    """One line per way in which a run falls short of the ratios that are known."""
    has_opencv = any(row.name.startswith("opencv") for row in rows)
    found = []
    for name, ratio in known.items():
        if name in ratios and ratios[name] < ratio * TOLERATED_RATIO:
            found.append(
                f"{name}: {ratios[name]:.3g}, below a third of the baseline's {ratio:.3g}"
            )
        elif name not in ratios and (has_opencv or "opencv" not in name):
            found.append(f"{name}: ratio is missing")
    by_key = {row.key: row for row in rows}
    for key, row in by_key.items():
        slow = by_key.get(key.replace(" fast", " ipopt"))
        if (
            " fast" in key
            and slow
            and row.objective > slow.objective * (1 + TOLERATED_EXCESS)
        ):
            found.append(
                f"{key}: objective {row.objective:.9g} is above ipopt's {slow.objective:.9g}"
            )
    return found


def aims(rows, memory):
    """What the package aims at, as text: [what, aim, measured, whether it is met]; rows that were
    not measured are left out.
    """
    measured = ratios(rows, memory)
    seconds = {row.key: row.seconds for row in rows}
    found = [
        (
            name,
            f"at least {aim:g}",
            f"{measured[name]:.3g}",
            measured[name] >= aim,
        )
        for name, aim in _AT_LEAST.items()
        if name in measured
    ]
    found += [
        (
            name,
            f"below {aim:g} s",
            f"{seconds[name]:.3g} s",
            seconds[name] < aim,
        )
        for name, aim in _BELOW_S.items()
        if name in seconds
    ]
    for size, most in _MOST_BYTES.items():
        if size in memory:
            peak = memory[size][1]
            text = f"{peak / 1e9:.2f} GB"
            found.append(
                (
                    f"peak memory, {size}",
                    f"below {most / 1e9:g} GB",
                    text,
                    peak < most,
                )
            )
    return [[*line, "yes" if is_met else "no"] for *line, is_met in found]
