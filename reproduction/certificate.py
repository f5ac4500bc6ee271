"""``python -m reproduction certificate``: try to prove that answers are global minima."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.pairing.motion_pairs import MotionPairs
from hand_eye_calib.core.solvers import quadratic_form
from hand_eye_calib.core.solvers.all_pairs import Solution
from hand_eye_calib.core.solvers.certificate import is_global
from hand_eye_calib.core.solvers.registry import Method
from reproduction.published import KITTI, LEVELS, REFERENCES, SIMULATED
from reproduction.results import Results
from reproduction.runner import in_parallel
from reproduction.sources import Source
from reproduction.writing import markdown_table, write_csv, write_text

_HALF_TURNS = np.array(
    [np.diag(signs) for signs in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
)

# A minimum counts as false if its cost exceeds that of the answer by this share.
_HIGHER = 1e-3


def write(name: str, results: Results) -> list[Path]:
    """Try to prove every answer; write ``NAME.md`` and ``NAME.csv``, and return their paths."""
    datasets = [
        dataset
        for dataset in (*SIMULATED, *KITTI)
        if dataset in results.source.datasets
    ]
    tasks = [
        (results.source, dataset, level)
        for dataset in datasets
        for level in LEVELS.get(dataset, (None,))
    ]
    proofs_of_levels = in_parallel(prove_level, tasks, results.jobs)
    proofs = pd.DataFrame(
        [proof for several in proofs_of_levels for proof in several]
    )
    table = proofs.groupby(["data sets", "answer"], sort=False).agg(
        **{
            "answers": ("proved", "size"),
            "proved": ("proved", "sum"),
            "false minima": ("false", "sum"),
            "false minima proved": ("false_proved", "sum"),
            "median (ms)": ("ms", "median"),
            "largest (ms)": ("ms", "max"),
        }
    )
    rows = table.round({"median (ms)": 2, "largest (ms)": 1}).reset_index()
    return [
        write_csv(results.out / f"{name}.csv", rows),
        write_text(
            results.out / f"{name}.md",
            "# Proofs of global minima",
            "Every case with the six references of the paper. The cost of DNLO is that of its "
            "inliers. The answer `dnl from park` is the local minimum of DNL's cost that is "
            "reached from Park's rotation. False minima are other local minima of the same cost. "
            "They are reached from the answer, rotated by pi. A correct certificate proves none "
            "of them. The times are processor times of one certificate.",
            markdown_table(rows.to_dict("records")),
        ),
    ]


def prove_level(
    source: Source, dataset: str, level: float | None
) -> list[dict[str, Any]]:
    """Try to prove all answers to the cases of a data set at a level.

    A row contains whether the answer was proved, and the time. It also contains the number of false
    minima, see :func:`_false_minima`, and the number of false minima that were proved by mistake.
    """
    proofs = []
    for case in source.cases(dataset, level):
        for pairs in map(case.pairs, REFERENCES):
            for answer, solution in _answers(pairs):
                forms = quadratic_form.coefficients(pairs)
                Q = quadratic_form.weighted_sum(forms, solution.weights)
                start = time.process_time()
                is_proved = is_global(Q, solution.T_parent_child)
                seconds = time.process_time() - start
                false = list(_false_minima(Q, solution.T_parent_child))
                proofs.append(
                    {
                        "data sets": "KITTI"
                        if dataset in KITTI
                        else "simulated",
                        "answer": answer,
                        "proved": is_proved,
                        "false": len(false),
                        "false_proved": sum(is_global(Q, T) for T in false),
                        "ms": 1e3 * seconds,
                    }
                )
    return proofs


def _answers(pairs: MotionPairs) -> Iterator[tuple[str, Solution]]:
    """Yield the answers to be proved, by name; see the text of :func:`write`."""
    for name in ("dnl", "dnlo"):
        yield name, Method(name).solve(pairs)
    park = Method("park").solve(pairs)
    Q = quadratic_form.weighted_sum(
        quadratic_form.coefficients(pairs), park.weights
    )
    Ts, *_ = quadratic_form.minimise(Q, park.T_parent_child[None, :3, :3])
    yield "dnl from park", replace(park, T_parent_child=Ts[0])


def _false_minima(
    Q: FloatArray, T_parent_child: FloatArray
) -> Iterator[FloatArray]:
    """Yield local minima of the cost ``Q`` that are higher than the minimum near the answer.

    The searches start at the answer rotated by pi about each axis.
    """
    rotation = T_parent_child[:3, :3]
    _, costs, _ = quadratic_form.minimise(Q, rotation[None])
    lowest = float(costs[0])
    least_false = lowest * (1 + _HIGHER) + 1e-9 * np.trace(Q)
    Ts, costs, _ = quadratic_form.minimise(Q, rotation @ _HALF_TURNS)
    for T, cost in zip(Ts, costs, strict=True):
        if cost > least_false:
            yield T
