"""Sentences are printed whole: no module above the core cuts one, or searches in one."""

import ast
import re
from dataclasses import replace

import pytest
from result_making import good_calibration
from source_code import SOURCE

from hand_eye_calib.core.base.registry import FINDING_WORDS
from hand_eye_calib.core.checks.findings import finding
from hand_eye_calib.core.checks.words import FindingWords
from hand_eye_calib.core.results.records import Severity, words_of
from hand_eye_calib.extras.fleet.batch_page import render_batch
from hand_eye_calib.extras.fleet.together import together
from hand_eye_calib.extras.fleet.work import Outcome, Task
from hand_eye_calib.extras.rig.command import as_lines as lines_of_rig
from hand_eye_calib.extras.rig.page import render_rig
from hand_eye_calib.extras.rig.rig import Closure, RigCalibration
from hand_eye_calib.offline.cli.present import as_lines
from hand_eye_calib.offline.report.report import render
from hand_eye_calib.online.live.state import ChecksState, Level, NodeState
from hand_eye_calib.online.watch import terminal
from hand_eye_calib.online.watch.board import Board
from hand_eye_calib.online.watch.web import fragment

pytestmark = pytest.mark.usefixtures("no_figures")

# The first words contain all separators of sentences; the second none.
WITH_SEPARATORS = (
    "{}a: b; Done: moved: USE: c (d). Save. Stop and save. "
    "3 mm or acknowledge, e -> f"
)
WITHOUT_SEPARATORS = "{}z"

# Attributes that hold sentences.
SENTENCES = {
    "headline",
    "sentence",
    "what",
    "advice",
    "cause",
    "what_to_do",
    "warnings",
    "text",
}
CUTS = {
    "partition",
    "rpartition",
    "split",
    "rsplit",
    "removeprefix",
    "removesuffix",
}
CUTS |= {"startswith", "endswith"}


def result():
    """Return a result with an error, a warning and a note."""
    severities = {
        "parent": Severity.ERROR,
        "child": Severity.WARNING,
        "both": Severity.NOTE,
    }
    findings = [
        finding("model_scale", stream, severity)
        for stream, severity in severities.items()
    ]
    return good_calibration(findings=tuple(findings), warnings=())


def pages():
    """Return the texts of a result with findings on all surfaces, by the surface."""
    bad = result()
    careful = replace(bad, findings=bad.findings[1:])
    good = replace(bad, findings=bad.findings[2:])
    texts = {}
    for name, calibration in (
        ("bad", bad),
        ("careful", careful),
        ("good", good),
    ):
        texts[f"terminal {name}"] = "\n".join(
            as_lines(calibration, with_details=True)
        )
        texts[f"report {name}"] = render(calibration, None, {})
    joint = together({"monday": careful, "tuesday": good})
    texts["terminal together"] = "\n".join(as_lines(joint))
    rows = [Outcome.of(Task(name="monday", bags=()), None, careful).row]
    texts["batch"] = render_batch("fleet", rows, {"rig": joint}, set())
    closed = Closure(("lidar", "camera", "rear"), 0.001, 0.001, chi2=3.0, dof=6)
    rig = RigCalibration(("lidar", "camera"), (careful,), (), (closed,))
    texts["terminal rig"] = "\n".join(lines_of_rig(rig, with_details=True))
    texts["report rig"] = render_rig(rig, rig.sensors)
    faults = str(bad.findings[0])
    board = Board()
    checks = ChecksState(
        level=Level.WARN, text=faults, age_s=1.0, findings=(faults,)
    )
    board.take(NodeState(node="/calibrator", checks=checks), 0.0)
    view = board.view(0.5)
    texts["watch page"] = fragment(view)
    texts["watch terminal"] = "\n".join(terminal.lines(view))
    return texts


def pages_with(words, monkeypatch):
    """Return the texts with these words in place of those of the core, and times left out."""
    templates = [words.format(name) for name in ("What ", "Advice ", "Cause ")]
    monkeypatch.setitem(
        FINDING_WORDS, "core", lambda: {"model_scale": FindingWords(*templates)}
    )
    words_of.cache_clear()
    try:
        texts = pages()
    finally:
        words_of.cache_clear()
    for name, text in texts.items():
        text = re.sub(
            r"Written.*?UTC|\d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC", "", text
        )
        text = " ".join(text.split())
        for template in templates:
            text = text.replace(template, template.split()[0].upper())
            text = text.replace(
                template.replace(">", "&gt;"), template.split()[0].upper()
            )
        texts[name] = text
    return texts


def test_every_surface_prints_the_sentences_of_findings_whole(monkeypatch):
    with_separators = pages_with(WITH_SEPARATORS, monkeypatch)
    without_separators = pages_with(WITHOUT_SEPARATORS, monkeypatch)
    for name, text in with_separators.items():
        assert "WHAT" in text, name
        assert text == without_separators[name], name


def cuts_of(path):
    """Return the lines of a file that cut a sentence, or search in one."""
    lines = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        texts = []
        if (
            isinstance(node, ast.Call)
            and getattr(node.func, "attr", "") in CUTS
        ):
            texts = [node.func.value]
        elif isinstance(node, ast.Compare) and isinstance(
            node.ops[0], (ast.In, ast.NotIn)
        ):
            texts = [node.left, *node.comparators]
        if any(getattr(text, "attr", "") in SENTENCES for text in texts):
            lines.append(node.lineno)
    return lines


@pytest.mark.parametrize("layer", ["offline", "online", "extras"])
def test_no_module_above_the_core_cuts_a_sentence(layer):
    cuts = {path.name: cuts_of(path) for path in (SOURCE / layer).rglob("*.py")}
    assert {name: lines for name, lines in cuts.items() if lines} == {}
    for template in (SOURCE / layer).rglob("*.html"):
        assert not re.search(
            r"in calibration\.headline", template.read_text(encoding="utf-8")
        )
