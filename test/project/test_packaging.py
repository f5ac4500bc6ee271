"""The package as colcon and pip install it, what its manifests promise, workflows and layouts."""

import ast
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from source_code import ROOT

from hand_eye_calib.core.base.registry import COMMANDS
from hand_eye_calib.online.live.progress import AXIS_KEYS

PACKAGE = "hand_eye_calib"
WHERE = "import hand_eye_calib; print(hand_eye_calib.__file__)"
# Installed commands in one process: each would start an interpreter.
EACH = f"""
import contextlib, runpy, sys; {WHERE}
for sys.argv in [[each, "--help"] for each in sys.argv[1:]]:
    with contextlib.suppress(SystemExit):
        runpy.run_path(sys.argv[0], run_name="__main__")
"""
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()

# Library imported: (requirement in setup.py, key in package.xml); None where that side has no say,
# as with pip and launch.
DECLARED_AS = {
    # Optional, or without a rosdep key: rosbags reads whole files of mcap.
    **{
        n: (n, None)
        for n in ("mcap", "fsspec", "small_gicp", "segno", "pandas", "pyulog")
    },
    "mcap_protobuf": ("mcap-protobuf-support", None),
    "backports": ("backports.zstd", None),  # rosbags requires it too
    "compression": (None, None),  # the standard library of Python 3.14
    "dask": ("distributed", None),
    "cv2": ("opencv-python-headless", None),
    "casadi": ("casadi", "casadi-pip"),
    "jinja2": ("jinja2", "python3-jinja2"),
    "matplotlib": ("matplotlib", "python3-matplotlib"),
    "numpy": ("numpy", "python3-numpy"),
    "rich": ("rich", "python3-rich"),
    "rosbags": ("rosbags", "python3-rosbags-pip"),
    "scipy": ("scipy", "python3-scipy"),
    "yaml": ("PyYAML", "python3-yaml"),
    **{name: ("ros-jazzy-rclpy", name) for name in ("rclpy", "rcl_interfaces")},
    **{
        name: ("ros-jazzy-common-interfaces", name)
        for name in (
            "builtin_interfaces",
            "std_srvs",
            "visualization_msgs",
            *tuple(
                f"{kind}_msgs"
                for kind in ("diagnostic", "geometry", "nav", "sensor", "std")
            ),
        )
    },
    # tf2_msgs is not among the wheels; publish_tf alone needs it.
    **{
        name: (None, name)
        for name in ("ament_index_python", "launch", "launch_ros", "tf2_msgs")
    },
}


@pytest.fixture(scope="module")
def declared():
    """What setup.py passes to setup()."""
    arguments = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr("setuptools.setup", arguments.update)
        runpy.run_path("setup.py")
    return arguments


def run(command, **options):
    """A finished process; what it said when it fails."""
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == 0, (
        f"{command} -> {done.returncode}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    )
    return done


def clean_environment(**extra):
    """The environment without what a parent's ROS wheels or another workspace put there."""
    dropped = {
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
        "LD_LIBRARY_PATH",
        "PYTHONPATH",
    }
    dropped |= {"AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH"}
    kept = {
        name: value for name, value in os.environ.items() if name not in dropped
    }
    # As in an activated virtual environment: installed commands take the interpreter on PATH.
    kept["PATH"] = os.pathsep.join(
        [str(Path(sys.executable).parent), kept.get("PATH", "")]
    )
    return kept | extra


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of what is in the repository, so that builds leave the work tree alone."""
    target = tmp_path_factory.mktemp("source") / PACKAGE
    target.mkdir()
    compiled = shutil.ignore_patterns("__pycache__")
    for folder in (PACKAGE, "config", "launch", "resource", "scripts"):
        shutil.copytree(ROOT / folder, target / folder, ignore=compiled)
    for file in (
        "package.xml",
        "setup.py",
        "setup.cfg",
        "pyproject.toml",
        "README.md",
        "LICENSE",
    ):
        shutil.copy(ROOT / file, target)
    return target


def third_party_imports(folder, calls=r"import_module|required\("):
    names = set()
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                names.add(node.module.split(".")[0])
            elif isinstance(node, ast.Call) and re.match(
                calls, ast.unparse(node.func) + "("
            ):
                names |= set(
                    re.findall(r"'(\w+)[.']", ast.unparse(node.args[0]))
                )
    return names - set(sys.stdlib_module_names) - {PACKAGE}


def test_everything_imported_is_declared_for_rosdep_and_for_pip(declared):
    keys = {element.text for element in MANIFEST.iter("exec_depend")}
    requirements = [
        declared["install_requires"],
        *declared["extras_require"].values(),
    ]
    requirements = {
        Requirement(text).name for texts in requirements for text in texts
    }
    imported = third_party_imports(ROOT / PACKAGE) | third_party_imports(
        ROOT / "launch"
    )
    assert {"numpy", "scipy", "rclpy"} <= imported
    for name in imported:
        pip_name, rosdep_key = DECLARED_AS[name]
        assert rosdep_key is None or rosdep_key in keys, (
            f"{name} is imported; package.xml lacks <exec_depend>{rosdep_key}</exec_depend>"
        )
        assert pip_name is None or pip_name in requirements, (
            f"{name} is imported; setup.py does not require {pip_name}"
        )
    # The saved launch file and the printed command run an executable of one; messages are imported
    # by the names of their types.
    assert keys - {DECLARED_AS[name][1] for name in imported} == {
        "tf2_ros",
        "sensor_msgs",
    }


def test_without_libraries_of_pip_one_line_says_what_is_missing(tmp_path):
    files = ["drives/run_01/T_S1_W1.txt", "drives/run_01/T_S2_W2.txt"]
    commands = [["simulate", "--out", "drives"], ["calibrate", *files]]
    commands.append(
        ["calibrate", *files, "--method", "dnlo", "--backend", "ipopt"]
    )
    commands.append(["simulate", "--out", "again", "--bag", "mcap"])
    # In a process of its own: a library that is imported cannot be taken away.
    program = (
        "import sys; sys.modules |= {'casadi': None, 'rosbags': None}\n"
        "from hand_eye_calib.offline.cli.main import main\n"
        f"print([int(main(command)) for command in {commands}], file=sys.stderr)"
    )
    done = run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": ROOT},
    )
    *_, casadi, rosbags, codes = done.stderr.splitlines()
    assert codes == "[0, 0, 1, 1]"
    for library, line in (("casadi", casadi), ("rosbags", rosbags)):
        assert library in line.lower()
        assert "not installed" in line


def test_links_of_the_readme_are_absolute_on_other_pages(declared):
    targets = re.findall(r"\]\(([^)\s]+)\)", declared["long_description"])
    assert len(targets) > 10
    assert [
        target for target in targets if not re.match(r"https://|#", target)
    ] == []


def test_oldest_versions_are_pinned_at_the_declared_lower_bounds(declared):
    lines = (
        (ROOT / "requirements" / "oldest.txt")
        .read_text(encoding="utf-8")
        .splitlines()
    )
    pins = dict(line.split("==") for line in lines if "==" in line)
    requirements = (
        declared["install_requires"] + declared["extras_require"]["test"]
    )
    bounded = [Requirement(text) for text in requirements if ">=" in text]
    assert len(bounded) > 6
    for requirement in bounded:
        (bound,) = [
            specifier.version
            for specifier in requirement.specifier
            if specifier.operator == ">="
        ]
        pin = pins[requirement.name]
        assert pin == bound or pin.startswith(bound + "."), (
            f"{requirement.name}: pinned {pin}, lower bound {bound}"
        )


def test_libraries_that_the_package_runs_with_have_an_upper_bound(declared):
    of_developers = {"test", "lint", "coverage"}
    of_users = list(declared["install_requires"])
    for extra, requirements in declared["extras_require"].items():
        if extra not in of_developers:
            of_users += requirements
    assert len(of_users) > 15
    for requirement in map(Requirement, of_users):
        is_of_ros = requirement.name.startswith("ros-jazzy-")
        has_bound = any(
            specifier.operator == "<" for specifier in requirement.specifier
        )
        assert has_bound or is_of_ros, f"{requirement.name} has no upper bound"


def test_licences_of_libraries_are_listed(declared):
    page = (ROOT / "THIRD_PARTY.md").read_text(encoding="utf-8")
    rows = dict(
        re.findall(r"^\| ([\w.-]+) \| [^|]+ \| ([^|]+) \|$", page, re.MULTILINE)
    )
    development = {"test", "lint", "coverage"}
    needed = [*declared["install_requires"]]
    for extra, requirements in declared["extras_require"].items():
        if extra not in development:
            needed += requirements
    assert {Requirement(text).name for text in needed} <= rows.keys()
    assert "see its page" not in rows.values()


def test_the_versions_that_ci_ran_are_within_the_declared_bounds(declared):
    lines = (
        (ROOT / "requirements" / "tested.txt")
        .read_text(encoding="utf-8")
        .splitlines()
    )
    tested = dict(line.split("==") for line in lines if "==" in line)
    tested = {
        canonicalize_name(name): version for name, version in tested.items()
    }
    for text in declared["install_requires"]:
        requirement = Requirement(text)
        assert requirement.specifier.contains(
            tested[canonicalize_name(requirement.name)]
        )


def test_the_version_is_the_same_wherever_it_is_written(declared):
    version = declared["version"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", MANIFEST.findtext("version"))
    assert version.startswith(MANIFEST.findtext("version"))
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changelog, re.MULTILINE)[1] == version
    assert f"* {version}, " in (ROOT / "CHANGELOG.rst").read_text(
        encoding="utf-8"
    )
    for page in (ROOT / "docs" / "exports").glob("*.md"):
        text = page.read_text(encoding="utf-8")
        assert set(re.findall(r"by hand_eye_calib ([\w.]+?)\. ", text)) <= {
            version
        }


def test_pip_install_gives_the_commands(declared, source, tmp_path):
    target = tmp_path / "target"
    options = "--quiet --no-deps --no-build-isolation --no-compile --disable-pip-version-check"
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        *options.split(),
        "--ignore-installed",
    ]
    run(
        [*pip, "--prefix", target, source],
        env=clean_environment(),
        cwd=tmp_path,
    )
    site = next(target.glob("lib/python*/site-packages"))
    environment = clean_environment(PYTHONPATH=str(site))

    assert {path.name for path in (target / "bin").iterdir()} == {
        "calibrator",
        PACKAGE,
        "replay",
    }
    assert not (target / "lib" / PACKAGE).exists()
    where = run([sys.executable, "-c", WHERE], env=environment, cwd=tmp_path)
    assert Path(where.stdout.strip()).is_relative_to(site)
    templates = (
        "offline/report/templates/report.html",
        "formats/templates/extrinsic.urdf.xacro.in",
    )
    for kept in (
        *templates,
        "extras/rig/rig.html",
        "formats/layouts.yaml",
        "sample/lidar.tum",
    ):
        assert (site / PACKAGE / kept).is_file()
    for command, expected in (
        ([target / "bin" / "replay", "--help"], "usage: hand_eye_calib replay"),
        ([sys.executable, "-m", PACKAGE, "--version"], declared["version"]),
    ):
        assert expected in run(command, env=environment, cwd=tmp_path).stdout
    assert_data_files(target)


def assert_data_files(prefix):
    assert (
        prefix / "share/ament_index/resource_index/packages" / PACKAGE
    ).is_file()
    share = prefix / "share" / PACKAGE
    assert (share / "package.xml").is_file()
    for folder, pattern in (("config", "*.*"), ("launch", "*.launch.py")):
        expected = {path.name for path in (ROOT / folder).glob(pattern)}
        assert expected, f"{folder} is empty"
        assert {
            path.name for path in (share / folder).iterdir() if path.is_file()
        } == expected


class TutorialCommands(NamedTuple):
    """Names in the blocks of shell commands of the tutorials and of the pages for beginners."""

    commands: set[str]
    executables: set[str]
    launch_files: set[str]


def tutorial_commands():
    pages = [*(ROOT / "docs" / "tutorials").glob("*.md")]
    pages += [
        ROOT / "docs" / f"{name}.md"
        for name in ("quickstart", "node", "installation")
    ]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    blocks = "\n".join(
        re.findall(r"```(?:bash|ini)\n(.*?)```", text, re.DOTALL)
    )
    return TutorialCommands(
        commands=set(re.findall(rf"^{PACKAGE} ([a-z]+)", blocks, re.MULTILINE)),
        executables=set(re.findall(rf"ros2 run {PACKAGE} (\w+)", blocks)),
        launch_files=set(re.findall(rf"ros2 launch {PACKAGE} (\S+)", blocks)),
    )


def test_the_commands_of_the_tutorials_exist_after_colcon_and_after_pip():
    names = tutorial_commands()
    assert names.commands >= {
        "calibrate",
        "calibrator",
        "watch",
        "info",
        "compare",
    }
    assert names.commands <= set(COMMANDS)
    assert names.executables <= set(COMMANDS)
    assert names.launch_files == {"calibrator.launch.py"}


def test_colcon_lays_out_an_install_space_whose_commands_run(
    declared, source, tmp_path
):
    colcon = [
        sys.executable,
        "-m",
        "colcon",
        "--log-base",
        tmp_path / "log",
        "build",
    ]
    options = ["--base-paths", source, "--packages-select", PACKAGE]
    options += ["--event-handlers", "console_direct+"]
    run([*colcon, *options], env=clean_environment(), cwd=tmp_path)
    prefix = tmp_path / "install" / PACKAGE
    folder = prefix / "lib" / PACKAGE
    assert_data_files(prefix)
    executables = {path.name: path for path in folder.iterdir()}
    assert set(executables) == {PACKAGE, *COMMANDS}
    for path in executables.values():
        assert (
            path.read_text(encoding="utf-8").splitlines()[0]
            == "#!/usr/bin/env python3"
        )
    (tmp_path / "each.py").write_text(EACH)
    program = (
        f"source install/setup.bash && {sys.executable} each.py '{folder}'/*"
    )
    program += f" && '{folder}/{PACKAGE}' --version"
    # The commands of the tutorials, as a shell finds them.
    program += f" && command -v {PACKAGE} && {PACKAGE} watch --help"
    output = run(
        ["bash", "-c", program], env=clean_environment(), cwd=tmp_path
    ).stdout
    assert Path(output.splitlines()[0]).resolve().is_relative_to(prefix)
    for command in COMMANDS:
        assert f"usage: hand_eye_calib {command}" in output
    assert declared["version"] in output
    assert str(prefix / "bin" / PACKAGE) in output
    assert tutorial_commands().executables <= set(executables)
    assert tutorial_commands().launch_files <= {
        path.name for path in prefix.rglob("*.launch.py")
    }


WORKFLOWS = {
    path.stem: yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]
    for path in (ROOT / ".github" / "workflows").glob("*.yml")
}


def lines(jobs):
    """What the steps of jobs run, with the values of their matrices."""
    steps = [step for job in jobs.values() for step in job["steps"]]
    steps_run = [
        line for step in steps for line in step.get("run", "").splitlines()
    ]
    matrices = [
        job.get("strategy", {}).get("matrix", {}) for job in jobs.values()
    ]
    return steps_run + [
        line for matrix in matrices for line in matrix.get("command", [])
    ]


def test_commands_exist_jobs_end_and_leave_no_credentials():
    assert WORKFLOWS.keys() >= {"ci", "nightly", "benchmark", "release"}
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = re.findall(r"^([a-z-]+)[a-z -]*:", makefile, re.MULTILINE)
    for jobs in WORKFLOWS.values():
        text = "\n".join(lines(jobs))
        assert set(re.findall(r"\bmake ([a-z-]+)", text)) <= set(targets)
        for script in re.findall(r"\S*\.ci/[a-z]+", text):
            assert os.access(
                ROOT / script.removeprefix("src/hand_eye_calib/"), os.X_OK
            )
        for job in jobs.values():
            assert 5 <= job["timeout-minutes"] <= 120
            for step in job["steps"]:
                if step.get("uses", "").startswith("actions/checkout@"):
                    assert step["with"]["persist-credentials"] is False


def test_what_ci_runs_here_runs_there_and_on_every_declared_python():
    """Each step of .ci/run is a job of the workflow."""
    steps = re.findall(
        r"^step (make [a-z-]+)",
        (ROOT / ".ci" / "run").read_text(),
        re.MULTILINE,
    )
    assert len(steps) >= 4
    assert set(steps) <= set(lines(WORKFLOWS["ci"]))
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    declared = re.findall(r"Programming Language :: Python :: (3\.\d+)", setup)
    assert WORKFLOWS["ci"]["test"]["strategy"]["matrix"]["python"] == declared
    assert f'python_requires=">={declared[0]}"' in setup


CONFIG = ROOT / "config"
NODE_PAGE = (ROOT / "docs" / "node.md").read_text(encoding="utf-8")


def test_rviz_shows_the_latched_extrinsic_with_its_covariance():
    rviz = yaml.safe_load((CONFIG / "calibrator.rviz").read_text())[
        "Visualization Manager"
    ]
    (extrinsic,) = (
        display
        for display in rviz["Displays"]
        if display["Name"] == "Extrinsic"
    )
    assert (
        extrinsic["Topic"]["Value"] == "/calibrator/extrinsic_with_covariance"
    )
    assert extrinsic["Topic"]["Durability Policy"] == "Transient Local"
    assert extrinsic["Covariance"]["Position"]["Value"] is True
    (markers,) = (
        display for display in rviz["Displays"] if display["Name"] == "Result"
    )
    assert markers["Topic"]["Value"] == "/calibrator/markers"
    assert "`~/extrinsic_with_covariance`" in NODE_PAGE
    assert "`~/markers`" in NODE_PAGE


def test_foxglove_shows_what_the_node_publishes_and_serves_each_panel_once():
    layout = json.loads((CONFIG / "foxglove_layout.json").read_text())
    panels = layout["configById"]
    services = [
        panel["serviceName"]
        for panel in panels.values()
        if "serviceName" in panel
    ]
    assert sorted(services) == [
        f"/calibrator/{name}" for name in ("reset", "save", "solve")
    ]
    for name in services:
        assert f"`~/{name.rpartition('/')[2]}`" in NODE_PAGE
    topics = ["/calibrator/extrinsic_with_covariance", "/calibrator/markers"]
    assert list(panels["3D!extrinsic"]["topics"]) == topics
    values = [
        path["value"]
        for panel in panels.values()
        for path in panel.get("paths", ())
    ]
    keys = set(re.findall(r'key=="([a-z._]+)"', " ".join(values)))
    assert keys == {
        *(f"sigma.{key}" for key in AXIS_KEYS.values()),
        "target.x",
        "target.about_x",
    }

    def placed(panel):
        if isinstance(panel, str):
            return [panel]
        return [*placed(panel["first"]), *placed(panel["second"])]

    assert sorted(placed(layout["layout"])) == sorted(panels)
