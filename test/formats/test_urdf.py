"""Robot descriptions: what is fixed to what."""

import time

import numpy as np
import pytest
from bag_making import TF, tf_message, write_messages
from numpy.testing import assert_allclose

from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.installed import open_installed, read_urdf

URDF = """<?xml version="1.0" encoding="utf-8"?>
<!-- origin xyz="9 9 9": a decoy; the mast's <joint> is bent -->
<robot name='r'>
\t<link name="base_link"><visual><origin xyz="7 7 7" rpy="0 0 0"/></visual></link>
  <link name="lidar"/><link name="camera"/><link name="optical"/><link name="arm"/>
  <joint name="to_lidar" type="fixed">
    <parent link="base_link"/> <child link="lidar"/>
    <origin rpy="0 0 0"
            xyz='1.0   0 2.0' />   <!-- 1 m ahead -->
  </joint>
  <joint name="to_camera" type="fixed">
    <origin xyz="0.5 0 1" rpy="0 0.1 0"/><parent link="base_link"/><child link="camera"/></joint>
  <joint name="shoulder" type="revolute"><parent link="base_link"/><child link="arm"/></joint>
  <joint name="plain" type="fixed"><parent link="camera"/><child link="optical"/></joint>
</robot>\r
"""


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_bytes(URDF.encode())
    return path


def test_frames_through_the_base(urdf):
    T_lidar_camera = read_urdf(urdf).pose("lidar", "camera")
    assert_allclose(T_lidar_camera[:3, 3], [-0.5, 0, -1])
    assert_allclose(
        se3.rotation_to_rpy(T_lidar_camera[:3, :3]), [0, 0.1, 0], atol=1e-12
    )


def test_a_chain_of_thousands_of_joints_takes_no_time(tmp_path):
    links = "".join(f'<link name="l{k}"/>' for k in range(5001))
    joints = "".join(
        f'<joint name="j{k}" type="fixed"><origin xyz="0.1 0 0"/><parent link="l{k}"/>'
        f'<child link="l{k + 1}"/></joint>'
        for k in range(5000)
    )
    (tmp_path / "long.urdf").write_text(
        f'<robot name="r">{links}{joints}</robot>'
    )
    began_s = time.process_time()
    assert read_urdf(tmp_path / "long.urdf").pose("l0", "l5000")[
        0, 3
    ] == pytest.approx(500.0)
    assert time.process_time() - began_s < 3.0  # 0.3; quadratic: 30


@pytest.mark.parametrize(
    ("old", "new", "frames", "text"),
    [
        ("", "", ("lidar", "arm"), "not fixed to each other: arm moves"),
        (
            "",
            "",
            ("lidar", "radar"),
            "no frame 'radar' in the robot description; it has base_li",
        ),
        (
            '<link name="lidar"/>',
            "<xacro:lidar/>",
            ("lidar", "camera"),
            "has xacro macros",
        ),
        (
            'xyz="0.5 0 1"',
            'xyz="${x} 0 1"',
            ("lidar", "camera"),
            "not six numbers",
        ),
        (
            'xyz="0.5 0 1"',
            'xyz="0.5 0 1" quat_xyzw="0 0 0 1"',
            ("lidar", "camera"),
            "xyz and rpy",
        ),
        (
            'link="optical"',
            'link="lidar"',
            ("lidar", "camera"),
            "'lidar' has two parents",
        ),
        ("</robot>", "", ("lidar", "camera"), "not XML"),
        ("robot", "sdf", ("lidar", "camera"), "found <sdf>"),
    ],
)
def test_what_is_not_understood_is_refused(urdf, old, new, frames, text):
    urdf.write_text(URDF.replace(old, new))
    with pytest.raises(InputError, match=text):
        read_urdf(urdf).pose(*frames)


def test_installed_from_numbers_and_descriptions(urdf):
    numbers = open_installed("-50cm 0 -1 0 0.1 0deg")("lidar", "camera")
    drawn = open_installed(str(urdf))("lidar", "camera")
    assert_allclose(numbers.T_parent_child, drawn.T_parent_child, atol=1e-12)
    assert not numbers.covariance.any()
    with pytest.raises(ConfigError, match="installed: no file"):
        open_installed("robot.urdf")("lidar", "camera")
    with pytest.raises(InputError, match="no frame 'radar'"):
        open_installed(str(urdf))("lidar", "radar")


class TestBag:
    """What is installed, from the static transforms of a bag."""

    def bag(self, path, *edges):
        messages = [
            (number, "/tf_static", TF, tf_message([(0, *edge)]))
            for number, edge in enumerate(edges, start=1)
        ]
        return write_messages(path / "bag", messages)

    def test_its_last_static_transforms_count(self, tmp_path):
        T = se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
        bag = self.bag(
            tmp_path,
            ("base", "lidar", T),
            ("base", "camera", T),
            ("base", "camera", T @ T),
        )
        installed = open_installed(str(bag))("lidar", "camera")
        assert_allclose(installed.T_parent_child, T, atol=1e-12)
        with pytest.raises(
            InputError, match="no frame 'radar' in the bag's transforms"
        ):
            open_installed(str(bag))("lidar", "radar")

    def test_a_transform_that_is_none_is_left_out(self, tmp_path):
        T = np.eye(4)
        T[0, 3] = np.nan
        bag = self.bag(tmp_path, ("base", "lidar", T))
        with pytest.raises(InputError, match="no frame 'base'"):
            open_installed(str(bag))("base", "lidar")
