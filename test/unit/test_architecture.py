"""Imports go one way, and the heavy or ROS-bound libraries stay in their rooms."""

import ast
import dataclasses
import inspect
from graphlib import CycleError, TopologicalSorter

import pytest
from source_code import PACKAGE, SOURCE, imports_of, room_of

from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig
from hand_eye_calib.extras.simulation.options import NoiseConfig

# A room is a sub-package or a module at the top; "root" is the package's own __init__.py, the
# public Python API. In the engine each room sees only rooms before it.
GROUND = {"errors", "text", "config", "arrays", "stats", "plain", "version", "registry", "option"}
GROUND |= {"python_path", "blocks"}
ENGINE = {
    "errors": set(),
    "arrays": set(),
    "stats": {"arrays"},
    "blocks": {"arrays"},
    "plain": {"errors"},
    "version": set(),
    "python_path": set(),
    "registry": {"errors"},
    "text": {"errors"},
    "option": {"errors", "text"},
    "config": {"errors", "text", "option"},
    "geometry": GROUND,
    "results": GROUND | {"geometry"},
    "pairing": GROUND | {"geometry"},
}
ENGINE["solvers"] = GROUND | {"geometry", "pairing"}
ENGINE["gls"] = ENGINE["solvers"] | {"results", "solvers"}
ENGINE["assessment"] = ENGINE["gls"] | {"gls"}
ENGINE["alignment"] = ENGINE["solvers"] | {"results", "solvers"}
ENGINE["checks"] = ENGINE["alignment"] | {"results", "gls", "assessment", "alignment"}
ENGINE["engine"] = {*ENGINE, "io"}
ENGINE["session"] = set(ENGINE)
ALLOWED = ENGINE | {
    "io": GROUND | {"geometry", "results", "engine"},
    "report": {"cli", "io", *ENGINE},
    "simulation": GROUND | {"geometry", "io"},
    "offline": {"registry", "cli", "report", "io"},
    "online": {"registry", "cli"},
    "root": GROUND
    | {"geometry", "results", "engine", "session", "io", "report", "simulation"}
    | {"offline", "online", "extras"},
    "live": {"io", *ENGINE},
    "watch": {"errors", "plain", "stats", "text", "results", "live"},
    "ros": {"io", "live", "watch", *ENGINE},
    "cli": {"io", "report", "simulation", "live", "watch", "ros", *ENGINE},
    "extras": {"io", "report", "simulation", "live", "watch", "ros", "cli", *ENGINE},
    "__main__": {"cli", "python_path"},
}

# Where a library that is heavy, optional or bound to ROS may be imported.
MESSAGES = ("nav", "sensor", "geometry", "std", "diagnostic", "tf2", "rosgraph")
ROS_LIBRARIES = [f"{name}_msgs" for name in MESSAGES]
ROS_LIBRARIES += ["rclpy", "rcl_interfaces", "builtin_interfaces", "rosidl_runtime_py"]
ROS_LIBRARIES += ["std_srvs", "tf2_ros"]
CONFINED = dict.fromkeys(ROS_LIBRARIES, "ros/") | {
    "rosbags": "io/bags/",
    "mcap": "io/bags/",
    "backports": "formats/bags/storage.py",
    "fsspec": "formats/remote.py",
    "pyulog": "extras/sensors/foreign.py",
    "casadi": "core/solvers/ipopt.py",
    "matplotlib": "report/",
    "pandas": ("core/results/calibration.py", "extras/fleet/together.py"),
    "jinja2": "report/",
}


def breaches(package_root):
    """One line per import that goes the wrong way or takes a confined library out of its room."""
    rooms = {room_of(path.relative_to(package_root)) for path in package_root.rglob("*.py")}
    found = []
    for path in sorted(package_root.rglob("*.py")):
        relative = path.relative_to(package_root)
        room = room_of(relative)
        if room not in ALLOWED:
            found.append(f"{relative}: room {room!r} has no place in the import order")
            continue
        for name in imports_of(path, package_root):
            top, *rest = name.split(".")
            home = CONFINED.get(top)
            if home and not relative.as_posix().startswith(home):
                found.append(f"{relative}: {top} may be imported only in {home}")
            if top == PACKAGE:
                target = rest[0] if rest and rest[0] in rooms else "root"
                if target not in ALLOWED[room] | {room}:
                    found.append(f"{relative}: {room} must not import {target}")
    return found


def test_imports_go_one_way_and_libraries_stay_in_their_rooms():
    assert len(list(SOURCE.rglob("*.py"))) > 10, f"no sources found in {SOURCE}"
    assert breaches(SOURCE) == []


def file_imports(package_root):
    """File to the files of the package that it imports, both as dotted names; "" is the package's
    __init__.py.
    """
    modules = {}
    for path in sorted(package_root.rglob("*.py")):
        parts = path.relative_to(package_root).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    graph = {}
    for module, path in modules.items():
        targets = set()
        for name in imports_of(path, package_root):
            top, _, rest = name.partition(".")
            if top != PACKAGE:
                continue
            while rest and rest not in modules:  # a name in a file rather than a file
                rest = rest.rpartition(".")[0]
            targets.add(rest)
        graph[module] = targets - {module}
    return graph


def test_no_files_import_each_other_in_a_circle():
    graph = file_imports(SOURCE)
    assert "engine.snapshot" in graph["engine.calibrator"]
    TopologicalSorter(graph).prepare()
    TopologicalSorter(ENGINE).prepare()
    with pytest.raises(CycleError):  # the public API names the homes of its names
        TopologicalSorter(graph | {"engine.snapshot": {"engine.calibrator"}}).prepare()


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        (
            "core/geometry/se3.py",
            "def late():\n    from ..solvers import dnlo",
            "geometry must not import solvers",
        ),
        ("errors.py", "from hand_eye_calib import calibrate", "errors must not import root"),
        (
            "offline/cli/main.py",
            "import importlib\nimportlib.import_module('matplotlib.pyplot')",
            "matplotlib may be imported only in report/",
        ),
        ("attic/old.py", "", "room 'attic' has no place in the import order"),
    ],
)
def test_a_breach_is_caught(tmp_path, file, line, message):
    for room in ("geometry", "solvers", "cli", "ros"):
        (tmp_path / room).mkdir()
        (tmp_path / room / "__init__.py").touch()
    breach = tmp_path / file
    breach.parent.mkdir(exist_ok=True)
    assert breaches(tmp_path) == []
    breach.write_text(line + "\n")
    assert breaches(tmp_path) == [f"{file}: {message}"]


def repeated_defaults(package_root):
    """Parameters and fields outside the option classes that write the default of an option again;
    nothing (0, "", False) is no choice and may stand anywhere.
    """
    defaults = {}
    for options in (CalibratorConfig, NodeConfig, NoiseConfig):
        for field in dataclasses.fields(options):
            defaults |= {field.name: field.default, f"{field.name}_s": field.default}
    homes = {inspect.getsourcefile(options) for options in (CalibratorConfig, NoiseConfig)}
    found = []
    for path in sorted(package_root.rglob("*.py")):
        if str(path) in homes:
            continue
        for name, default, line in _written_defaults(path):
            if default and defaults.get(name) == default:
                found.append(f"{path.relative_to(package_root)}:{line}: {name} = {default!r}")
    return found


def _written_defaults(path):
    """(name, value, line) of every parameter and annotated field with a literal as its default."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        pairs = []
        if isinstance(node, ast.FunctionDef):
            taken = node.args.posonlyargs + node.args.args
            pairs = [*zip(reversed(taken), reversed(node.args.defaults), strict=False)]
            pairs += zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
            pairs = [(taken.arg, default) for taken, default in pairs]
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            pairs = [(node.target.id, node.value)]
        for name, default in pairs:
            if isinstance(default, ast.Constant):
                yield name, default.value, default.lineno


def test_defaults_of_options_stand_in_one_place(tmp_path):
    assert repeated_defaults(SOURCE) == []
    (tmp_path / "late.py").write_text("def a(x, max_gap_s=0.5, time_offset_s=0.0): ...\n")
    assert repeated_defaults(tmp_path) == ["late.py:1: max_gap_s = 0.5"]
