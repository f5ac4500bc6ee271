"""The gate of errors and stated uncertainties fails on what is worse, and on nothing else."""

import dataclasses

import numpy as np
import pytest

from hand_eye_calib.core.base.errors import InputError
from reproduction.gate import __main__ as gate
from reproduction.gate.baseline import (
    Baseline,
    compare,
    compare_new_draw,
    error_ratio,
)
from reproduction.gate.scores import Score


def drawn_scores(seed=0, family="car", count=20):
    """Scores of an honest, efficient estimator."""
    rng = np.random.default_rng(seed)
    squares = rng.chisquare(3, (count, 2))
    return [
        Score(
            family=family,
            name=f"{family} {k}",
            verdict="USE",
            errors=tuple(np.sqrt(squares[k] / 2.366)),
            over_bound=float(squares[k].sum()),
            nees=float(squares[k].sum()),
            axes=6,
            inside=int(rng.binomial(6, 0.9)),
            inside_allowance=6,
        )
        for k in range(count)
    ]


def failures_of(scores, before):
    baseline = Baseline(1, "numpy 2", {score.name: score for score in before})
    return [
        failure
        for comparison in compare(scores, baseline)
        for failure in comparison.failures
    ]


def worse_errors(score):
    return {"errors": tuple(1.3 * error for error in score.errors)}


WORSE = {
    "larger errors": (worse_errors, "errors are"),
    "intervals too narrow": (
        lambda score: {"inside": score.inside - 1},
        "90 % intervals cover",
    ),
    "intervals too wide": (
        lambda score: {"nees": 0.5 * score.nees, "inside": 6},
        "NEES",
    ),
    "allowance too small": (
        lambda score: {"inside_allowance": 5},
        "with the allowance",
    ),
    "verdicts too strict": (
        lambda score: {"verdict": "USE WITH CARE"},
        "stricter",
    ),
    "no answer": (
        lambda score: {"verdict": ""},
        "no answer: 20 recordings, before 0",
    ),
    "wrong without a word": (
        lambda score: {"is_wrong": True},
        "USE but wrong: 20 recordings",
    ),
}


@pytest.mark.parametrize("name", WORSE)
def test_what_is_worse_fails_in_its_family_and_in_all(name):
    changes, sentence = WORSE[name]
    before = drawn_scores()
    scores = [dataclasses.replace(score, **changes(score)) for score in before]
    failures = failures_of(scores, before)
    for group in ("car", "all"):
        assert any(
            text.startswith(f"{group}: ") and sentence in text
            for text in failures
        )


def test_one_wrong_answer_among_many_fails():
    before = drawn_scores()
    scores = [dataclasses.replace(before[0], is_wrong=True), *before[1:]]
    assert failures_of(scores, before) == [
        "car: USE but wrong: 1 recordings, before 0",
        "all: USE but wrong: 1 recordings, before 0",
    ]


def test_equal_and_better_scores_pass():
    before = drawn_scores()
    better = [
        dataclasses.replace(
            score, errors=tuple(0.9 * error for error in score.errors)
        )
        for score in before
    ]
    assert failures_of(before, before) == []
    assert failures_of(better, before) == []
    assert error_ratio(better, before) < 0.95


def test_an_error_that_was_zero_by_luck_does_not_count_as_a_large_ratio():
    before = drawn_scores()
    lucky = [dataclasses.replace(before[0], errors=(1e-9, 1e-9)), *before[1:]]
    usual = [dataclasses.replace(before[0], errors=(0.3, 0.3)), *before[1:]]
    assert 1.0 < error_ratio(usual, lucky) < 1.02


def test_errors_over_robust_least_squares_are_a_median_and_a_quantile():
    before = drawn_scores()
    scores = [
        dataclasses.replace(
            score, robust_errors=tuple(2.0 * error for error in score.errors)
        )
        for score in before
    ]
    baseline = Baseline(1, "numpy 2", {score.name: score for score in before})
    row = compare(scores, baseline)[-1].row
    assert row["over robust"] == "0.50"
    assert row["over robust, 90 %"] == "0.50"


def test_recordings_drawn_anew_pass_by_chance_and_fail_if_errors_are_larger():
    before = drawn_scores(0, count=80)
    new = drawn_scores(1, count=60)
    worse = [
        dataclasses.replace(score, over_bound=3.0 * score.over_bound)
        for score in new
    ]
    assert compare_new_draw(new, before).failures == []
    assert compare_new_draw(worse, before).failures == [
        "new draw: errors over their bound are larger than in the baseline"
    ]


def test_a_baseline_is_read_as_it_was_written(tmp_path):
    refused = Score(family="flat_agv", name="flat_agv 0", verdict="DO NOT USE")
    unanswered = Score(family="flat_agv", name="flat_agv 1", verdict="")
    first, second = drawn_scores(count=2)
    first = dataclasses.replace(first, robust_errors=(0.5, 2.0))
    scores = [first, second, refused, unanswered]
    written = Baseline(7, "numpy 2", {score.name: score for score in scores})
    written.write(tmp_path / "baseline.json")
    read = Baseline.read(tmp_path / "baseline.json")
    assert (read.seed, read.versions) == (7, "numpy 2")
    assert read.scores["flat_agv 0"] == refused
    assert read.scores["flat_agv 1"] == unanswered
    assert read.scores["car 0"].errors == pytest.approx(
        scores[0].errors, rel=1e-3
    )
    assert read.scores["car 0"].robust_errors == pytest.approx((0.5, 2.0))


def test_a_damaged_baseline_is_named(tmp_path):
    (tmp_path / "baseline.json").write_text("{}")
    with pytest.raises(InputError, match=r"baseline\.json is no baseline"):
        Baseline.read(tmp_path / "baseline.json")


def test_the_stored_baseline_has_all_recordings_of_both_sizes():
    stored = Baseline.read(gate.BASELINE).scores
    for numbers in (gate.USUAL, gate.QUICK):
        names = {
            f"{family} {k}"
            for family, count in numbers.items()
            for k in range(count)
        }
        assert names <= stored.keys()


def test_the_command_fails_if_the_baseline_was_better(
    tmp_path, monkeypatch, capsys
):
    numbers = {"hand_mixture_30s": 1, "flat_agv": 1}
    monkeypatch.setattr(gate, "USUAL", numbers)
    monkeypatch.setattr(gate, "QUICK", numbers)
    monkeypatch.delenv("HAND_EYE_CALIB_DATA", raising=False)
    path = tmp_path / "baseline.json"
    options = ["--baseline", str(path), "--jobs", "1"]
    assert gate.main([*options, "--update", "--seed", "3"]) == 0
    assert gate.main([*options, "--quick"]) == 0
    assert "Not worse than the baseline." in capsys.readouterr().out
    stored = Baseline.read(path)
    score = stored.scores["hand_mixture_30s 0"]
    smaller = dataclasses.replace(
        score, errors=tuple(0.5 * error for error in score.errors)
    )
    better = dataclasses.replace(
        stored, scores=stored.scores | {score.name: smaller}
    )
    better.write(path)
    assert gate.main([*options, "--quick"]) == 1
    assert "- all: errors are 1." in capsys.readouterr().out


def test_a_seed_without_a_new_draw_is_refused(capsys):
    assert gate.main(["--seed", "3"]) == 2
    assert "--seed goes with --update or --against" in capsys.readouterr().err
