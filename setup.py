"""Build script for colcon (ament_python) and pip. Name, version, description, maintainer, licence
and addresses come from package.xml.
"""

import re
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

# Resolved, because colcon build --symlink-install runs a link to this file in a folder that has
# little else.
HERE = Path(__file__).resolve().parent
manifest = ElementTree.parse(HERE / "package.xml").getroot()
name = manifest.findtext("name")
addresses = {url.get("type"): url.text for url in manifest.iter("url")}

# For `ros2 run hand_eye_calib COMMAND` every command is an executable in the package's own folder.
# pip puts executables on PATH, where names such as `info` belong to others: there only these two.
PIP_COMMANDS = ("calibrator", "replay")
# colcon and bloom call these commands of setup.py, pip others.
is_for_ros = not {"install", "develop"}.isdisjoint(sys.argv)


def files(pattern):
    """Relative paths, as setuptools wants its data files."""
    return sorted(
        path.relative_to(HERE).as_posix() for path in HERE.glob(pattern)
    )


def all_commands():
    """Names in the table of commands, which imports nothing but Python."""
    sys.path.insert(0, str(HERE))
    from hand_eye_calib.core.base.registry import COMMANDS

    return tuple(COMMANDS)


def readme():
    """The README, its links made absolute for pages that have nothing else of the repository."""
    text = (HERE / "README.md").read_text(encoding="utf-8")
    return re.sub(
        r"\]\((?![a-z]+:|#)", f"]({addresses['repository']}/raw/main/", text
    )


setup(
    name=name,
    version=manifest.findtext("version")
    + manifest.findtext("export/pre_release", ""),
    description=manifest.findtext("description"),
    long_description=readme(),
    long_description_content_type="text/markdown",
    author=manifest.findtext("author"),
    maintainer=manifest.findtext("maintainer"),
    maintainer_email=manifest.find("maintainer").get("email"),
    license=manifest.findtext("license"),
    url=addresses["website"],
    project_urls={
        "Source": addresses["repository"],
        "Issues": addresses["bugtracker"],
        "Paper": "https://doi.org/10.3390/s23073740",
    },
    keywords=[
        "extrinsic calibration",
        "hand-eye calibration",
        "sensor calibration",
        "lidar",
        "camera",
        "GNSS",
        "odometry",
        "ROS 2",
        "robotics",
    ],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Manufacturing",
        "Intended Audience :: Science/Research",
        "Operating System :: OS Independent",
        "Programming Language :: Python :: 3 :: Only",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Programming Language :: Python :: 3.13",
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    packages=find_packages(include=[name, f"{name}.*"]),
    package_data={
        name: ["py.typed", "*.pyi", "sample/*"],
        f"{name}.offline.report": ["templates/*.html", "templates/*.css"],
        f"{name}.formats": ["templates/*", "*.yaml"],
        f"{name}.extras.fleet": ["*.html"],
        f"{name}.extras.mount": ["*.html"],
        f"{name}.extras.rig": ["*.html"],
        f"{name}.online.watch": ["page/*"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
        (f"share/{name}/config", files("config/*.*")),
        (f"share/{name}/launch", files("launch/*.launch.py")),
        # A workspace has bin/ on PATH, but not lib/; pip makes the same command itself.
        *([("bin", ["scripts/hand_eye_calib"])] if is_for_ros else []),
    ],
    zip_safe=False,
    python_requires=">=3.11",
    # Upper bounds: the next major version of a library, or minor one before 1.0, may change what is
    # used here.
    install_requires=[
        "backports.zstd>=1.0,<2; python_version < '3.14'",
        "casadi>=3.7,<4",
        "jinja2>=3.1.2,<4",
        "matplotlib>=3.6,<4",
        "mcap>=1.1,<2",
        "numpy>=1.26,<3",
        "PyYAML>=6.0,<7",
        "rich>=13.7,<16",
        "rosbags>=0.11.7,<0.12",
        "scipy>=1.11,<2",
    ],
    extras_require={
        "ros": ["ros-jazzy-common-interfaces", "ros-jazzy-rclpy[fastrtps]"],
        "camera": ["opencv-python-headless>=4.7,<5"],
        "cluster": ["distributed>=2024.1,<2028"],
        # Not of "test": colcon would report on every file after each run, for minutes.
        "coverage": ["pytest-cov>=5"],
        "qr": ["segno>=1.5,<2"],
        "foxglove": ["mcap-protobuf-support>=0.5,<1"],
        "fleet": ["fsspec[http]>=2024.2,<2028"],
        "lidar": ["small_gicp>=1.0,<2"],
        "notebook": ["ipykernel>=6.29,<8", "pandas>=2.1,<4"],
        "px4": ["pyulog>=1.0,<2"],
        "test": [
            "colcon-common-extensions",
            "foxglove-schemas-protobuf",
            "hypothesis>=6.98",
            "nbclient>=0.9",
            "packaging",
            "pytest>=7.4",
            "pytest-xdist>=3.5",
            "wheel",
        ],
        "lint": [
            "import-linter==2.17",
            "mypy==2.4.1",
            "ruff==0.17.5",
            "types-PyYAML",
        ],
    },
    entry_points={
        "console_scripts": [
            f"{name} = hand_eye_calib.offline.cli.main:main",
            *(
                f"{command} = hand_eye_calib.offline.cli.main:named_command"
                for command in (all_commands() if is_for_ros else PIP_COMMANDS)
            ),
        ]
    },
)
