"""``python -m reproduction certificate``: which answers are proved to be global minima."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.pairing.motion_pairs import MotionPairs
from hand_eye_calib.solvers import quadratic_form
from hand_eye_calib.solvers.certificate import is_global
from hand_eye_calib.solvers.registry import Method
from hand_eye_calib.solvers.solution import Solution
from reproduction.published import KITTI, LEVELS, REFERENCES, SIMULATED
from reproduction.results import Results
from reproduction.runner import in_parallel
from reproduction.sources import Source
from reproduction.writing import markdown_table, write_csv, write_text

_HALF_TURNS = np.array([np.diag(signs) for signs in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1])])

# A minimum counts as false if its cost is higher by this share.
_HIGHER = 1e-3


@dataclass(frozen=True)
class Proof:
    """One answer: whether it was proved, and the time of the proof.

    ``n_false`` counts other local minima, from rotations by pi beside it, and ``n_false_proved``
    those that the certificate let pass.
    """

    dataset: str
    answer: str
    is_proved: bool
    n_false: int
    n_false_proved: int
    seconds: float


def write(name: str, results: Results) -> list[Path]:
    """Try to prove every answer and write ``NAME.md`` and ``NAME.csv``; returns their paths."""
    datasets = [dataset for dataset in (*SIMULATED, *KITTI) if dataset in results.source.datasets]
    tasks = [
        (results.source, dataset, level)
        for dataset in datasets
        for level in LEVELS.get(dataset, (None,))
    ]
    proofs = [proof for found in in_parallel(prove_level, tasks, results.jobs) for proof in found]
    groups: dict[tuple[str, str], list[Proof]] = {}
    for proof in proofs:
        kind = "KITTI" if proof.dataset in KITTI else "simulated"
        groups.setdefault((kind, proof.answer), []).append(proof)
    rows = [_row(kind, group) for (kind, _), group in groups.items()]
    return [
        write_csv(results.out / f"{name}.csv", rows),
        write_text(
            results.out / f"{name}.md",
            "# Proofs of global minima",
            "Every case with the six references of the paper. DNLO: over the pairs it counts. "
            "Park: the local minimum of DNL's cost from Park's rotation. False minima are other "
            "local minima of the same cost, found from rotations by pi beside the answer. "
            "Processor time of one certificate.",
            markdown_table(rows),
        ),
    ]


def prove_level(source: Source, dataset: str, level: float | None) -> list[Proof]:
    """Proofs of the cases of a data set at a level."""
    return [
        _proof(dataset, answer, pairs, solution)
        for case in source.cases(dataset, level)
        for pairs in map(case.pairs, REFERENCES)
        for answer, solution in _answers(pairs)
    ]


def _answers(pairs: MotionPairs) -> Iterator[tuple[str, Solution]]:
    for name in ("dnl", "dnlo"):
        yield name, Method(name).solve(pairs)
    park = Method("park").solve(pairs)
    Q = quadratic_form.weighted_sum(quadratic_form.coefficients(pairs), park.weights)
    minimum = quadratic_form.minimise(Q, park.T_parent_child[None, :3, :3])
    yield "dnl from park", replace(park, T_parent_child=minimum.T_parent_child[0])


def _proof(dataset: str, answer: str, pairs: MotionPairs, solution: Solution) -> Proof:
    Q = quadratic_form.weighted_sum(quadratic_form.coefficients(pairs), solution.weights)
    start = time.process_time()
    is_proved = is_global(Q, solution.T_parent_child)
    seconds = time.process_time() - start
    false = list(_false_minima(Q, solution.T_parent_child))
    return Proof(
        dataset,
        answer,
        is_proved,
        len(false),
        sum(is_global(Q, T) for T in false),
        seconds,
    )


def _false_minima(Q: FloatArray, T_parent_child: FloatArray) -> Iterator[FloatArray]:
    value = float(quadratic_form.minimise(Q, T_parent_child[None, :3, :3]).value[0])
    minimum = quadratic_form.minimise(Q, T_parent_child[:3, :3] @ _HALF_TURNS)
    for T, other in zip(minimum.T_parent_child, minimum.value, strict=True):
        if other > value * (1 + _HIGHER) + 1e-9 * np.trace(Q):
            yield T


def _row(kind: str, proofs: list[Proof]) -> dict[str, object]:
    milliseconds = [1e3 * proof.seconds for proof in proofs]
    return {
        "data sets": kind,
        "answer": proofs[0].answer,
        "answers": len(proofs),
        "proved": sum(proof.is_proved for proof in proofs),
        "false minima near": sum(proof.n_false for proof in proofs),
        "of them proved": sum(proof.n_false_proved for proof in proofs),
        "median (ms)": f"{np.median(milliseconds):.2f}",
        "largest (ms)": f"{max(milliseconds):.1f}",
    }
