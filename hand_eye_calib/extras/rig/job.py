"""The command ``rig``: calibrate three sensors or more together."""

from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.offline.cli.jobs import Job

# Smallest number of sensors of a rig.
_MIN_SENSORS = 3

_BRIEF = """\
PATH:
  lidar.tum front.tum rear.tum   trajectory files; the first is of the reference sensor
  my_bag --topics A B C          a bag, and its topics with poses

most used options:
  --topics TOPIC ...       pose topics of a bag, or frames such as odom:lidar
  --time-offset estimate   the sensors' clocks differ
  --out DIR                save the results, the files for ROS and report.html

examples:
  hand_eye_calib rig lidar.tum front.tum rear.tum --out rig
  hand_eye_calib rig my_bag --topics /lidar/odometry /front/vio odom:rear --out rig"""


def _prepare(arguments: Any) -> None:
    """Raise a ConfigError if the arguments name fewer than three sensors."""
    n_sensors = len(arguments.topics or arguments.paths)
    if n_sensors < _MIN_SENSORS:
        raise ConfigError(
            f"rig needs {_MIN_SENSORS} sensors or more, got {n_sensors}: pass a trajectory file "
            "of each, or a bag with --topics A B C; calibrate is for two sensors"
        )


RIG = Job("[OPTION ...] PATH ...", _BRIEF, _prepare)
