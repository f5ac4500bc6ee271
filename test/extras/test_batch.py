"""``replay --batch``: many recordings, wherever they are and wherever the work is done; what they
say together.
"""

import csv
import dataclasses
import functools
import json
import re
import sys
import tempfile
import types
from contextlib import nullcontext

import numpy as np
import pytest
from fleet_making import outcome, recordings_of
from motions import (
    T_PARENT_CHILD,
    as_trajectory,
    child_of,
    disturbed,
    wandering_poses,
)
from numpy.testing import assert_allclose
from result_making import good_calibration, written_finding

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import SolveStatus
from hand_eye_calib.core.results.records import Severity
from hand_eye_calib.extras.fleet import batch as batch_run
from hand_eye_calib.extras.fleet import work as batch_work
from hand_eye_calib.extras.fleet.batch import write_rows
from hand_eye_calib.extras.fleet.together import together
from hand_eye_calib.extras.fleet.work import Outcome, Task, tasks_of, work
from hand_eye_calib.formats import remote
from hand_eye_calib.formats.bags.patterns import matching
from hand_eye_calib.formats.bags.writer import write_bag
from hand_eye_calib.formats.results import load_result
from hand_eye_calib.offline.cli.present import exit_code

pytestmark = pytest.mark.usefixtures("no_figures")

ODOMETRY = "nav_msgs/msg/Odometry"
STREAMS = ["--parent-topic", "/a", "--child-topic", "/b"]


@pytest.fixture
def run(run):
    return functools.partial(run, "replay")


def write_drive(path, n_poses, seed):
    """A bag without noise."""
    poses = wandering_poses(n_poses, seed=seed)
    child = disturbed(child_of(poses), 1, 2e-4, 2e-4)
    streams = {
        "/a": (as_trajectory(poses, sensor_frame="lidar"), ODOMETRY),
        "/b": (as_trajectory(child, sensor_frame="camera"), ODOMETRY),
    }
    write_bag(path, streams)


@pytest.fixture
def fleet(tmp_path):
    """Three drives and a bag that is missing, as they are typed."""
    for number in range(3):
        write_drive(tmp_path / "bags" / f"drive{number}", 60, number)
    bags = [f"{tmp_path}/bags/drive*", tmp_path / "bags" / "gone"]
    return ["--batch", *bags, *STREAMS, "--reference", "B5"]


def assert_is_result_of_the_fleet(code, out, err):
    document = json.loads(out)
    assert code == 1
    assert document["failures"] == ["gone"]
    assert ": gone: no bag at " in err
    rows = {row["name"]: row for row in document["results"]}
    assert list(rows) == ["drive0", "drive1", "drive2", "gone"]
    for name, row in rows.items():
        if name != "gone":
            matrix = row["calibration"]["T_parent_child"]["matrix"]
            assert_allclose(matrix, T_PARENT_CHILD, atol=1e-3)
            assert row["calibration"]["reference"] == "B5"


def test_a_batch_on_all_cores_goes_on_where_it_stopped(
    run, fleet, tmp_path, monkeypatch
):
    out_dir = tmp_path / "out"
    code, out, err = run(*fleet, "--out", out_dir, "--json", "--jobs", "2")
    assert_is_result_of_the_fleet(code, out, err)
    assert (
        "note: 3 recordings are not compared with each other: set --vehicle to the"
        in err
    )
    # A pipe gets a line for each recording.
    assert re.search(r"note: [1-4] of 4: drive[0-2]: USE", err)
    saved = load_result(out_dir / "drive1")
    assert_allclose(saved.T_parent_child, T_PARENT_CHILD, atol=1e-3)
    assert (out_dir / "drive1" / "static_transform.launch.py").exists()
    report = (out_dir / "drive1" / "report.html").read_text(encoding="utf-8")
    assert "Both streams before any solve" in report
    page = (out_dir / "index.html").read_text(encoding="utf-8")
    assert [(row[0], row[4]) for row in rows_of(page)] == [
        ("gone", 0), ("drive0", 1), ("drive1", 1), ("drive2", 1)
    ]  # fmt: skip
    done = []
    monkeypatch.setattr(
        batch_run, "outcomes", lambda tasks, jobs, dask: here(tasks, done)
    )
    code, out, err = run(*fleet, "--out", out_dir, "--json")
    assert_is_result_of_the_fleet(code, out, err)
    assert done == ["gone"]
    assert "3 of 4 bags are done already" in err
    # A bag that was missing, or has changed, is done; with other options all are.
    write_drive(tmp_path / "bags" / "gone", 100, seed=7)
    next((tmp_path / "bags" / "drive1").glob("*.mcap")).touch()
    done.clear()
    code, out, err = run(*fleet, "--out", out_dir)
    assert (code, done) == (0, ["drive1", "gone"])
    assert re.search(r"^gone: USE", out, re.MULTILINE)
    assert "4 of 4 bags calibrated, 0 failed" in out
    assert "agree" not in out
    done.clear()
    assert run(*fleet[:-1], "B2", "--out", out_dir, "--no-report")[0] == 0
    assert len(done) == 4


def rows_of(page):
    """What the script of the page of a batch shows, in its order."""
    return json.loads(re.search(r"const rows = (.*), tones", page)[1])


def here(tasks, done):
    """Stands in for processes: does the work in this one and notes what was done."""
    for task in tasks:
        done.append(task.name)
        yield task, work(task)


def test_a_batch_on_a_dask_cluster(run, fleet):
    distributed = pytest.importorskip(
        "dask.distributed",
        reason="dask.distributed is not installed: pip install '.[cluster]'",
    )
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=2,
        processes=False,
        dashboard_address=None,
    ) as cluster:
        assert_is_result_of_the_fleet(
            *run(*fleet, "--json", "--dask", cluster.scheduler_address)
        )


def test_without_dask_its_option_says_what_to_install(run, fleet, monkeypatch):
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    code, out, err = run(*fleet, "--dask", "tcp://127.0.0.1:1")
    assert (code, out) == (1, "")
    assert "pip install '.[cluster]'" in err


def test_a_defect_in_one_bag_leaves_the_others_alone(monkeypatch):
    monkeypatch.setattr(batch_work, "read_recording", lambda *_, **__: 1 / 0)
    outcome = work(Task(name="a", bags=("absent",)))
    assert (
        outcome.row["error"] == "unexpected ZeroDivisionError: division by zero"
    )
    assert "ZeroDivisionError" in json.loads(outcome.text)["traceback"]


@pytest.mark.parametrize(
    ("severity", "code", "error"),
    [
        (Severity.NOTE, 1, "the solver did not converge"),
        (Severity.ERROR, 3, None),
    ],
)
def test_a_recording_fails_as_it_does_alone(monkeypatch, severity, code, error):
    finding = written_finding("jumps", severity, "every step is a jump")
    failed = good_calibration(
        status=SolveStatus.NOT_CONVERGED, findings=(finding,)
    )
    recording = types.SimpleNamespace(
        solved=lambda _: failed, inputs={}, snapshot=None
    )
    monkeypatch.setattr(batch_work, "read_recording", lambda *_: recording)
    outcome = work(Task(name="a", bags=("a",)))
    assert (outcome.code, outcome.row["error"]) == (code, error)
    assert outcome.code == exit_code(failed)


@pytest.mark.parametrize(
    ("bags", "names"),
    [
        (["monday/bag", "other", "other"], ["monday_bag", "other", "other_2"]),
        (
            ["a/monday/bag", "b/monday/bag", "b/tuesday/bag"],
            ["a_monday", "b_monday", "b_tuesday"],
        ),
        (
            ["s3://fleet/t1/run.mcap?sig=a/b", "s3://fleet/t2/run.mcap"],
            ["t1", "t2"],
        ),
        (["a/vehicles", "a/."], ["vehicles_2", "a"]),
    ],
)
def test_recordings_are_named_by_what_tells_their_paths_apart(bags, names):
    assert [task.name for task in tasks_of([[bag] for bag in bags])] == names


# ---- rows


@pytest.mark.usefixtures("no_processes")
def test_rows_and_page_have_every_recording_and_the_vehicle(
    run, fleet, tmp_path, monkeypatch
):
    more = ("--vehicle", "truck", "--no-report", "--jobs", "1")
    assert run(*fleet, *more, "--out", tmp_path / "1")[0] == 1
    rows = list(
        csv.DictReader((tmp_path / "1" / "rows.csv").read_text().splitlines())
    )
    assert [row["name"] for row in rows] == [
        "drive0",
        "drive1",
        "drive2",
        "gone",
    ]
    assert rows[0]["start"] == "2023-11-14T22:13:20+00:00"
    assert (rows[3]["x_m"], rows[3]["error"][:10]) == ("", "no bag at ")
    assert_allclose(float(rows[0]["z_m"]), T_PARENT_CHILD[2, 3], atol=1e-3)
    page = (tmp_path / "1" / "index.html").read_text(encoding="utf-8")
    assert not any(row[4] for row in rows_of(page))
    assert "The 3 recordings agree within their standard deviations" in page
    assert (tmp_path / "1" / "vehicles" / "truck" / "extrinsic.yaml").exists()
    # The recordings are not compared a second time.
    monkeypatch.setattr(batch_run, "together", lambda results: 1 / 0)
    assert run(*fleet, *more, "--out", tmp_path / "1")[0] == 1
    assert (tmp_path / "1" / "index.html").read_text(encoding="utf-8") == page


@pytest.mark.usefixtures("no_processes")
def test_a_vehicle_whose_recordings_differ_is_no_good_exit(
    run, tmp_path, monkeypatch
):
    for number in range(2):
        write_drive(tmp_path / "bags" / f"drive{number}", 60, number)

    def differing(results):
        return dataclasses.replace(
            good_calibration(), status=SolveStatus.NOT_CONVERGED
        )

    monkeypatch.setattr(batch_run, "together", differing)
    bags = [
        "--batch",
        f"{tmp_path}/bags/drive*",
        *STREAMS,
        "--reference",
        "B5",
        "--no-report",
    ]
    code, out, _ = run(*bags, "--vehicle", "truck", "--jobs", "1")
    assert code == exit_code(differing(None))
    assert code != 0
    assert "1 vehicle: 1 DO NOT USE" in out


@pytest.mark.usefixtures("no_processes")
def test_a_vehicle_with_one_recording_has_a_result_too(run, tmp_path):
    for number, vehicle in enumerate("ab"):
        write_drive(tmp_path / "fleet" / vehicle / "monday", 60, number)
    options = [*STREAMS, "--reference", "B5", "--no-report", "--jobs", "1"]
    fleet = ["--batch", tmp_path / "fleet", "--vehicle", "fleet/{vehicle}/*"]
    code, out, _ = run(*fleet, *options, "--out", tmp_path / "out")
    assert code == 0
    assert re.search(r"2 vehicles: 2 USE\b.*\na: USE.*\nb: USE", out)
    for vehicle in "ab":
        assert (
            tmp_path / "out" / "vehicles" / vehicle / "extrinsic.yaml"
        ).exists()


@pytest.mark.parametrize(("by", "code"), [(0.0, 0), (0.02, 4)])
def test_recordings_of_a_vehicle_that_contradict_each_other_exit_as_moved(
    by, code
):
    outcomes = fleet_outcomes("a", 6, 1, shift=(4, 5), by=by)
    result = together({item.row["name"]: item.calibration for item in outcomes})
    assert batch_run._code_of_vehicle(result) == code


@pytest.mark.parametrize("name", [" =cmd()", "＝1+1", "a;=cmd()"])
def test_a_cell_cannot_become_a_formula(tmp_path, name):
    (outcome,) = fleet_outcomes("truck", 1, 1)
    write_rows(tmp_path / "rows.csv", [{**outcome.row, "name": name}])
    text = (tmp_path / "rows.csv").read_text()
    (row,) = csv.DictReader(text.splitlines())
    assert row["name"] == (name if name[0] == "a" else f"'{name}")
    # In quotes, so that a semicolon does not end the cell where it is the separator.
    assert f'"{row["name"]}"' in text
    # Numbers stay numbers.
    assert f",{row['x_m']}," in text
    assert float(row["y_m"]) < 0


# ---- bags at URLs


def outcomes_of(*bags):
    tasks = tasks_of(
        [[bag] for bag in bags],
        options={"reference": "B5"},
        sources={"parent": "/a", "child": "/b"},
        with_fingerprints=True,
    )
    return tasks, [json.loads(work(task).text) for task in tasks]


@pytest.fixture
def memory(tmp_path):
    """A store with two bags in folders."""
    fsspec = pytest.importorskip(
        "fsspec", reason="fsspec is not installed: '.[fleet]'"
    )
    store = fsspec.filesystem("memory")
    for number in range(2):
        write_drive(tmp_path / f"drive{number}", 60, number)
        store.put(
            f"{tmp_path}/drive{number}/",
            f"/fleet/run{number}/drive",
            recursive=True,
        )
    yield store
    store.rm("/fleet", recursive=True)


def test_bags_in_a_store_give_what_they_give_here(tmp_path, memory):
    _, local = outcomes_of(f"{tmp_path}/drive0", f"{tmp_path}/drive1")
    tasks, remotely = outcomes_of(*matching("memory://fleet/*/drive"))
    assert [task.name for task in tasks] == ["run0", "run1"]
    for here, stored, task in zip(local, remotely, tasks, strict=True):
        assert stored["error"] is None
        assert stored["calibration"] == here["calibration"]
        assert (
            stored["inputs"]["bag"]
            == task.bags[0]
            == f"memory:///fleet/{task.name}/drive"
        )
        files = [file["file"] for file in stored["inputs"]["files"]]
        assert all(file.startswith(task.bags[0] + "/") for file in files)


def test_a_bag_at_a_url_is_replayed_alone(run, tmp_path, memory, monkeypatch):
    local = json.loads(run(tmp_path / "drive0", *STREAMS, "--json")[1])
    url = "memory://fleet/run0/drive"
    code, out, err = run(url, *STREAMS, "--json")
    remotely = json.loads(out)
    assert code == 0
    assert remotely["T_parent_child"] == local["T_parent_child"]
    assert remotely["inputs"]["bag"] == url
    assert json.loads(run(url, "--list", "--json")[1])["bag"] == url
    assert run(url, "--parent-topic", "/none")[2].count(url) == 1
    (name,) = memory.glob("/fleet/run0/drive/*.mcap")
    memory.pipe(name, b"no bag")
    code, _, err = run(url, *STREAMS)
    assert (code, "/hand_eye_calib_" in err) == (1, False)


def test_a_remote_bag_may_not_fill_the_disk(tmp_path, memory, monkeypatch):
    monkeypatch.setattr(
        remote.shutil,
        "disk_usage",
        lambda _: types.SimpleNamespace(free=20_000),
    )
    _, (row,) = outcomes_of("memory://fleet/run0/drive")
    assert row["error"] == (
        "cannot read memory://fleet/run0/drive: it is larger than 1e-05 GB, half of the free space "
        f"of {tempfile.gettempdir()}; set TMPDIR to a folder with more space"
    )


def test_what_a_store_calls_its_files_does_not_leave_the_folder(monkeypatch):
    class Hostile:
        def ls(self, path, detail):
            return [{"name": "bag/../../../../outside.mcap", "type": "file"}]

        def get_file(self, name, target):
            copied.append(target)

    copied = []
    monkeypatch.setattr(
        remote, "_reached", lambda url: nullcontext((Hostile(), "bag"))
    )
    with remote.local_copies(["s3://bag"]) as (paths, _):
        assert copied == [f"{paths[0]}/outside.mcap"]


def test_without_fsspec_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    _, (row,) = outcomes_of("s3://fleet/run.mcap")
    assert row["error"].startswith(
        "s3://fleet/run.mcap needs a package that is not installed"
    )
    assert "pip install '.[fleet]'" in row["error"]


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("s3://fleet/run.mcap", "s3://fleet/run.mcap"),
        (
            "https://user:pass@host/a@b.mcap?X-Signature=1",
            "https://host/a@b.mcap",
        ),
        ("local/path?x", "local/path?x"),
    ],
)
def test_urls_are_shown_without_what_gives_access(url, shown):
    assert remote.public(url) == shown


# ---- what the recordings of a vehicle say together


def fleet_outcomes(vehicle, count, seed, shift=(), by=0.02):
    Ts, covariances = recordings_of(seed, count)
    for index in shift:
        Ts[index] = se3.exp(np.array([0, 0, 0, 0, 0, by])) @ Ts[index]
    return [
        outcome(f"{vehicle}_{day}", vehicle, Ts[day], covariances[day], day)
        for day in range(count)
    ]


def test_the_index_page_shows_each_vehicle(tmp_path):
    from hand_eye_calib.extras.fleet.batch_page import render_batch

    outcomes = [
        *fleet_outcomes("<b>", 6, 1, shift=(4, 5)),
        *fleet_outcomes("a", 2, 2),
    ]
    outcomes.append(Outcome.of(Task(name="lost", bags=()), "no <bag>"))
    rows = [outcome.row for outcome in outcomes]
    vehicles = {
        name: together(
            {
                outcome.row["name"]: outcome.calibration
                for outcome in outcomes[members]
            }
        )
        for name, members in (("<b>", slice(0, 6)), ("a", slice(6, 8)))
    }
    with_report = {row["name"] for row in rows[:-1]}
    page = render_batch("path/fleet.yaml", rows, vehicles, with_report)
    assert "<b>" not in page
    (lost,) = [row for row in rows_of(page) if row[2] == "failed"]
    assert (lost[0], lost[-1], rows_of(page)[0]) == ("lost", "no <bag>", lost)
    assert page.count("<svg") == 2
    assert page.count("is left out: its result disagrees with the others") == 2
    assert "path/fleet.yaml" not in page
    assert [row[4] for row in rows_of(page)] == [0] + 8 * [1]
    assert re.fullmatch(r"-?\d\.\d+ \d\.\d+", rows_of(page)[1][-1][0])
    for address in re.findall(r'(?:href|src)="([^"]*)"', page):
        assert not re.match(r"\w+:|//", address), f"not on this disk: {address}"
    assert page == render_batch("path/fleet.yaml", rows, vehicles, with_report)


def test_the_page_of_ten_thousand_recordings_stays_below_2_mb():
    from hand_eye_calib.extras.fleet.batch_page import render_batch

    (outcome,) = fleet_outcomes("truck_17", 1, 1)
    rows = [
        {**outcome.row, "name": f"truck_017_2026-11-23T{n:05}"}
        for n in range(10_000)
    ]
    page = render_batch("of/fleet/**", rows, {}, {row["name"] for row in rows})
    assert (
        len(page.encode()) < 1_790_000
    )  # and 50 kB of each figure of 50 recordings
    assert (len(rows_of(page)), page.count('<p class="muted">fleet: ')) == (
        10_000,
        1,
    )


def test_vehicles_are_named_by_their_place_in_the_path(tmp_path):
    for place in (
        "truck_1/monday",
        "truck_1/tuesday",
        "truck_2/monday",
        "notes",
    ):
        (tmp_path / "fleet" / place).mkdir(parents=True, exist_ok=True)
        if place != "notes":
            (tmp_path / "fleet" / place / "metadata.yaml").touch()
            (tmp_path / "fleet" / place / "a.mcap").touch()
    groups = [[bag] for bag in matching(f"{tmp_path}/fleet/**")]
    assert groups == [[bag] for bag in matching(f"{tmp_path}/fleet/truck_?")]
    assert groups == [[bag] for bag in matching(f"{tmp_path}/fleet")]
    assert matching(f"{tmp_path}/fleet/truck_2/monday") == [
        f"{tmp_path}/fleet/truck_2/monday"
    ]
    assert [
        (task.name, task.vehicle)
        for task in tasks_of(groups, "fleet/{vehicle}/*")
    ] == [
        ("truck_1_monday", "truck_1"),
        ("truck_1_tuesday", "truck_1"),
        ("truck_2_monday", "truck_2"),
    ]
    assert {task.vehicle for task in tasks_of(groups, "other/{vehicle}/*")} == {
        ""
    }
    assert {
        task.vehicle for task in tasks_of([["/x/../bag"]], "/x/{vehicle}/bag")
    } == {""}
    for path in ("none/**", "fleet/notes"):
        with pytest.raises(ConfigError, match="no bag matches"):
            matching(f"{tmp_path}/{path}")
