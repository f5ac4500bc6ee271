"""What the contracts of import-linter cannot say: confined libraries, circles, defaults."""

import ast
import dataclasses
import inspect
import re
from graphlib import CycleError, TopologicalSorter

import pytest
from source_code import PACKAGE, SOURCE, imports_of

from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig
from hand_eye_calib.extras.simulation.options import NoiseConfig

# Where a library that is heavy, optional or bound to ROS may be imported.
MESSAGES = ("nav", "sensor", "geometry", "std", "diagnostic", "tf2", "rosgraph")
ROS_LIBRARIES = [f"{name}_msgs" for name in MESSAGES]
ROS_LIBRARIES += [
    "rclpy",
    "rcl_interfaces",
    "builtin_interfaces",
    "rosidl_runtime_py",
]
ROS_LIBRARIES += ["std_srvs", "tf2_ros", "visualization_msgs"]
ROS = ("online/ros/", "extras/simulation/player.py")
PAGES = (
    "offline/report/",
    "extras/clouds/figure.py",
    "extras/fleet/batch_page.py",
    "extras/mount/fleet_page.py",
)
CONFINED = dict.fromkeys(ROS_LIBRARIES, ROS) | {
    "rosbags": ("formats/bags/",),
    "mcap": ("formats/bags/",),
    "backports": ("formats/bags/storage.py",),
    "fsspec": ("formats/remote.py",),
    "pyulog": ("extras/sensors/ulog.py",),
    "casadi": ("core/solvers/ipopt.py",),
    "matplotlib": PAGES,
    "pandas": ("core/results/calibration.py", "extras/fleet/together.py"),
    "jinja2": PAGES,
}


def breaches(package_root):
    """One line per import that takes a confined library out of its place, or the public API."""
    messages = []
    for path in sorted(package_root.rglob("*.py")):
        relative = path.relative_to(package_root).as_posix()
        for name in imports_of(path, package_root):
            top, *rest = name.split(".")
            homes = CONFINED.get(top)
            if homes and not relative.startswith(homes):
                messages.append(
                    f"{relative}: {top} may be imported only in {', '.join(homes)}"
                )
            if top == PACKAGE and not (
                rest and (package_root / rest[0]).is_dir()
            ):
                messages.append(
                    f"{relative}: the package must not import its own public API"
                )
    return messages


def test_libraries_stay_in_their_places_and_nothing_imports_the_public_api():
    assert len(list(SOURCE.rglob("*.py"))) > 10, f"no sources found in {SOURCE}"
    assert breaches(SOURCE) == []


@pytest.mark.parametrize(
    ("file", "line", "message"),
    [
        (
            "core/errors.py",
            "from hand_eye_calib import calibrate",
            "the package must not import its own public API",
        ),
        (
            "offline/main.py",
            "import importlib\nimportlib.import_module('fsspec.core')",
            "fsspec may be imported only in formats/remote.py",
        ),
    ],
)
def test_a_breach_is_caught(tmp_path, file, line, message):
    for layer in ("core", "offline"):
        (tmp_path / layer).mkdir()
        (tmp_path / layer / "__init__.py").touch()
    breach = tmp_path / file
    assert breaches(tmp_path) == []
    breach.write_text(line + "\n")
    assert breaches(tmp_path) == [f"{file}: {message}"]


ORDER = ("core", "formats", "online", "offline", "extras")
# Layers that a layer knows.
BELOW = {layer: {"core", "formats", layer} for layer in ORDER} | {
    "extras": {*ORDER}
}
BELOW["core"] = {"core"}


def modules_in_texts(path):
    """Modules of the package that texts of a file name, docstrings left out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    alone = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)
    }
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in alone
        ):
            yield from re.findall(
                rf"{PACKAGE}\.({'|'.join(ORDER)})\b", node.value
            )


def test_no_text_names_a_module_of_a_layer_above():
    pairs = {
        (path.relative_to(SOURCE).parts[0], layer)
        for path in SOURCE.glob("*/**/*.py")
        for layer in modules_in_texts(path)
    }
    assert ("online", "online") in pairs  # code of the solving process
    assert [
        (own, layer) for own, layer in sorted(pairs) if layer not in BELOW[own]
    ] == []


def file_imports(package_root):
    """File to the files of the package that it imports, both as dotted names; "" is the package's
    __init__.py.
    """
    modules = {}
    for path in sorted(package_root.rglob("*.py")):
        parts = path.relative_to(package_root).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = (
            path
        )
    graph = {}
    for module, path in modules.items():
        targets = set()
        for name in imports_of(path, package_root):
            top, _, rest = name.partition(".")
            if top != PACKAGE:
                continue
            while (
                rest and rest not in modules
            ):  # a name in a file rather than a file
                rest = rest.rpartition(".")[0]
            targets.add(rest)
        graph[module] = targets - {module}
    return graph


def without_registration(graph):
    """Imports without those of the packages' ``__init__.py``, which register lazily."""
    packages = {
        name for name in graph if (SOURCE / name.replace(".", "/")).is_dir()
    }
    return {
        name: targets for name, targets in graph.items() if name not in packages
    }


def test_no_files_import_each_other_in_a_circle():
    graph = without_registration(file_imports(SOURCE))
    assert "core.engine.snapshot" in graph["core.engine.calibrator"]
    TopologicalSorter(graph).prepare()
    circle = {"core.engine.snapshot": {"core.engine.calibrator"}}
    with pytest.raises(CycleError):
        TopologicalSorter(graph | circle).prepare()


def repeated_defaults(package_root):
    """Parameters and fields outside the option classes that write the default of an option again;
    nothing (0, "", False) is no choice and may stand anywhere.
    """
    defaults = {}
    for options in (CalibratorConfig, NodeConfig, NoiseConfig):
        for field in dataclasses.fields(options):
            defaults |= {
                field.name: field.default,
                f"{field.name}_s": field.default,
            }
    homes = {
        inspect.getsourcefile(options)
        for options in (CalibratorConfig, NoiseConfig)
    }
    repeated = []
    for path in sorted(package_root.rglob("*.py")):
        if str(path) in homes:
            continue
        for name, default, line in _written_defaults(path):
            if default and defaults.get(name) == default:
                repeated.append(
                    f"{path.relative_to(package_root)}:{line}: {name} = {default!r}"
                )
    return repeated


def _written_defaults(path):
    """(name, value, line) of every parameter and annotated field with a literal as its default."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        pairs = []
        if isinstance(node, ast.FunctionDef):
            taken = node.args.posonlyargs + node.args.args
            pairs = [
                *zip(
                    reversed(taken), reversed(node.args.defaults), strict=False
                )
            ]
            pairs += zip(
                node.args.kwonlyargs, node.args.kw_defaults, strict=True
            )
            pairs = [(taken.arg, default) for taken, default in pairs]
        elif isinstance(node, ast.AnnAssign) and isinstance(
            node.target, ast.Name
        ):
            pairs = [(node.target.id, node.value)]
        for name, default in pairs:
            if isinstance(default, ast.Constant):
                yield name, default.value, default.lineno


def test_defaults_of_options_stand_in_one_place(tmp_path):
    assert repeated_defaults(SOURCE) == []
    (tmp_path / "late.py").write_text(
        "def a(x, max_gap_s=0.5, time_offset_s=0.0): ...\n"
    )
    assert repeated_defaults(tmp_path) == ["late.py:1: max_gap_s = 0.5"]
