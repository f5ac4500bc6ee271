"""The Python API: typed, complete, and without a second list of options."""

import dataclasses
import inspect
from types import SimpleNamespace
from typing import Literal

import motions
import numpy as np
import pytest
import result_making
from numpy.testing import assert_allclose, assert_array_equal

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import BACKENDS, METHODS, CalibratorConfig
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.base.text import AXIS_UNITS, with_sigma
from hand_eye_calib.core.engine.snapshot import whole_snapshot
from hand_eye_calib.core.pairing.motion_pairs import motion_pairs
from hand_eye_calib.core.solvers.all_pairs import pair_costs
from hand_eye_calib.core.solvers.registry import Method
from hand_eye_calib.offline.calibrate import prior_fields

# Keywords of calibrate that are no options of the engine.
OWN_KEYWORDS = (
    "parent_topic",
    "child_topic",
    "start",
    "end",
    "prior",
    "ground",
    "progress",
    "checks",
)
PRIOR_FIELDS = {f"prior_{axis}" for axis in AXIS_UNITS}


def streams(n_poses=40):
    poses = motions.wandering_poses(n_poses)
    return motions.as_trajectory(poses), motions.as_trajectory(
        motions.child_of(poses)
    )


class TestOptionsOfCalibrate:
    def keywords(self):
        parameters = inspect.signature(hec.calibrate).parameters.values()
        return {p.name: p for p in parameters if p.kind is p.KEYWORD_ONLY}

    def test_they_are_those_of_the_config(self):
        fields = {
            field.name: field for field in dataclasses.fields(CalibratorConfig)
        }
        assert set(fields) >= PRIOR_FIELDS
        keywords = self.keywords()
        assert set(keywords) == set(fields) - PRIOR_FIELDS | {*OWN_KEYWORDS}
        assert {keyword.default for keyword in keywords.values()} == {None}
        for name in fields.keys() - PRIOR_FIELDS:
            meta = fields[name].metadata
            annotation = keywords[name].annotation
            words = meta["choices"] or meta["words"]
            expected = Literal[words] if words else fields[name].type
            expected = float | expected if meta["words"] else expected
            assert annotation == expected | None, name

    def test_each_has_the_effect_of_its_option(self, monkeypatch):
        """Every keyword reaches the configuration that is solved with."""
        seen = []
        monkeypatch.setattr(
            "hand_eye_calib.offline.calibrate.whole_snapshot",
            lambda *streams: seen.append(whole_snapshot(*streams).config),
        )
        solved = SimpleNamespace(
            calibration=result_making.calibration(), snapshot=None
        )
        monkeypatch.setattr(
            "hand_eye_calib.offline.calibrate.run", lambda *_, **__: solved
        )
        numbers = [
            "threshold",
            "min_inlier_fraction",
            "max_gap",
            "scale",
            "parent_scale",
        ]
        numbers += [
            f"keyframe_min_{quantity}"
            for quantity in ("translation", "rotation", "interval")
        ]
        numbers += ["target_translation"]
        numbers_given = {name: 0.0625 * k for k, name in enumerate(numbers, 1)}
        numbers_given |= dict(
            method="dnl",
            reference="C7",
            backend="ipopt",
            min_pairs=4,
            max_pairs=77,
            target_rotation=0.1,
        )
        numbers_given |= dict(time_offset="estimate", target_axes="z=0.1")
        numbers_given |= dict(
            parent_invert="poses", child_invert="orientations"
        )
        numbers_given |= dict(
            parent_measures="rates", child_measures="rotations"
        )
        numbers_given |= dict(parent_frame="lidar", child_frame="camera")
        numbers_given |= dict(nominal_radius=0.1, nominal_separation=0.5)
        for stream in ("parent", "child"):
            numbers_given |= {
                f"{stream}_quaternion": "wxyz",
                f"{stream}_kind": "exact",
            }
        assert set(numbers_given) | {*OWN_KEYWORDS} == set(self.keywords())
        hec.calibrate(*streams(), **numbers_given, prior={"z": (1.85, 0.02)})
        (config,) = seen
        assert {
            name: getattr(config, name) for name in numbers_given
        } == numbers_given
        assert config.prior() == {"z": (1.85, 0.02)}
        default = CalibratorConfig()
        assert all(
            getattr(default, name) != value
            for name, value in numbers_given.items()
        )

    def test_all_poses_are_used_unless_limited(self):
        parent, child = streams(60)
        result = hec.calibrate(parent, child, reference="B1", max_pairs=20)
        assert result.n_poses <= 20
        assert whole_snapshot(parent, child, {}).config.max_pairs == 60
        # Of two files of a million poses one in ten is used.
        poses = np.broadcast_to(np.eye(4), (1_000_000, 4, 4))
        long = hec.Trajectory(np.arange(1_000_000), poses)
        snapshot = whole_snapshot(long, long, {})
        assert snapshot.config.max_pairs == 100_000
        warnings = " ".join(snapshot.warnings)
        assert "100,000 pose pairs are used at most" in warnings
        assert (
            whole_snapshot(
                long, long, {"max_pairs": 2_000_000}
            ).config.max_pairs
            == 2_000_000
        )

    def test_progress_is_told_and_changes_nothing(self):
        parent, child = streams()
        reports = []
        tell = lambda share, step: reports.append((share, step))  # noqa: E731
        result = hec.calibrate(parent, child, reference="B1", progress=tell)
        steps = ["solving", "checking the streams", "done"]
        assert [step for _, step in reports] == steps
        assert sorted(reports) == reports
        assert (reports[0][0], reports[-1][0]) == (0.0, 1.0)
        again = hec.calibrate(parent, child, reference="B1")
        assert_array_equal(result.T_parent_child, again.T_parent_child)


class TestPrior:
    def test_values_come_through_to_the_last_bit(self):
        priors = {"x": (np.float64(1 / 3), 1e-7), "yaw": (-2.0e-12, np.pi / 7)}
        assert CalibratorConfig(**prior_fields(priors)).prior() == priors

    @pytest.mark.parametrize(
        ("prior", "message"),
        [
            (
                {"height": (1.85, 0.02)},
                "prior takes x, y, z, roll, pitch, yaw; got",
            ),
            (
                {"z": 1.85},
                r"prior z must be \(value, standard deviation\) or a text such as .*; got 1.85",
            ),
            (
                {"z": (1.85, 0.02, 3)},
                r"prior z must be \(value, standard deviation\)",
            ),
            ({"z": (1.85, float("nan"))}, "prior.z must be numbers in m"),
        ],
    )
    def test_what_says_too_little_is_refused(self, prior, message):
        with pytest.raises(ConfigError, match=message):
            hec.calibrate(*streams(), prior=prior)


class TestMethods:
    def test_every_record_has_its_solver(self):
        with_reference = {
            name for name, record in METHODS.items() if record.uses_reference
        }
        assert {Method(name).name for name in with_reference} == with_reference
        for name in set(METHODS) - with_reference:
            with pytest.raises(
                ConfigError, match=f"method '{name}' is unknown"
            ):
                Method(name)

    @pytest.mark.parametrize("name", METHODS)
    def test_backends_are_those_of_the_record(self, name):
        parent, child = streams(30)
        for backend in BACKENDS:
            if backend in METHODS[name].backends:
                options = dict(method=name, reference="B1", backend=backend)
                hec.calibrate(parent, child, checks=False, **options)
            else:
                with pytest.raises(
                    ConfigError, match=f"method {name} has no backend {backend}"
                ):
                    hec.calibrate(
                        parent,
                        child,
                        method=name,
                        reference="B1",
                        backend=backend,
                    )


class TestResiduals:
    @pytest.mark.parametrize("name", METHODS)
    def test_they_belong_to_the_pairs_of_the_result(self, name):
        parent, child = streams(80)
        poses = child.poses.copy()
        poses[40:, :3, 3] += [1.0, -0.7, 0.4]
        jumped = hec.Trajectory(child.stamps_ns, poses)
        result = hec.calibrate(
            parent, jumped, method=name, reference="B2", checks=False
        )
        residuals = result.residuals()
        assert len(residuals) == result.n_pairs
        assert residuals == residuals[:] != residuals[1:]
        assert residuals.is_inlier.sum() == result.n_inliers
        step_ns = 100_000_000 * (
            2 if METHODS[result.method].uses_reference else 1
        )
        assert set(residuals.end_ns - residuals.start_ns) == {step_ns}
        crosses = residuals.start_ns < parent.stamps_ns[40]
        crosses &= residuals.end_ns >= parent.stamps_ns[40]
        error_m = np.linalg.norm(
            (result.T_parent_child - motions.T_PARENT_CHILD)[:3, 3]
        )
        assert METHODS[name].rejects_outliers == (error_m < 1e-4)
        assert METHODS[name].rejects_outliers == (
            result.n_inliers < result.n_pairs
        )
        if METHODS[name].rejects_outliers:
            assert_array_equal(residuals.is_inlier, ~crosses)
            assert residuals.translation_m[~crosses].max() < 1e-6
            assert residuals.rotation_rad.max() < 1e-6
        assert residuals.translation_m[crosses].min() > 0.3
        assert (
            residuals.translation.shape
            == residuals.rotation.shape
            == (result.n_pairs, 3)
        )

    def test_those_of_the_adaptive_estimator_have_its_scale_and_time_offset(
        self,
    ):
        times_s = np.arange(400) / 20
        parent = motions.as_trajectory(
            motions.disturbed(motions.smooth_poses(times_s), 1, 1e-4, 1e-4),
            20.0,
        )
        late = motions.child_of(motions.smooth_poses(times_s + 0.05))
        child = motions.as_trajectory(
            motions.disturbed(late, 2, 1e-4, 1e-4), 20.0
        ).scaled(0.95)
        exact = hec.calibrate(
            parent, child, method="adaptive", time_offset=0.05, scale=1 / 0.95
        )
        result = hec.calibrate(parent, child, method="adaptive", checks=False)
        assert result.time_offset_s == pytest.approx(0.05, abs=1e-3)
        rms = [
            np.sqrt((r.residuals().translation ** 2).mean())
            for r in (exact, result)
        ]
        # Without the time offset it would be fifteen times as much.
        assert rms[1] == pytest.approx(rms[0], rel=0.2)

    def test_files_do_not_have_them(self):
        result = hec.calibrate(*streams(), reference="B1", checks=False)
        loaded = hec.Calibration.from_dict(result.to_dict())
        with pytest.raises(
            InputError, match="read from a file has no residuals"
        ):
            loaded.residuals()


class TestAnswerOfTheMethod:
    def test_it_has_the_objective_and_the_result_is_the_settled_one(self):
        """Flat ground does not reveal z: the method's answer has one, the result has about 0."""
        poses = motions.planar_poses(300)
        parent, child = motions.noisy_pair(poses, 1, 2e-3, 1e-3)
        result = hec.calibrate(
            parent, child, method="dnl", reference="B10", checks=False
        )
        assert result.unobservable() == ["z"]
        pairs = motion_pairs(parent.poses, child.poses, "B10")
        own = pair_costs(pairs, result.T_method).sum()
        assert own == pytest.approx(result.objective, rel=1e-9)
        assert pair_costs(pairs, result.T_parent_child).sum() > result.objective
        assert abs(result.T_method[2, 3] - result.T_parent_child[2, 3]) > 1e-3

    def test_it_comes_back_from_files_that_have_it(self):
        result = hec.calibrate(*streams(100), reference="B5")
        assert_allclose(result.T_method, result.T_parent_child, atol=1e-12)
        document = result.to_dict()
        loaded = hec.Calibration.from_dict(document)
        assert_array_equal(loaded.T_method, result.T_method)
        del document["T_method"]
        assert hec.Calibration.from_dict(document).T_method is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("threshold", np.float32(0.5)),
        ("threshold", np.float64(0.02)),
        ("threshold", np.array(0.02)),
        ("max_pairs", np.int64(40)),
        ("min_pairs", np.uint8(3)),
        ("time_offset", np.float64(0.0)),
        ("method", np.str_("park")),
    ],
)
def test_scalars_of_numpy_are_options_like_those_of_python(name, value):
    config = CalibratorConfig(**{name: value})
    assert getattr(config, name) == value.item()
    assert type(getattr(config, name)).__module__ == "builtins"


@pytest.mark.parametrize(
    "value",
    [10**5000, -(10**400), 1 << 64, np.array([1.0, 2.0]), 1j],
    ids=["huge", "negative", "65 bits", "array", "complex"],
)
@pytest.mark.parametrize(
    "name", ["max_pairs", "threshold", "time_offset", "method"]
)
def test_numbers_that_no_option_can_have_are_refused_in_one_line(name, value):
    with pytest.raises(ConfigError, match=name) as caught:
        CalibratorConfig(**{name: value})
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    "prior", [float("nan"), 3, "z=1", [("z", 1)], {"z": 5}, {"z": (1, 2, 3)}]
)
def test_a_prior_of_another_form_is_refused_with_an_example(prior):
    with pytest.raises(ConfigError, match="prior"):
        hec.calibrate(*streams(), prior=prior)


# ---- wrong arguments, each answered in one line

PARENT = hec.read_trajectory("sample:lidar.tum")
CHILD = hec.read_trajectory("sample:camera.tum")


@pytest.fixture(scope="module")
def solved():
    return hec.calibrate(PARENT, CHILD, method="dnlo", checks=False)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda _: hec.calibrate(3, CHILD), "expected a path, an array"),
        (
            lambda _: hec.calibrate(PARENT),
            "a child is missing: pass two trajectories",
        ),
        (lambda _: hec.calibrate("absent"), "no bag at absent"),
        (
            lambda _: hec.calibrate(PARENT, "absent.tum"),
            "cannot read absent.tum",
        ),
        (
            lambda _: hec.calibrate(PARENT, CHILD, parent_topic="/a"),
            "pass only the bag",
        ),
        (
            lambda _: hec.calibrate("sample:drive.mcap", parent_topic=3),
            "must be of type str; got int",
        ),
        (
            lambda _: hec.calibrate("sample:drive.mcap", parent_topic="/x"),
            "no topic /x in ",
        ),
        (
            lambda _: hec.calibrate(PARENT, CHILD, progress=3),
            "progress must be a function; got int",
        ),
        (
            lambda _: hec.calibrate(PARENT, CHILD, checks="no"),
            "checks must be of type bool; got str",
        ),
        (
            lambda _: hec.calibrate(PARENT, CHILD, max_gap=[1]),
            "max_gap must be a number in s; got [1]",
        ),
        (
            lambda _: hec.save(3, "out"),
            "the result must be of type Calibration; got int",
        ),
        (
            lambda result: hec.save(result, 3),
            "directory must be of type str or PathLike; got int",
        ),
        (
            lambda _: hec.load(None),
            "path must be of type str or PathLike; got NoneType",
        ),
        (
            lambda _: hec.plot(3),
            "the result must be of type Calibration; got int",
        ),
        (
            lambda result: hec.plot(result, 3),
            "ax must be three axes of Matplotlib; got int",
        ),
        (
            lambda result: result.report(3),
            "path must be of type str or PathLike; got int",
        ),
        (
            lambda _: hec.compare(3, 4),
            "results must be of type Sequence; got int",
        ),
        (
            lambda _: hec.compare([3]),
            "each result must be of type Calibration; got int",
        ),
        (
            lambda result: hec.compare([result], "robot.urdf"),
            "installed must be an earlier result",
        ),
        (
            lambda result: hec.cross_check(result, 3, CHILD),
            "parent must be of type Trajectory; got",
        ),
        (
            lambda _: hec.calibrate_many(3),
            "recordings must be of type Iterable; got int",
        ),
        (
            lambda _: hec.calibrate_together(3),
            "recordings must be of type Iterable; got int",
        ),
        (
            lambda _: hec.calibrate_rig(3),
            "trajectories must be of type Mapping; got int",
        ),
        (
            lambda _: hec.calibrate_rig({"a": 1}),
            "each trajectory must be of type Trajectory; got int",
        ),
        (
            lambda _: hec.calibrate_stops(3, 4),
            "parent: expected poses as (N, 4, 4)",
        ),
        (
            lambda _: hec.read_arm_samples(3),
            "path must be of type str or PathLike; got int",
        ),
        (
            lambda _: hec.robot_poses(np.zeros((3, 6)), 3),
            "the robot must be one of abb, fanuc",
        ),
        (lambda _: hec.simulate("x"), "seed must be of type Integral; got str"),
        (
            lambda _: hec.Trajectory([1, 2], "x"),
            "poses must be numbers; got str",
        ),
        (
            lambda _: hec.Trajectory([0.5], np.eye(4)[None]),
            "stamps_ns must be one-dimensional integ",
        ),
        (
            lambda _: hec.Trajectory.from_positions([1], 4),
            "positions must be numbers of shape (N, 3)",
        ),
        (
            lambda _: hec.Trajectory.from_rates([1], 4),
            "rates must be numbers of shape (N, 3)",
        ),
        (
            lambda _: PARENT.shifted("x"),
            "offset_s must be of type Real; got str",
        ),
        (
            lambda _: PARENT.scaled(None),
            "scale must be of type Real; got NoneType",
        ),
        (
            lambda _: hec.write_trajectory(PARENT, "x.tum"),
            "path must be of type str or PathLike",
        ),
        (
            lambda _: hec.write_trajectory("x.tum", 3),
            "trajectory must be of type Trajectory; got int",
        ),
        (lambda _: hec.read_trajectory(3), "expected a path, an array"),
        (
            lambda _: hec.Calibration.from_dict(3),
            "expected format hand_eye_calib/extrinsic",
        ),
        (
            lambda result: result.export("kalbr"),
            "unknown format 'kalbr'; known are",
        ),
    ],
)
def test_a_wrong_argument_is_answered_in_one_line(solved, call, message):
    with pytest.raises(hec.HandEyeCalibError) as caught:
        call(solved)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_bag_is_calibrated_by_its_topics():
    topics = {
        "parent_topic": "/lidar/odometry",
        "child_topic": "/camera/odometry",
    }
    named = hec.calibrate("sample:drive.mcap", checks=False, **topics)
    with pytest.warns(
        UserWarning,
        match="parent is /lidar/odometry, child is /camera/odometry",
    ):
        chosen = hec.calibrate("sample:drive.mcap", checks=False)
    assert named == chosen
    assert (named.parent_frame, named.child_frame) == ("lidar", "camera")


def test_a_notebook_gets_six_numbers_in_degrees_and_three_views(solved):
    html = solved._repr_html_()
    x, y, z = solved.translation
    roll, *_ = solved.rotation.as_euler("xyz", degrees=True)
    for number in (
        f"{x:.4f} ± ",
        f"{y:.4f} ± ",
        f"{z:.4f} ± ",
        f"{roll:.2f} ± ",
    ):
        assert number in html
    assert solved.headline in html
    assert html.count("<svg") == 1
    for view in ("along z", "along y", "along x"):
        assert view in html
    assert "measured, " in html


def test_a_printed_result_has_one_sigma(solved):
    number = with_sigma(solved.translation[0], solved.sigmas[0], 3)
    assert f"x {number} m, " in repr(solved)
