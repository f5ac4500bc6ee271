"""The verdict: each rule alone, the order of reasons, and the table in docs/verdict.md.

``PYTHONPATH=test:. python test/core/test_verdict.py`` writes the table after a change of the rules.
"""

import dataclasses
import re

import numpy as np
import pytest
from result_making import NAMES, dofs, written_finding
from result_making import good_calibration as good
from source_code import ROOT

from hand_eye_calib.core.results.calibration import (
    Calibration,
    SolveStatus,
    Verdict,
)
from hand_eye_calib.core.results.document import allowance_in_words
from hand_eye_calib.core.results.records import AxisScatter, Severity
from hand_eye_calib.core.results.rules import RULES
from hand_eye_calib.core.results.verdict import shown
from hand_eye_calib.extras.detectability.record import Detectability
from hand_eye_calib.extras.fleet.records import Together
from hand_eye_calib.extras.ground.part import GroundAxis, GroundResult

PAGE = ROOT / "docs" / "verdict.md"
TABLE = re.compile(
    r"(?<=<!-- rules: begin -->\n)(.*\n)*(?=<!-- rules: end -->)"
)


def table():
    rows = [
        f"| `{rule.name}` | {rule.when} | `{rule.verdict.value}` |\n"
        for rule in RULES
    ]
    return "".join(
        ["\n| Rule | If | Verdict |\n| --- | --- | --- |\n", *rows, "\n"]
    )


def test_the_page_has_the_rules_of_the_code():
    assert table() in PAGE.read_text(encoding="utf-8"), (
        "run PYTHONPATH=test:. python test/core/test_verdict.py"
    )


def observed(sigma_m=0.003, sigma_rad=0.001, **changes):
    """Verdicts of six axes; ``changes`` names axes with another sigma (inf: unobservable)."""
    sigmas = (
        dict(zip(NAMES, np.repeat([sigma_m, sigma_rad], 3), strict=True))
        | changes
    )
    return dofs(
        sigmas.values(),
        [name for name, sigma in sigmas.items() if sigma == np.inf],
    )


def checked(axis, scatter, excess, kind):
    nothing = AxisScatter(sigma=0.003, of_methods=None, of_halves=None)
    columns = {f"of_{kind}": scatter, f"excess_of_{kind}": excess}
    return dict.fromkeys(NAMES, nothing) | {
        axis: dataclasses.replace(nothing, **columns)
    }


FINDING = written_finding(
    "units",
    Severity.ERROR,
    "lengths are in mm",
    "convert them",
    options={"scale": 0.001},
)
FLOOR = np.diag([0.03, 0, 0, 0, 0, 0]) ** 2


def several(kind):
    return Together(kind=kind, sentence=kind, scatter={}, recordings=())


GROUND_AXIS = GroundAxis("roll", 0.0, 0.002, 0.02, 0.001, 9.0, False)

# An error of 1 m or 1 rad would not have shown.
NOTHING_SHOWS = Detectability(
    errors=dict.fromkeys(NAMES, 1.0),
    shifts={},
    time_offset_s=np.inf,
    scale=np.inf,
)


# Rule to a result in which it alone applies.
CASES = {
    "prior": dict(status=SolveStatus.CONTRADICTED, contradictions={"x": 5.5}),
    "error_finding": dict(findings=(FINDING,)),
    "not_converged": dict(status=SolveStatus.NOT_CONVERGED),
    "nothing_known": dict(observability_measured=observed(np.inf, np.inf)),
    "recordings_differ": dict(parts={"together": several("differ")}),
    "unobservable": dict(observability_measured=observed(z=np.inf)),
    "warning_finding": dict(
        findings=(dataclasses.replace(FINDING, severity=Severity.WARNING),)
    ),
    "ground": dict(
        parts={
            "ground": GroundResult("ground", "ground", False, (GROUND_AXIS,))
        }
    ),
    "recordings": dict(parts={"together": several("one off")}),
    "halves": dict(cross_check=checked("x", 0.02, 3.5, "halves")),
    "methods": dict(cross_check=checked("yaw", 0.01, 3.5, "methods")),
    "unconfirmed": dict(
        cross_check=dict.fromkeys(
            NAMES, AxisScatter(sigma=0.003, of_methods=None, of_halves=None)
        )
        | {
            "z": AxisScatter(
                sigma=0.01, of_methods=None, of_halves=None, is_confirmed=False
            )
        }
    ),
    "undetectable": dict(parts={"detectability": NOTHING_SHOWS}),
    "outliers": dict(n_pairs=100, n_inliers=65),
    "target": dict(observability_measured=observed(x=0.04, yaw=0.02)),
    "floor": dict(T_parent_child=np.eye(4), covariance_allowance=FLOOR),
}


def test_every_rule_has_a_case():
    assert list(CASES) == [rule.name for rule in RULES]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_each_rule_alone_decides(rule):
    result = good(**CASES[rule.name])
    assert [reason.rule for reason in result.reasons] == [rule.name]
    (reason,) = result.reasons
    assert reason.sentence
    assert reason.what_to_do
    assert result.verdict is reason.verdict is rule.verdict
    assert result.headline.startswith(f"{rule.verdict.value}: ")


def test_a_finding_explains_why_the_solver_did_not_converge():
    result = good(status=SolveStatus.NOT_CONVERGED, findings=(FINDING,))
    assert [reason.rule for reason in result.reasons] == ["error_finding"]
    assert not result.has_failed


@pytest.mark.parametrize(
    ("rule", "sentence"),
    [
        (
            "methods",
            "robust least squares disagrees about the rotation about z by 0.57 deg; without this "
            "second opinion, the result claims +/- 0.17 deg",
        ),
        (
            "floor",
            "x is good to 3 cm; the target is 2 cm. Most of the standard deviation is an allowance "
            "for constant odometry errors",
        ),
    ],
)
def test_sentences_name_axes_values_and_targets(rule, sentence):
    (reason,) = good(**CASES[rule]).reasons
    assert reason.sentence == sentence


@pytest.mark.parametrize(
    ("changes", "cause", "options"),
    [
        ({}, "constant odometry errors", ["parent_kind", "child_kind"]),
        (
            {"exact_streams": ("parent",)},
            "constant odometry errors",
            ["child_kind"],
        ),
        ({"reference": "windows"}, "constant odometry errors", ["child_kind"]),
        (
            {"exact_streams": ("parent", "child")},
            "a delay of positions after their orientations",
            [],
        ),
    ],
)
def test_an_allowance_has_its_cause_and_the_kinds_that_are_left(
    changes, cause, options
):
    result = good(**CASES["floor"], **changes)
    (reason,) = result.reasons
    words = allowance_in_words(result)
    assert reason.sentence.endswith(f"an allowance for {cause}")
    assert f"the allowance is for {cause}, which" in words
    for text in (reason.what_to_do, words):
        for name in ("parent_kind", "child_kind"):
            assert (name in text) == (name in options)
    assert "with target_translation" in reason.what_to_do


@pytest.mark.parametrize("more", [{}, {"roll": 0.02}])
def test_a_longer_recording_is_no_advice_where_constant_errors_exceed_the_target(
    more,
):
    (reason,) = good(
        **CASES["floor"], observability_measured=observed(x=0.04, **more)
    ).reasons
    assert reason.rule == "target"
    begins = (
        "record longer, with more "
        if more
        else "constant odometry errors alone leave x"
    )
    assert reason.what_to_do.startswith(begins)
    assert ("the rotation about x 1.1 deg" in reason.sentence) == bool(more)
    assert "alone leave x 3 cm: set the target" in reason.what_to_do


def test_axes_that_cannot_be_determined_are_named_together():
    result = good(
        observability_measured=observed(z=np.inf, roll=np.inf, yaw=np.inf)
    )
    sentence = "z and the rotations about x and z cannot be determined from this motion"
    assert result.reasons[0].sentence == sentence


def test_a_large_scatter_of_references_is_not_excused_by_their_own_uncertainty():
    check = checked("x", 0.05, 2.9, "methods")
    assert good(cross_check=check).reasons == ()
    check["x"] = dataclasses.replace(check["x"], excess_over_own=3.1)
    result = good(cross_check=check)
    assert [reason.rule for reason in result.reasons] == ["methods"]


def test_a_method_that_models_the_noise_may_reject_less():
    assert (
        good(method="adaptive", n_pairs=100, n_inliers=80).verdict
        is Verdict.USE
    )
    rejecting = good(method="adaptive", n_pairs=100, n_inliers=79)
    assert [reason.rule for reason in rejecting.reasons] == ["outliers"]


def test_nothing_against_it_is_use():
    result = good()
    assert (result.verdict, result.reasons) == (Verdict.USE, ())
    assert (
        result.headline
        == "USE: good to 3 mm along and 0.057 deg about each axis (1 sigma)"
    )


@pytest.mark.parametrize(
    "changes",
    [
        dict(findings=(dataclasses.replace(FINDING, severity=Severity.NOTE),)),
        dict(cross_check=checked("x", 0.002, 9.0, "halves")),
        dict(cross_check=checked("x", 0.05, 2.9, "methods")),
        dict(cross_check=checked("x", 0.05, 2.9, "halves")),
        dict(observability_measured=observed(x=0.0199, yaw=0.0052)),
        dict(
            observability_measured=observed(x=0.04, yaw=0.02),
            target_translation=0.05,
            target_rotation=0.1,
        ),
        dict(observability_measured=observed(z=0.09), target_axes={"z": 0.1}),
        dict(n_pairs=100, n_inliers=70),
    ],
)
def test_what_does_not_count(changes):
    assert good(**changes).verdict is Verdict.USE


def test_the_gravest_reason_comes_first_and_decides():
    result = good(
        **CASES["target"] | CASES["error_finding"] | CASES["outliers"]
    )
    assert [reason.rule for reason in result.reasons] == [
        "error_finding",
        "outliers",
        "target",
    ]
    assert result.headline == "DO NOT USE: lengths are in mm"
    assert [reason.rule for reason in shown(result.reasons)] == [
        "error_finding"
    ]
    assert len(shown(good(**CASES["target"] | CASES["outliers"]).reasons)) == 2


def test_an_axis_that_is_not_shown_does_not_spoil_the_others():
    hidden = good(**CASES["unobservable"])
    assert hidden.headline == "USE WITH CARE: all but z; measure z by hand"
    assert repr(hidden).startswith(f"<Calibration: {hidden.headline}\n")
    both = good(observability_measured=observed(y=np.inf, z=np.inf))
    assert (
        both.headline == "USE WITH CARE: all but y and z; measure them by hand"
    )
    assert both.reasons[0].what_to_do == (
        "measure them by hand and give priors, such as "
        'prior={"y": (0.50, 0.02), "z": (0.50, 0.02)}'
    )


def test_axes_out_of_reach_are_not_among_the_known_axes():
    rotations = good(
        measured="rotations",
        observability_measured=observed(
            x=np.inf, y=np.inf, z=np.inf, yaw=np.inf
        ),
    )
    assert rotations.headline == (
        "USE WITH CARE: roll and pitch only; measure yaw by hand"
    )


def test_a_file_keeps_what_the_verdict_comes_from():
    result = good(**CASES["error_finding"] | CASES["target"])
    document = result.to_dict()
    assert next(iter(document)) == "verdict"
    assert document["verdict"] == "DO_NOT_USE"
    assert Calibration.from_dict(document).reasons == result.reasons
    assert document["reasons"][0] == {
        "rule": "error_finding",
        "verdict": "DO_NOT_USE",
        "kind": "suspicion",
        "axes": [],
        "sentence": "lengths are in mm",
        "what_to_do": "convert them",
        "options": {"scale": 0.001},
    }


if __name__ == "__main__":
    PAGE.write_text(
        TABLE.sub(lambda _: table(), PAGE.read_text("utf-8")), encoding="utf-8"
    )


@pytest.mark.parametrize(
    ("sigma", "allowance", "begins"),
    [
        (
            0.004,
            0.0199,
            "x is good to 2.03 cm; the target is 2 cm. Most of the standard deviation is an "
            "allowance",
        ),
        (
            0.0199,
            0.004,
            "x is good to 2.03 cm; the target is 2 cm. Part of the standard deviation is an "
            "allowance",
        ),
        (
            0.0004,
            0.0200001,
            "x is good to 2.0004 cm; the target is 2 cm. Most of",
        ),
    ],
)
def test_a_size_above_its_target_has_the_digits_that_show_it(
    sigma, allowance, begins
):
    result = good(
        T_parent_child=np.eye(4),
        observability_measured=observed(x=sigma),
        covariance_allowance=np.diag([allowance, 0, 0, 0, 0, 0]) ** 2,
    )
    (reason,) = result.reasons
    assert reason.rule == "floor"
    assert reason.sentence.startswith(begins)


def test_a_measured_size_just_above_its_target_has_the_digits_that_show_it():
    (reason,) = good(observability_measured=observed(x=0.02003)).reasons
    assert (
        reason.sentence
        == "standard deviations above the target of 2 cm: x 2.003 cm"
    )


def test_several_axes_and_targets_are_named_together():
    allowance = np.diag([0.03, 0.04, 0, 0, 0, np.radians(0.4)]) ** 2
    (reason,) = good(
        T_parent_child=np.eye(4), covariance_allowance=allowance
    ).reasons
    assert reason.sentence == (
        "x is good to 3 cm, y to 4 cm and the rotation about z to 0.4 deg; the targets are 2 cm "
        "and 0.3 deg. Most of each deviation is an allowance for constant odometry errors"
    )


def scaled(severity):
    text = (
        "the child's lengths are 2.1 +/- 0.1 % longer than the "
        "parent's; this result corrects them"
    )
    return written_finding("model_scale", severity, text)


def test_a_scale_that_the_model_found_is_in_the_headline_and_a_large_one_is_a_reason():
    small, large = (
        good(findings=(scaled(severity),))
        for severity in (Severity.NOTE, Severity.WARNING)
    )
    assert (small.verdict, small.reasons) == (Verdict.USE, ())
    assert small.headline.endswith("; " + scaled(Severity.NOTE).what)
    assert large.verdict is Verdict.USE_WITH_CARE
    assert [reason.rule for reason in large.reasons] == ["warning_finding"]
    assert large.headline.count("lengths") == 1
