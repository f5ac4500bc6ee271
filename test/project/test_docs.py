"""What the pages of the documentation show runs as it stands there.

``make test`` runs a few pages, ``make docs`` all (``HAND_EYE_CALIB_ALL_PAGES=1``).
"""

import os
import re
import shlex
import shutil

import example_recording
import numpy as np
import pytest
import yaml
from source_code import ROOT

import hand_eye_calib as hec
from hand_eye_calib.offline.cli.main import main

DOCS = ROOT / "docs"
RUNS_ALL = os.environ.get("HAND_EYE_CALIB_ALL_PAGES") == "1"
FEW = ("how_to.md", "troubleshooting.md", "tutorials/base_link.md")
# In all pages but the tables of studies: 144 minutes at 250 words a minute.
MOST_WORDS = 36_000
# Where a command needs more than files: a node, ROS, a journal, a minute.
ELSEWHERE = re.compile(r" (calibrator|watch|demo) ?|live/|robot1/")
# Exit codes that a page may lead to: 3 is an unobservable axis or "cannot tell", 4 a moved mount.
FINE = {"compare": (0, 3, 4)}


def pages():
    names = [
        path.relative_to(DOCS).as_posix() for path in sorted(DOCS.rglob("*.md"))
    ]
    return [
        name for name in names if blocks(name) and (RUNS_ALL or name in FEW)
    ]


def blocks(name):
    """Commands and Python of a page in their order."""
    text = (DOCS / name).read_text(encoding="utf-8")
    commands = []
    for language, block in re.findall(
        r"^```(bash|python)\n(.*?)^```", text, re.DOTALL | re.M
    ):
        if language == "python":
            commands += (
                [("python", block)] if "import hand_eye_calib" in text else []
            )
        else:
            lines = block.replace("\\\n", " ").splitlines()
            ours = (
                line for line in lines if line.startswith("hand_eye_calib ")
            )
            commands += [
                ("command", line) for line in ours if not ELSEWHERE.search(line)
            ]
    return commands


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prepared")
    example_recording.make(folder)
    return folder


@pytest.fixture
def folder(prepared, tmp_path, monkeypatch):
    """A copy of the example's folder to work in."""
    target = tmp_path / "work"
    shutil.copytree(prepared, target)
    monkeypatch.chdir(target)
    return target


@pytest.mark.parametrize("name", pages())
def test_page_runs(name, folder, capsys):
    names = {}
    for kind, text in blocks(name):
        if kind == "python":
            exec(compile(text, name, "exec"), names)
            continue
        command, *arguments = shlex.split(text, comments=True)[1:]
        code = main([command, *arguments])
        output = capsys.readouterr()
        assert code in FINE.get(command, (0, 3)), (
            f"{text}\n{output.out}\n{output.err}"
        )
        assert "error:" not in output.err


def test_commands_of_the_pages_are_found():
    assert len(blocks("how_to.md")) >= 6
    assert len(blocks("tutorials/notebook.md")) >= 5
    assert len(blocks("cli.md")) >= 12


def test_every_page_is_in_the_navigation_and_short_or_has_tables_of_studies():
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    site = yaml.safe_load(text)
    evidence = set(site["not_in_nav"].split())
    navigation = set(
        re.findall(
            r"- (?:\w+: )?([\w/]+\.md)$", text.partition("\nnav:")[2], re.M
        )
    )
    every = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert navigation >= every - evidence
    texts = [
        (DOCS / name).read_text(encoding="utf-8") for name in every - evidence
    ]
    assert sum(len(text.split()) for text in texts) <= MOST_WORDS
    assert evidence <= every - navigation
    assert site["theme"]["font"] is False


def test_pages_say_bash_where_commands_are():
    """A command in a block of another language would not be run."""
    for path in DOCS.rglob("*.md"):
        text = path.read_text(encoding="utf-8")
        for language, block in re.findall(
            r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.M
        ):
            if language != "bash":
                assert not re.search(r"^hand_eye_calib [a-z]", block, re.M), (
                    path,
                    block,
                )


def test_every_public_name_is_on_the_reference_page():
    text = (DOCS / "python.md").read_text(encoding="utf-8")
    described = set(re.findall(r"^::: (\S+)$", text, re.MULTILINE))
    public = {getattr(hec, name) for name in hec.__all__}
    homes = {
        f"{public_name.__module__}.{public_name.__name__}"
        for public_name in public
    }
    missing = {
        home
        for home in homes - described
        if home.rpartition(".")[0] not in described
    }
    assert missing == set()


# ---- facts that more than one page states, and how a page would contradict them

FACTS = {
    "a clock rate is estimated": r"constant offset only|rate of (?:a|the) clock cannot",
    "the key of watch is the same at every start": r"new key (?:at|for) (?:each|every) start",
    "the goal has an end": r"never (?:says|prints|shows) DONE",
    "a covariance has the allowance": r"covariance (?:is|are) without the (?:floor|allowance)",
    "a sigma has the allowance": r"sigmas? (?:is|are) without the (?:floor|allowance)",
    "a prior has no allowance": r"(?:prior|axis) .{0,40} gets? the allowance",
    "quaternions are x, y, z, w": r"quaternions? (?:is|are) (?:in the order )?w, ?x, ?y, ?z",
}
STATED = {
    "limits.md": "the time offset must change at a constant rate",
    "security.md": "The key is the same\n  at every start",
    "cli.md": "DONE | the goal is reached",
    "uncertainty.md": "An axis that a prior determines has no allowance",
    "conventions.md": "x, y, z, w",
}


@pytest.mark.parametrize("fact", FACTS)
def test_no_page_contradicts_a_fact(fact):
    for path in (ROOT / "README.md", *DOCS.rglob("*.md")):
        words = " ".join(path.read_text(encoding="utf-8").split())
        assert not re.search(FACTS[fact], words, re.IGNORECASE), path.name


@pytest.mark.parametrize("name", STATED)
def test_the_page_of_a_fact_states_it(name):
    assert STATED[name] in (DOCS / name).read_text(encoding="utf-8")


# ---- colours of the site

WHITE = "#ffffff"
DARK = "#1e2129"  # background of Material's scheme slate


def luminance(colour):
    """Relative luminance of a colour, WCAG 2.2."""
    channels = (
        np.array([int(colour[start : start + 2], 16) for start in (1, 3, 5)])
        / 255
    )
    linear = np.where(
        channels <= 0.04045,
        channels / 12.92,
        ((channels + 0.055) / 1.055) ** 2.4,
    )
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_text_of_the_site_has_a_contrast_of_four_and_a_half():
    css = (DOCS / "site.css").read_text(encoding="utf-8")
    rules = re.findall(r"(\[data-md-color[^{]*)\{(.*?)\}", css, re.DOTALL)
    assert len(rules) >= 4
    for selector, body in rules:
        background = luminance(DARK if "slate" in selector else WHITE)
        for colour in re.findall(r": (#[0-9a-f]{6});", body):
            lighter, darker = sorted(
                [luminance(colour), background], reverse=True
            )
            assert (lighter + 0.05) / (darker + 0.05) >= 4.5, (selector, colour)
