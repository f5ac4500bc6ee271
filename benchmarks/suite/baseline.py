"""What a run is compared with: which rows there are, and ratios within the run. Absolute times
depend on the machine.
"""

from suite.data import ENGINE_MESSAGES, LONG, SHORT

# A ratio may fall to this share of the baseline's.
TOLERATED_RATIO = 1 / 3
# How far above Ipopt's the fast objective may end, relative: rounding.
TOLERATED_EXCESS = 1e-6

# One pass of numpy over the bytes of the pairs: nothing that looks at them all can be faster.
FLOOR = "floor"
_AGAINST = {
    "dnl fast": "dnl ipopt",
    "dnlo fast": "dnlo ipopt",
    "bag to result": "rosbags alone",
}
_PROCESSES = (
    "hand_eye_calib calibrate --help",
    "hand_eye_calib replay --help",
    "files to result",
    "files to result, reference B5",
)


def ratios(rows, memory):
    """How many times faster each row is than what it is measured against, a dict by "slow / fast,
    size"; more is better.

    Parameters
    ----------
    rows : iterable of Row
    memory : dict
        As of :func:`suite.processes.memory`.
    """
    found = {}
    seconds = {(row.name, row.size): row.seconds for row in rows}
    for (name, size), own in seconds.items():
        against = {_AGAINST.get(name), FLOOR if name != FLOOR and _is_compared(name) else None}
        if name == "dnlo fast":
            against.add("opencv, the fastest")
        if name.removesuffix(", processor") in _PROCESSES:
            found[f"import numpy / {name}"] = seconds["import numpy, processor", 0] / own
        for other in sorted(filter(None, against)):
            if (other, size) in seconds:
                found[f"{other} / {name}, {size}"] = seconds[other, size] / own
    for size, (before, peak, data) in memory.items():
        found[f"memory of the pairs / of solving them, {size}"] = data / (peak - before)
    return found


def summary(rows, memory):
    """What is kept of a run: two digits of the ratios, a third of which is all that is compared."""
    return {
        "rows": sorted(row.key for row in rows if _is_compared(row.key)),
        "ratios": {name: float(f"{ratio:.2g}") for name, ratio in ratios(rows, memory).items()},
    }


def _is_compared(key):
    """Not OpenCV's single methods: which of them runs on the long drive depends on which is the
    fastest.
    """
    return not key.startswith("opencv ")


def failures(rows, memory, baseline, is_more=False):
    """One line per way in which a run falls short of the baseline; ``is_more``: it may have rows
    that the baseline has not.
    """
    by_key = {row.key: row for row in rows}
    has_opencv = any(key.startswith("opencv") for key in by_key)
    measured = ratios(rows, memory)

    def is_due(name):
        return has_opencv or "opencv" not in name

    found = [
        f"{key}: row is missing" for key in filter(is_due, baseline["rows"]) if key not in by_key
    ]
    if not is_more:
        found += [
            f"{key}: not in the baseline; run with --update"
            for key in filter(_is_compared, by_key)
            if key not in baseline["rows"]
        ]
    for name, ratio in baseline["ratios"].items():
        if name in measured and measured[name] < ratio * TOLERATED_RATIO:
            found.append(
                f"{name}: {measured[name]:.3g}, below a third of the baseline's {ratio:.3g}"
            )
        elif name not in measured and is_due(name):
            found.append(f"{name}: ratio is missing")
    for key, row in by_key.items():
        slow = by_key.get(key.replace(" fast", " ipopt"))
        if " fast" in key and slow and row.objective > slow.objective * (1 + TOLERATED_EXCESS):
            found.append(
                f"{key}: objective {row.objective:.9g} is above ipopt's {slow.objective:.9g}"
            )
    return found


def aims(rows, memory):
    """What the package aims at: (what, aim, measured, whether it is met); rows that were not
    measured are left out.
    """
    seconds = {row.key: row.seconds for row in rows}
    measured = ratios(rows, memory)

    def at_least(name, aim):
        return (
            (name, f"at least {aim:g}", f"{measured[name]:.3g}", measured[name] >= aim)
            if name in measured
            else None
        )

    def below(name, key, aim):
        return (
            (name, f"below {aim:g} s", f"{seconds[key]:.3g} s", seconds[key] < aim)
            if key in seconds
            else None
        )

    stated = [
        at_least(f"dnlo ipopt / dnlo fast, {SHORT}", 300),
        at_least(f"dnlo ipopt / dnlo fast, {LONG}", 1000),
        at_least(f"opencv, the fastest / dnlo fast, {LONG}", 1000),
        at_least("floor / dnlo fast, 100000", 1 / 20),
        below("dnlo, 10^6 pairs", "dnlo fast, 1000000", 5),
        below("a message, 99th percentile", f"add_pose, 99th percentile, {ENGINE_MESSAGES}", 50e-6),
        below(
            "from two files to the result with covariance, wall",
            f"files to result, wall, {LONG + 5}",
            1,
        ),
        below("calibrate --help", "hand_eye_calib calibrate --help, processor, 0", 0.3),
        below("replay --help", "hand_eye_calib replay --help, processor, 0", 0.3),
    ]
    if 1_000_000 in memory:
        peak = memory[1_000_000][1] / 1e9
        stated.append(("peak memory, 10^6 pairs", "below 1 GB", f"{peak:.2f} GB", peak < 1))
    return [line for line in stated if line]
