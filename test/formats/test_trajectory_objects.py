"""Trajectories from and for other libraries: pandas, NumPy, bags."""

import dataclasses
import sys
from fractions import Fraction

import numpy as np
import pytest
from motions import as_trajectory, child_of, wandering_poses
from numpy.testing import assert_allclose
from result_making import calibration

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import (
    ConfigError,
    InputError,
    MissingDependencyError,
)
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.bags.writer import write_bag

EPOCH_NS = 1_700_000_000_123_456_789
POSES = wandering_poses(30)
TRAJECTORY = hec.Trajectory(EPOCH_NS + 50_000_000 * np.arange(30), POSES)
QUATS_XYZW = se3.to_quat_xyzw(POSES)
SECONDS = TRAJECTORY.stamps_ns / 1e9
# float64 seconds since 1970 have steps of 238 ns.
STEP_NS = 240


def rows(*names):
    """Columns of the trajectory, by name, in seconds."""
    columns = dict(zip("xyz", POSES[:, :3, 3].T, strict=True)) | {"t": SECONDS}
    columns |= dict(zip(("qx", "qy", "qz", "qw"), QUATS_XYZW.T, strict=True))
    return np.column_stack([columns[name] for name in names])


def assert_same(trajectory, tolerance_ns=STEP_NS):
    assert (
        np.abs(trajectory.stamps_ns - TRAJECTORY.stamps_ns).max()
        <= tolerance_ns
    )
    assert_allclose(trajectory.poses, TRAJECTORY.poses, atol=1e-12)


class TestReading:
    def test_matrices_with_seconds_or_nanoseconds_or_datetimes(self):
        assert_same(hec.read_trajectory(POSES, times=SECONDS))
        assert_same(hec.read_trajectory(POSES, times=TRAJECTORY.stamps_ns), 0)
        dates = TRAJECTORY.stamps_ns.astype("datetime64[ns]")
        assert_same(hec.read_trajectory(POSES, times=dates), 0)
        assert_same(hec.read_trajectory(POSES.tolist(), times=SECONDS.tolist()))
        assert hec.read_trajectory(TRAJECTORY) is TRAJECTORY

    def test_rows_in_the_order_of_tum(self):
        tum = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
        assert_same(hec.read_trajectory(rows(*tum)))
        assert_same(hec.read_trajectory(rows(*tum[1:]), times=SECONDS))
        with pytest.raises(InputError, match="quaternion of length"):
            hec.read_trajectory(rows(*reversed(tum)))

    def test_a_topic_of_a_bag(self, tmp_path):
        write_bag(
            tmp_path / "bag", {"/lidar": (TRAJECTORY, "nav_msgs/msg/Odometry")}
        )
        assert_same(hec.read_trajectory(tmp_path / "bag", topic="/lidar"), 0)

    @pytest.mark.parametrize(
        ("source", "options", "error", "message"),
        [
            (POSES, {}, InputError, "no stamps"),
            (
                POSES,
                {"times": SECONDS[:-1]},
                InputError,
                "one stamp per pose; found 29 stamps",
            ),
            (
                5,
                {"times": SECONDS},
                InputError,
                r"expected a path, .* found an array \(\)",
            ),
            ({"a": 1}, {}, InputError, "expected a path, .* found dict"),
            (
                np.zeros((3, 5)),
                {},
                InputError,
                r"of t, x, .*; found an array \(3, 5\)",
            ),
            (
                POSES,
                {"times": SECONDS, "columns": "x"},
                ConfigError,
                "to text files",
            ),
            (
                POSES,
                {"times": SECONDS, "stamp_unit": "h"},
                ConfigError,
                "unknown unit",
            ),
            (
                POSES,
                {"times": SECONDS, "format": "csv"},
                ConfigError,
                "to text files",
            ),
            (POSES, {"topic": "/a"}, ConfigError, "for bags"),
            (POSES, {"times": SECONDS * np.nan}, InputError, "finite numbers"),
            (POSES, {"times": SECONDS * 1e12}, InputError, "too large"),
        ],
        ids=lambda value: value if isinstance(value, str) else "",
    )
    def test_what_cannot_be_read_is_refused_in_words(
        self, source, options, error, message
    ):
        with pytest.raises(error, match=message):
            hec.read_trajectory(source, **options)

    def test_poses_out_of_order_are_refused_or_repaired(self):
        order = np.r_[0, 2, 1, 2, 3:30]
        with pytest.raises(InputError, match="stamps must increase"):
            hec.read_trajectory(POSES[order], times=SECONDS[order])
        with pytest.warns(
            UserWarning, match="were sorted; dropped 1 with a repeated stamp"
        ):
            assert_same(
                hec.read_trajectory(
                    POSES[order], times=SECONDS[order], repair=True
                )
            )


class TestTables:
    pd = pytest.importorskip("pandas")

    def frame(self, **more):
        names = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
        return self.pd.DataFrame(rows(*names), columns=names).assign(**more)

    def test_columns_are_found_by_their_names(self):
        assert_same(hec.read_trajectory(self.frame(speed=1.0)))
        exact = self.frame(t=TRAJECTORY.stamps_ns)
        assert_same(hec.read_trajectory(exact), 0)
        assert_same(hec.read_trajectory(exact[[*reversed(exact.columns)]]), 0)
        with pytest.raises(InputError, match="no column for qw among t, x, y"):
            hec.read_trajectory(exact.drop(columns="qw"))

    def test_an_index_of_times_is_the_stamps(self):
        for zone in (None, "UTC"):
            index = self.pd.to_datetime(
                TRAJECTORY.stamps_ns, utc=zone is not None
            )
            frame = self.frame(t=0.0).set_index(index)
            assert_same(hec.read_trajectory(frame, times=frame.index), 0)

    def test_without_pandas_one_line_says_so(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "pandas", None)
        with pytest.raises(
            MissingDependencyError, match=r"pip install '\.\[notebook"
        ):
            calibration().to_frame()

    def test_stamps_keep_their_digits_and_whole_numbers_are_in_the_unit_of_their_size(
        self,
    ):
        exact = Fraction(1_700_000_000.123456) * 10**9
        stamp_ns = hec.read_trajectory(
            POSES[:1], times=[1_700_000_000.123456]
        ).stamps_ns[0]
        assert abs(int(stamp_ns) - exact) <= Fraction(1, 2)
        for factor in (1, 10**3, 10**6, 10**9):
            trajectory = hec.read_trajectory(
                POSES[:1], times=[1_700_000_000 * factor]
            )
            assert trajectory.stamps_ns == [1_700_000_000 * 10**9]
        assert hec.read_trajectory(
            POSES[:1], times=[5], stamp_unit="ms"
        ).stamps_ns == [5_000_000]


class TestShowing:
    def test_a_figure_shows_both_sensors_from_three_sides(self):
        result = hec.calibrate(
            as_trajectory(POSES), as_trajectory(child_of(POSES))
        )
        assert len(repr(result)) < 600 + len("".join(result.warnings))
        assert len(repr(TRAJECTORY)) < 100
        for source in (result, hec.Calibration.from_dict(result.to_dict())):
            figure = hec.plot(source)
            seen = [
                (panel.get_xlabel(), panel.get_ylabel())
                for panel in figure.axes
            ]
            assert seen == [
                ("x (m)", "y (m)"),
                ("x (m)", "z (m)"),
                ("y (m)", "z (m)"),
            ]
            (ellipse,) = figure.axes[0].patches
            assert_allclose(
                ellipse.get_center(), result.translation[:2], atol=1e-9
            )
            assert figure._repr_png_().startswith(b"\x89PNG")
            panels = figure.subplots(1, 3)
            assert source.plot(ax=panels) is figure
            assert panels[0].patches
        hidden = tuple(
            dataclasses.replace(dof, sigma=np.inf) if dof.name == "z" else dof
            for dof in result.observability
        )
        figure = hec.plot(
            dataclasses.replace(result, observability_measured=hidden)
        )
        assert [len(panel.patches) for panel in figure.axes] == [1, 0, 0]
        assert (
            "Unknown along z: the dashed line." in figure._supxlabel.get_text()
        )
