"""Text files, YAML, results and journals that are not what they should be: one line, never a
traceback, never a hang, and nothing outside the directory of the results.
"""

import os
import time
import tracemalloc
import xml.dom.minidom

import motions
import pytest
import yaml
from motions import read_trajectory_file
from result_making import calibration

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.extras.fleet.batch import stored
from hand_eye_calib.extras.fleet.work import Task
from hand_eye_calib.formats.results import load_result, save_result
from hand_eye_calib.formats.trajectory_files.file_options import AUTO
from hand_eye_calib.formats.trajectory_files.writing import write_trajectory
from hand_eye_calib.formats.yaml_files import read_yaml
from hand_eye_calib.offline import calibrate as offline

PARENT = motions.as_trajectory(
    motions.wandering_poses(30), sensor_frame="lidar"
)
CHILD = motions.as_trajectory(
    motions.disturbed(
        motions.child_of(motions.wandering_poses(30)), 1, 1e-3, 1e-3
    ),
    sensor_frame="camera",
)


def one_line(error):
    text = str(error.value)
    assert len(text) < 2000
    assert "\n" not in text
    return text


HOSTILE_YAML = {
    "aliases": (
        "a: &a [x]\nb: *a",
        "aliases are not supported: write the value of 'a'",
    ),
    "deep flow": ("[" * 100_000, "nest"),
    "deep blocks": (
        "\n".join(" " * k + "a:" for k in range(500)),
        "nested more than",
    ),
    "long integer": ("n: " + "9" * 5000, "is not readable YAML"),
    "float": ("n: !!float abc", "is not readable YAML"),
    "empty integer": ("n: !!int ''", "is not readable YAML"),
    "empty date": ("n: !!timestamp ''", "the tag"),
    "long tag": (f"n: !{'t' * 100_000} 1", "for the tag '!ttt"),
    "object": ("n: !!python/object/apply:os.system ['true']", "the tag"),
    "binary": ("n: !!binary '='", "the tag"),
    "set": ("n: !!set {a, b}", "the tag"),
    "twice": ("a: 1\nb: 2\na: 3", "the key 'a' appears twice, line 3"),
    "list as a key": ("? [a, b]\n: 1", "unhashable key"),
    "two documents": ("a: 1\n---\nb: 2", "is not readable YAML"),
    "control characters": ("a: \x01", "is not readable YAML"),
    "too large": (
        "# " + "x" * (1 << 20),
        "larger than the limit of 1048576 bytes",
    ),
}


@pytest.mark.parametrize("kind", HOSTILE_YAML)
def test_yaml_that_is_hostile_is_refused_in_one_line(run, tmp_path, kind):
    text, message = HOSTILE_YAML[kind]
    path = tmp_path / "file.yaml"
    path.write_text(text)
    is_result = kind == "aliases"
    code, out, err = run(
        *(["info", path] if is_result else ["replay", ".", "--config", path])
    )
    assert (code in (1, 2), out) == (True, "")
    (line,) = err.splitlines()
    assert message in line
    assert len(line) < 1000


INF = float("inf")
NAN = float("nan")
AXES = calibration().to_dict()["observability"]
SCATTER = {"sigma": 0.1, "of_methods": 0.1, "of_halves": 0.1}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    return save_result(calibration(), tmp_path_factory.mktemp("saved")).parent


@pytest.mark.parametrize(
    "change",
    [
        {"consistency": 5},
        {"cross_check": 5},
        {"noise": {"in_words": 3}},
        {"warnings": [5]},
        {"observability": None},
        {"covariance": {"matrix": [[1]]}},
        {"T_parent_child": {"matrix": [[float("nan")] * 4] * 4}},
        {"time_offset_s": "soon"},
        {"scale": None},
        {"status": ["ok"]},
        {"objective": float("inf")},
        {"target_axes": {"up": 0.1}},
        {"contradictions": {"w": 5.0}},
        {"method": "guess"},
        {"covariance_allowance": {"matrix": [[None] * 6] * 6}},
        {"covariance": {"matrix": [[1e18, *[0.0] * 5], *[[0.0] * 6] * 5]}},
        {"covariance": {"matrix": [[0.0, 5.0, *[0.0] * 4], *[[0.0] * 6] * 5]}},
        *(
            {"cross_check": {"x": SCATTER | {"of_halves": value}}}
            for value in (INF, NAN)
        ),
        {"observability": AXES[::-1]},
        {"observability": [AXES[0] | {"name": "up"}, *AXES[1:]]},
        {"observability": [AXES[0] | {"sigma": NAN}, *AXES[1:]]},
    ],
    ids=repr,
)
def test_altered_results_are_refused_or_shown(run, tmp_path, saved, change):
    document = yaml.safe_load((saved / "extrinsic.yaml").read_text())
    if "consistency" in change:  # the older name
        del document["cross_check"]
    (tmp_path / "extrinsic.yaml").write_text(yaml.safe_dump(document | change))
    for command in (
        ["info", tmp_path],
        ["compare", saved, "--with", tmp_path, "--json"],
    ):
        code, out, err = run(*command)
        assert code in (0, 1, 3)
        assert (code == 1) == (len(err.splitlines()) == 1 and not out)


@pytest.mark.parametrize("command", ["info", "check", "replay", "calibrate"])
def test_a_name_that_is_too_long_for_a_file_is_one_line(run, tmp_path, command):
    name = tmp_path / ("n" * 256)
    other = [tmp_path / "other.tum"] if command == "calibrate" else []
    code, out, err = run(command, name, *other)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "File name too long; choose another" in err
    assert len(err) < 200


@pytest.mark.parametrize(
    "state", ["5", "[" * 100_000, '{"key": 1}\n{}', '{"key": "K"}\n{}']
)
def test_a_damaged_state_of_a_batch_is_done_again(tmp_path, state):
    task = Task(name="a", bags=("absent",))
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "batch.jsonl").write_text(state.replace("K", task.key()))
    assert stored(task, tmp_path) is None


def test_a_pipe_is_refused_rather_than_waited_for(tmp_path):
    path = tmp_path / "parent.tum"
    os.mkfifo(path)
    for format in ("tum", "csv", "euroc"):
        with pytest.raises(InputError, match="is not a regular file") as caught:
            motions.read_trajectory_file(path, format)
        one_line(caught)
    result = tmp_path / "extrinsic.yaml"
    os.mkfifo(result)
    with pytest.raises(InputError, match="is not a regular file"):
        load_result(result)


def test_a_pose_takes_little_more_memory_than_its_line_and_its_matrix_and_few_blocks(
    tmp_path,
):
    both = motions.noisy_pair(motions.wandering_poses(5_000), 0, 1e-3, 1e-3)
    write_trajectory(tmp_path / "poses.tum", both[0])
    tracemalloc.start()
    reading = motions.read_trajectory_file(tmp_path / "poses.tum")
    _, peak = tracemalloc.get_traced_memory()
    offline.calibrate(*both, method="park")
    _, peak_of_park = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_of_park / 5_000 < 12_000  # 7,600 with its checks
    assert len(reading.trajectory) == 5_000
    assert peak / 5_000 < 900  # bytes; 1,120 with lists of lines and of numbers


def test_a_file_of_line_ends_is_refused_at_once(tmp_path):
    path = tmp_path / "poses.tum"
    path.write_bytes(b"\n" * 10_000_000)
    began = time.process_time()
    with pytest.raises(InputError, match="the file contains no poses"):
        motions.read_trajectory_file(path, "auto")
    assert time.process_time() - began < 0.7  # 0.15; 1.4 line by line


def test_a_csv_cell_of_any_length_is_one_line(tmp_path):
    path = tmp_path / "parent.csv"
    for text in (
        "t,x,y,z,qx,qy,qz,qw\n" + "1" * 200_000 + ",0,0,0,0,0,0,1\n",
        't,x,y,z,qx,qy,qz,qw\n"' + "\n1" * 200_000,
        "c," * 1_000_000 + "\n",
        ",".join(["x"] * 30_000) + "\n",
        "t,x,y,z,qx,qy,qz," + "w" * 60_000 + "\n",
    ):
        path.write_text(text)
        with pytest.raises(InputError) as caught:
            motions.read_trajectory_file(path, "csv")
        one_line(caught)


@pytest.mark.parametrize(
    ("format", "row"),
    [
        ("tum", "{t} {x} 0 0 0 0 0 1"),
        ("tum", "{t} 0 0 0 {w} 0 0 {w}"),
        ("kitti", "1 0 0 {x} 0 1 0 0 0 0 1 0"),
        ("kitti", "{w} 0 0 0 0 {w} 0 0 0 0 1 0"),
        ("euroc", "{t}000000000,{x},0,0,1,0,0,0"),
        ("csv", "{t},{x},0,0,0,0,0,1"),
    ],
)
@pytest.mark.parametrize(
    "value", ["1e154", "-1e200", "1.7e308", "1e11", "0x10"]
)
def test_a_pose_out_of_this_world_is_named(tmp_path, format, row, value):
    lines = ["t,x,y,z,qx,qy,qz,qw"] if format == "csv" else []
    of_one = {True: "1", False: "0.7071067811865476"}[
        "{x}" in row or format == "kitti"
    ]
    for t in range(1, 9):
        lines.append(
            row.format(
                t=t, x=value if t == 3 else t, w=value if t == 3 else of_one
            )
        )
    path = tmp_path / "parent"
    times = tmp_path / "times"
    path.write_text("\n".join(lines))
    times.write_text("\n".join(map(str, range(1, 9))))
    options = {"times": times} if format == "kitti" else {}
    with pytest.raises(
        InputError, match=f"parent, line {3 + (format == 'csv')}: "
    ) as caught:
        motions.read_trajectory_file(path, format, **options)
    one_line(caught)


@pytest.fixture
def calibrate(run, tmp_path):
    """Runs calibrate into the folder ``out``."""
    files = motions.write_pair(tmp_path, PARENT, CHILD)
    (tmp_path / "out").mkdir()
    return lambda: run(
        "calibrate", *files, "--method", "park", "--out", tmp_path / "out"
    )[0]


def test_links_are_replaced_and_not_followed(calibrate, tmp_path, no_figures):
    names = (
        "extrinsic.yaml",
        "extrinsic.urdf.xacro",
        "static_transform.launch.py",
        "report.html",
    )
    for name in names:
        (tmp_path / f"mine_{name}").write_text("mine")
        (tmp_path / "out" / name).symlink_to(tmp_path / f"mine_{name}")
    assert calibrate() == 0
    for name in names:
        assert (tmp_path / f"mine_{name}").read_text() == "mine"
        assert not (tmp_path / "out" / name).is_symlink()
        assert (tmp_path / "out" / name).read_text() != "mine"
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *names,
        "previous",
    }


def test_files_of_somebody_else_are_kept_however_often_results_are_written(
    calibrate, tmp_path
):
    names = (
        "extrinsic.yaml",
        "extrinsic.urdf.xacro",
        "static_transform.launch.py",
        "report.html",
    )
    for name in names:
        (tmp_path / "out" / name).write_text(f"my own {name}")
    for _ in range(3):
        assert calibrate() == 0
    contents = [
        path.read_text()
        for path in (tmp_path / "out").rglob("*")
        if path.is_file()
    ]
    for name in names:
        assert contents.count(f"my own {name}") == 1
        assert "hand_eye_calib" in (tmp_path / "out" / name).read_text()
    assert len(contents) == 3 * len(names)


def test_a_result_that_is_saved_from_python_keeps_files_of_somebody_else(
    tmp_path,
):
    (tmp_path / "static_transform.launch.py").write_text("my launch file")
    for _ in range(2):
        save_result(calibration(), tmp_path)
    assert (
        tmp_path / "static_transform.launch.py.kept"
    ).read_text() == "my launch file"
    assert not (tmp_path / "static_transform.launch.py.kept2").exists()


@pytest.mark.parametrize(
    "frame",
    [
        "a--->b",
        "---",
        "-->",
        "a\x1b[2Jb",
        "a\nb",
        "a\x00b",
        "<&>\"'",
        "$(arg x)",
        "\u2028",
    ],
)
def test_saved_files_are_well_formed_for_any_name_of_a_frame(tmp_path, frame):
    save_result(
        calibration(parent_frame=frame, child_frame=frame + "x"), tmp_path
    )
    root = xml.dom.minidom.parse(
        str(tmp_path / "extrinsic.urdf.xacro")
    ).documentElement
    assert root.tagName == "robot"
    text = (tmp_path / "static_transform.launch.py").read_text()
    compile(text, "static_transform.launch.py", "exec")
    for name in ("extrinsic.urdf.xacro", "static_transform.launch.py"):
        content = (tmp_path / name).read_text()
        assert all(letter.isprintable() or letter == "\n" for letter in content)
    assert load_result(tmp_path).parent_frame == frame


@pytest.mark.parametrize(
    "number", ["0x" + "f" * 5000, "1" * 5000, "0b" + "1" * 5000, "9" * 20]
)
def test_whole_numbers_of_yaml_are_of_64_bits(tmp_path, number):
    path = tmp_path / "config.yaml"
    path.write_text(f"# options\nmax_pairs: {number}\n")
    with pytest.raises(
        InputError, match="config.yaml is not readable YAML: .*line 2"
    ) as caught:
        read_yaml(path)
    one_line(caught)


def written(path, text):
    path.write_bytes(text.encode())
    return path


def read(path, **options):
    return read_trajectory_file(path, AUTO, repair=True, **options)


SLOW_TEXTS = {
    "header of brackets": "t,x["
    + " " * 600
    + ",y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n",
    "long header of brackets": "t,x" + "[(" * 30_000 + "\n0,1\n",
    "long header of blanks": "t,x[" + " " * 60_000 + "]]\n0,1\n",
    "long number": "1" * 60_000 + "x,1,2,3,0,0,0,1\n",
    "long decimal comma": "1" * 60_000 + ";" + "2" * 5_000 + "\n",
    "long angle": "t,lat,lon,height\n0," + "1 " * 30_000 + ",0,0\n",
    "long date": "2023-11-14 " + "1:" * 30_000 + " 1 2 3 0 0 0 1\n",
    "long second column": "123456789,1," + "a" * 60_000 + "\n",
    "many text lines": "a b c\n" * 200_000,
    "many wide rows": ("1," * 30_000 + "1\n") * 60,
}


@pytest.mark.parametrize("kind", SLOW_TEXTS)
def test_text_that_is_made_to_take_long_takes_seconds_at_most(tmp_path, kind):
    path = written(tmp_path / "poses.csv", SLOW_TEXTS[kind])
    began = time.process_time()
    message = ""
    try:
        assert len(read(path).trajectory) == 1
    except InputError as error:
        message = str(error)
    assert time.process_time() - began < 3.0
    assert "\n" not in message
    assert len(message) < 2_000
