"""The report: what is in it, that its numbers are the result's, and that it is one page that stands
alone.
"""

import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path

import browser
import numpy as np
import pytest
import yaml
from motions import child_of, disturbed, wandering_poses, write_pair

pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from result_making import NAMES, calibration, dofs, written_finding

import hand_eye_calib as hec
from hand_eye_calib.core.assessment.comparison import with_comparison
from hand_eye_calib.core.base.spelling import Interface
from hand_eye_calib.core.base.text import amount, change, with_sigma
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.frames import Extrinsic
from hand_eye_calib.core.results.calibration import (
    DofVerdict,
    SolveStatus,
    Verdict,
)
from hand_eye_calib.core.results.records import Severity
from hand_eye_calib.extras.simulation.demo import DRIVE
from hand_eye_calib.extras.simulation.drive import simulate_drive
from hand_eye_calib.extras.simulation.options import REALISTIC
from hand_eye_calib.offline.cli import main as cli
from hand_eye_calib.offline.cli.reporting import write_report
from hand_eye_calib.offline.report import evidence
from hand_eye_calib.offline.report.report import render

FIGURES = ("views", "trajectories", "coordinates", "residuals", "streams")
VOID = {"meta", "br", "hr", "img", "link", "input"}


class Page(HTMLParser):
    """A page taken apart; an end tag that does not fit is an error."""

    def __init__(self, text):
        super().__init__()
        self.open = []
        self.ids = []
        self.elements = []
        self.text = ""
        self.errors = []
        self.feed(text)
        self.close()
        self.text = " ".join(self.text.split())

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        attributes = dict(attrs)
        self.elements.append((tag, attributes))
        if len(attributes) != len(attrs):
            self.errors.append(f"<{tag}> has an attribute twice")
        if "id" in attributes:
            self.ids.append(attributes["id"])

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.errors.append(f"</{tag}> closes nothing")

    def handle_data(self, data):
        if self.open[-1:] != ["style"]:
            self.text += data

    def all(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


def simulated(
    seed=3, poses=200, frames=("lidar", "camera"), options=None, **motion
):
    """Snapshot and calibration of a simulated drive."""
    names = dict(zip(("parent_frame", "child_frame"), frames, strict=True))
    config = dataclasses.replace(DRIVE, poses=poses, **motion, **names)
    drive = simulate_drive(seed, config, REALISTIC)
    streams = drive.parent, drive.child
    snapshot = whole_snapshot(*streams, options or {})
    return snapshot, snapshot.estimate()


def page_of(snapshot, calibration, **more):
    text = render(calibration, snapshot, **more)
    page = Page(text)
    assert (page.errors, page.open) == ([], [])
    assert len(page.ids) == len(set(page.ids))
    return text, page


@pytest.fixture(scope="module")
def hilly():
    snapshot, calibration = simulated()
    return snapshot, calibration, *page_of(snapshot, calibration)


@pytest.fixture(scope="module")
def planar():
    snapshot, calibration = simulated(terrain_height=0.0)
    return snapshot, calibration, *page_of(snapshot, calibration)


@pytest.mark.parametrize("drive", ["hilly", "planar"])
def test_page_is_whole_and_stands_alone(drive, request):
    _, _, text, page = request.getfixturevalue(drive)
    assert text.startswith("<!DOCTYPE html>")
    assert not re.search(r"https?:|//\w|@import", text)
    for tag, attributes in page.elements:
        assert tag not in ("script", "link", "img", "iframe")
        for name in ("src", "href", "xlink:href"):
            assert attributes.get(name, "#").startswith("#")
    referred = {
        target
        for attributes in (a for _, a in page.elements)
        for target in re.findall(r"#([\w-]+)", str(attributes))
    }
    assert {target for target in referred if "-" in target} <= set(page.ids)
    assert len(text.encode()) < 1_500_000


def test_every_section_and_figure_is_there_verdict_first(hilly):
    _, _, text, page = hilly
    sections = [
        attributes["aria-labelledby"] for attributes in page.all("section")
    ]
    assert sections == [
        "verdict",
        "extrinsic",
        "uncertainty",
        "evidence",
        "data",
    ]
    figures = [attributes["id"] for attributes in page.all("figure")]
    assert figures == [f"figure-{name}" for name in FIGURES]
    assert len(page.all("svg")) == len(FIGURES)
    scrolled = [
        division
        for division in page.all("div")
        if division.get("class") == "scroll"
    ]
    described = [
        division["aria-label"]
        for division in scrolled
        if division.get("role") == "img"
    ]
    assert len(described) == len(FIGURES)
    assert all(re.search(r"\d", label) for label in described)
    assert [tag for tag, _ in page.elements if re.fullmatch("h[1-6]", tag)][
        :2
    ] == [
        "h1",
        "h2",
    ]
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text


@pytest.mark.parametrize("drive", ["hilly", "planar"])
def test_numbers_are_the_calibrations(drive, request):
    _, calibration, _, page = request.getfixturevalue(drive)
    document = calibration.to_dict()
    for transform in (document["T_parent_child"], document["T_child_parent"]):
        for value in transform["quat_xyzw"]:
            assert f"{round(value, 4) + 0.0:.4f}" in page.text
        sigmas = [*transform["sigma_translation"], *transform["sigma_rpy_deg"]]
        values = [*transform["translation"], *transform["rpy_deg"]]
        for value, sigma, decimals in zip(
            values, sigmas, (3, 3, 3, 2, 2, 2), strict=True
        ):
            assert (
                with_sigma(value, sigma, decimals).replace("+/-", "±")
                in page.text
            )
    totals = calibration.sigmas.tolist()
    for dof, total in zip(calibration.observability, totals, strict=True):
        if dof.verdict is DofVerdict.UNOBSERVABLE:
            continue
        per_unit = {"mm": 1e3, "cm": 100, "m": 1, "deg": 180 / np.pi}
        label = next(
            a["aria-label"]
            for a in page.all("div")
            if a.get("aria-label", "").startswith(f"{dof.name}: ")
        )
        match = re.fullmatch(
            rf"{dof.name}: ([\d.]+) (mm|cm|m|deg), (\w+)", label
        )
        number, unit, verdict = match.groups()
        assert float(number) == pytest.approx(per_unit[unit] * total, rel=0.06)
        assert verdict == dof.verdict.value
    assert calibration.static_transform_command() in page.text
    assert (
        f"{calibration.n_inliers} of {calibration.n_pairs} are inliers"
        in page.text
    )
    for warning in calibration.warnings:
        assert " ".join(warning.split()) in page.text
    assert (
        "Pose of camera in lidar Maps coordinates of camera into lidar."
        in page.text
    )
    assert (
        "Pose of lidar in camera Maps coordinates of lidar into camera."
        in page.text
    )


def test_what_is_unobservable_is_said_first_with_what_to_do(planar):
    _, calibration, _, page = planar
    assert calibration.status is SolveStatus.UNOBSERVABLE
    assert calibration.unobservable() == ["z"]
    verdict = page.text[: page.text.index("Pose of lidar in camera Maps")]
    for reason in calibration.reasons:
        assert reason.sentence.lower() in verdict.lower()
        assert reason.advice_on(Interface.TERMINAL) in verdict
    assert "USE WITH CARE All but z; measure z by hand" in verdict
    assert "z cannot be determined from this motion" in verdict
    assert re.search(r"Motion: .*z cannot be determined", verdict)
    assert (
        "To publish it (USE WITH CARE, after you have replaced MEASURE_Z_BY_HAND)"
        in page.text
    )
    assert "--z MEASURE_Z_BY_HAND --qx" in page.text
    assert "z: unknown" in {a.get("aria-label") for a in page.all("div")}


@pytest.fixture(scope="module")
def partial():
    """Snapshots, results and pages of streams that are no poses, by what they measure."""
    drive = simulate_drive(3, dataclasses.replace(DRIVE, poses=60), REALISTIC)
    made = {}
    for name, of in {"positions": "parent", "rates": "child"}.items():
        streams = {"parent": drive.parent, "child": drive.child}
        streams[of] = dataclasses.replace(streams[of], measures=name)
        options = {"parent_frame": "lidar", "child_frame": "antenna"}
        snapshot = whole_snapshot(**streams, options=options)
        calibration = snapshot.estimate()
        made[name] = (calibration, *page_of(snapshot, calibration))
    return made


@pytest.mark.parametrize("name", ["positions", "rates"])
def test_results_of_positions_and_rates_have_a_page_of_what_they_show(
    partial, name
):
    _calibration, _text, page = partial[name]
    shown = [*FIGURES]
    if name == "rates":
        of_positions = ("views", "trajectories", "coordinates")
        shown = [figure for figure in shown if figure not in of_positions]
    else:
        shown.insert(1, "track")
    assert [attributes["id"] for attributes in page.all("figure")] == [
        f"figure-{figure}" for figure in shown
    ]
    assert len(page.all("svg")) == len(shown)
    word, unknown = (
        ("Orientation", "x, y and z")
        if name == "rates"
        else ("Position", "roll")
    )
    assert f"{word} of antenna in lidar" in page.text
    assert f"{word} of lidar in antenna" in page.text
    assert f"{unknown}" in page.text[page.text.index("not estimated") - 20 :]
    bars = [a for a in page.all("div") if a.get("class") == "bar"]
    assert len(bars) == 3
    assert "MEASURE_" in page.text
    assert "nan" not in page.text.lower().replace("provenance", "")


def test_positions_are_along_the_axes_of_the_other_sensor_and_have_their_path(
    partial,
):
    calibration, _, page = partial["positions"]
    assert (
        "Along the axes of antenna: positions have none of their own."
        in page.text
    )
    lever_arm = calibration.to_dict()["T_child_parent"]
    sigmas = lever_arm["sigma_translation"]
    for value, sigma in zip(lever_arm["translation"], sigmas, strict=True):
        assert sigma < 1.0
        assert with_sigma(value, sigma, 3).replace("+/-", "±") in page.text
    assert "The path of lidar" in page.text
    assert "computed from the poses of antenna and the result" in page.text
    match = re.search(r"within ([\d.]+) (c?m) of each other", page.text)
    assert float(match[1]) * {"cm": 0.01, "m": 1.0}[match[2]] < 0.5
    pattern = r"below ([\d.]+) (c?m) with the result, and below ([\d.]+) (c?m) without"
    after, unit_after, before, unit_before = re.search(
        pattern, page.text
    ).groups()
    metres = {"cm": 0.01, "m": 1.0}
    assert (
        float(after) * metres[unit_after] < float(before) * metres[unit_before]
    )


def test_hostile_names_stay_text():
    hostile = ('<script>alert("x")</script>', "_a$b$ & 'c' id=\"y\" --> ünï 雷")
    snapshot, calibration = simulated(poses=60, frames=hostile)
    finding = written_finding(
        "x", Severity.NOTE, "<img src=x>", "</li>", stream="<em>"
    )
    calibration = dataclasses.replace(calibration, findings=(finding,))
    _, page = page_of(
        snapshot, calibration, inputs={"parent": {"topic": "<em>"}}
    )
    assert {"script", "img", "em"} & {tag for tag, _ in page.elements} == set()
    for name in (*hostile, "<img src=x>"):
        assert name in page.text


@pytest.mark.parametrize(
    ("motion", "options"),
    [
        ({"speed": 0.0, "max_yaw_rate": 0.0}, {}),  # nothing is observable
        ({"poses": 15}, {}),  # nothing to cut in parts
        ({"poses": 60}, {"method": "park", "reference": "C5"}),
        (
            {"poses": 100, "terrain_height": 0.0},
            {
                "prior.z": "0.1+/-0.02",
                "scale": "estimate",
                "time_offset": "estimate",
            },
        ),
    ],
)
def test_any_result_gets_a_page(tmp_path, motion, options):
    snapshot, calibration = simulated(
        1, **({"poses": 60} | motion), options=options
    )
    write_report(tmp_path, calibration, snapshot, {})
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.errors == []
    assert [a["id"] for a in page.all("figure")] == [
        f"figure-{name}" for name in FIGURES
    ]
    assert "nan" not in re.findall(r"[a-z]+", page.text.lower())
    assert not re.search(r"\binf\b", page.text)


def test_stops_have_a_page(tmp_path):
    poses = wandering_poses(40)
    stops = hec.calibrate_stops(
        poses, disturbed(child_of(poses), 1, 1e-3, 1e-3)
    )
    page = Page(
        stops.report(tmp_path / "report.html").read_text(encoding="utf-8")
    )
    assert page.errors == []
    names = [a["id"] for a in page.all("figure")]
    assert names == ["figure-views", "figure-stops", "figure-residuals"]
    assert "Half of the 40 stops agree with the result to" in page.text


@pytest.fixture
def files(tmp_path):
    drive = simulate_drive(3, dataclasses.replace(DRIVE, poses=100), REALISTIC)
    return write_pair(tmp_path, drive.parent, drive.child)


def calibrate(files, out):
    names = ["--parent-frame", "lidar", "--child-frame", "camera"]
    return cli.main(["calibrate", *files, *names, "--out", str(out)])


def test_command_writes_it_beside_the_result(files, tmp_path, capsys):
    assert calibrate(files, tmp_path / "out") in (0, 3)
    assert (
        f"wrote {tmp_path / 'out' / 'report.html'}" in capsys.readouterr().err
    )
    page = Page((tmp_path / "out" / "report.html").read_text(encoding="utf-8"))
    saved = hec.load(tmp_path / "out")
    assert (saved.static_transform_command() in page.text) == (
        saved.status == "ok"
    )
    assert list(saved.cross_check) == [dof.name for dof in saved.observability]
    # Names of the files, not of the folders: the page goes to customers.
    assert all(Path(file).name in page.text for file in files)
    assert str(tmp_path) not in page.text


@pytest.mark.usefixtures("no_figures")
def test_what_is_installed_is_compared_axis_by_axis_and_an_axis_may_have_its_own_target(
    planar, tmp_path
):
    snapshot, calibration, _, before = planar
    calibration = dataclasses.replace(calibration, target_axes={"x": 0.2})
    to_parent = se3.from_rotation_translation(
        np.eye(3), np.array([0.5, 0.0, 0.0])
    )
    installed = Extrinsic(
        to_parent @ calibration.T_parent_child, "robot.urdf <b>"
    )
    compared = with_comparison(calibration, installed)
    _text, page = page_of(snapshot, compared)
    assert "installed" in [
        attributes["aria-labelledby"] for attributes in page.all("section")
    ]
    shown = page.text[
        page.text.index("axis of lidar difference") : page.text.rindex(
            "Evidence"
        )
    ]
    (difference,) = hec.compare([calibration], installed).differences
    assert compared.comparison.sentence in page.text
    along_x = difference.axes["x"]
    visible = amount("x", along_x.visible)
    assert (
        f"along x {change('x', -0.5, along_x.sigma)} {visible} moved along y"
        in shown
    )
    assert "along z unknown unknown cannot tell about x" in shown
    assert shown.count("deg same") == 3
    assert "robot.urdf <b>" in page.text
    assert "mark: the target, 2 cm and 0.3 deg" in before.text
    assert "mark: the target, 2 cm, 0.3 deg and x 20 cm" in page.text
    # Each axis has a bar of the standard deviation and one of its measured part, but z is unknown.
    widths = [
        [a["style"] for a in report.all("i")] for report in (before, page)
    ]
    assert [a == b for a, b in zip(*widths, strict=True)] == [False] * 2 + [
        True
    ] * 9
    hec.save(compared, tmp_path)
    (file,) = tmp_path.glob("*.yaml")
    stated = yaml.safe_load(file.read_text())["comparison"]
    assert stated["installed"] == "robot.urdf <b>"
    assert stated["values"]["x"] == pytest.approx(
        installed.T_parent_child[0, 3]
    )
    assert stated["differences"][0]["axes"]["x"]["difference"] == pytest.approx(
        -0.5
    )
    assert stated["differences"][0]["axes"]["z"]["sigma"] is None


@pytest.mark.usefixtures("no_figures")
def test_no_page_names_folders(hilly):
    snapshot, calibration, *_ = hilly
    folder = str(Path(__file__).parent)
    inputs = {
        "bag": folder,
        "journal": {"directory": f"{folder}/test_report.py"},
        "parent": {"file": f"{folder}/test_report.py", "poses": 3},
        "child": {"topic": "/camera/odometry", "messages": 6001}
        | {"first_stamp_ns": 10**9, "last_stamp_ns": 61 * 10**9},
    }
    _, page = page_of(snapshot, calibration, inputs=inputs)
    assert folder not in page.text
    assert "100.0 Hz" in page.text
    header = page.text[
        : page.text.index("Contents") if "Contents" in page.text else 600
    ]
    assert (
        "Parent: lidar, from test_report.py; Child: camera, from /camera/odometry."
        in header
    )


@pytest.mark.usefixtures("no_figures")
def test_labels_names_of_files_and_what_it_means_at_a_distance(hilly):
    snapshot, calibration, *_ = hilly
    nameless = dataclasses.replace(
        calibration, parent_frame="parent_sensor", child_frame="child_sensor"
    )
    inputs = {
        "parent": {"file": "/a/roof.tum"},
        "child": {"topic": "/camera/odometry"},
    }
    _, page = page_of(
        snapshot, nameless, inputs=inputs | {"labels": {"vehicle": "7 <b>"}}
    )
    assert "Pose of camera/odometry in roof" in page.text
    assert "Maps coordinates of camera/odometry into roof." in page.text
    assert "vehicle: 7 <b>" in page.text[: page.text.index("Verdict")]
    match = re.search(
        r"10 m from camera/odometry has a standard deviation of ([\d.]+) cm",
        page.text,
    )
    J = np.hstack([np.eye(3), -se3.skew(np.array([10.0, 0.0, 0.0]))])
    covariance = J @ calibration.covariance @ J.T
    assert float(match[1]) >= 95 * np.sqrt(np.linalg.eigvalsh(covariance)[-1])


# What no page may say below the verdict USE.
AGAINST = (
    r"do not (trust|use)|not settled|record longer|more than (chance|the target)|above the target|"
    r"disagree|cannot be determined|unobservable|alone leave|allowance for constant|has moved|"
    r"may have"
)


@pytest.mark.usefixtures("no_figures")
def test_no_sentence_speaks_against_a_green_verdict():
    green = 0
    for seed, options in enumerate(
        17 * [{}, *3 * [{"method": "dnlo", "reference": "B10"}]]
    ):
        snapshot, calibration = simulated(seed, 60 + 2 * seed, options=options)
        if calibration.verdict is Verdict.USE:
            green += 1
            assert not re.findall(
                AGAINST, Page(render(calibration, snapshot)).text.lower()
            )
    assert green >= 55


def with_optical_parent(snapshot):
    """Snapshot and calibration of the same drive whose parent has z forward and y down."""
    parent, child = snapshot.streams
    optical = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    poses = parent.poses.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ optical
    turned = whole_snapshot(dataclasses.replace(parent, poses=poses), child, {})
    return turned, turned.estimate()


@pytest.mark.parametrize("drive", ["hilly", "planar"])
def test_only_a_parent_with_a_vertical_z_is_seen_from_above(drive, request):
    snapshot, calibration, text, _ = request.getfixturevalue(drive)
    assert "from above" in text
    assert "from the side" in text
    turned, optical = with_optical_parent(snapshot)
    _, page = page_of(turned, optical)
    assert "from above" not in page.text
    assert "along z" in page.text
    assert "along z" in hec.plot(calibration).axes[0].get_title()


def test_both_streams_coincide_at_every_pitch():
    # The drive turns by more than 90 deg about y of a parent with optical axes.
    snapshot, calibration = simulated(poses=400, max_yaw_rate=2.0)
    turned, optical = with_optical_parent(snapshot)
    for case, result in ((snapshot, calibration), (turned, optical)):
        measured, computed = evidence.gather(result, case).angles
        assert np.degrees(np.abs(computed - measured).max()) < 5.0
    # Curves of the road are about the vertical axis of the parent.
    about_y = evidence.gather(optical, turned).angles[0][:, 1]
    about_z = evidence.gather(calibration, snapshot).angles[0][:, 2]
    assert about_y == pytest.approx(-about_z, abs=1e-6)


@pytest.mark.parametrize("unknown", ["x", "yaw"])
def test_a_notebook_gets_the_numbers_of_a_result_with_an_unknown_axis(unknown):
    sigmas = np.where([name == unknown for name in NAMES], np.inf, 1e-3)
    covariance = np.diag(sigmas**2)
    result = calibration(
        covariance_measured=covariance,
        observability_measured=dofs(sigmas, unknown),
    )
    html = result._repr_html_()
    assert result.headline in html
    assert f">{unknown}</th>" in html


@pytest.mark.parametrize("of", ["poses", "stops"])
def test_a_report_is_printed_on_two_pages_and_with_its_details_if_they_are_open(
    tmp_path, of
):
    if of == "poses":
        result = hec.calibrate("sample:lidar.tum", "sample:camera.tum")
    else:
        samples = hec.read_arm_samples("sample:arm.yaml")
        result = hec.calibrate_arm(samples.robot, samples.tracking)
    page = result.report(tmp_path / "report.html")
    assert browser.printed_pages(page, tmp_path) == 2
    opened = page.read_text(encoding="utf-8").replace(
        "<details>", "<details open>"
    )
    page.write_text(opened, encoding="utf-8")
    assert browser.printed_pages(page, tmp_path) > 2
