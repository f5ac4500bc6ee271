"""Read lidar scans, images of a target and files of other programs as poses."""

from pathlib import Path
from typing import Any

from hand_eye_calib.core.base.registry import (
    BAG_READINGS,
    FILE_READERS,
    TARGET_IMAGES,
)


def register() -> None:
    """Register the readers of messages and files."""
    BAG_READINGS["sensor_msgs/msg/PointCloud2"] = _scans
    BAG_READINGS["images of a target"] = _images
    TARGET_IMAGES["folder"] = _target_images
    TARGET_IMAGES["corners"] = _corners
    FILE_READERS["other programs"] = _other_programs


def _scans(bag: Any, stream: str, topic: str, _: str) -> Any:
    from hand_eye_calib.extras.sensors.scans import ScanReading

    return ScanReading(stream, topic, bag.paths[0], bag.files)


def _images(bag: Any, stream: str, topic: str, text: str) -> Any:
    from hand_eye_calib.extras.sensors.images import read_images

    return read_images(bag, stream, topic, text)


def _other_programs(path: str | Path, data: bytes, options: Any) -> Any:
    from hand_eye_calib.extras.sensors.foreign import table_of_program

    return table_of_program(path, data, options)


def _target_images() -> Any:
    from hand_eye_calib.extras.sensors import target_images

    return target_images


def _corners() -> Any:
    from hand_eye_calib.extras.sensors import corners

    return corners
