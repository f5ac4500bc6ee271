"""Numbers that decide the search of the adaptive estimator."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """Numbers of the search.

    ``solve(tuning=...)`` of poses and of positions reads every number from here and none from the
    default. ``python -m reproduction.ablation`` measures what each stage gains, and
    ``benchmarks/constants.csv`` what each number changes if it is halved or doubled. Bounds of
    rounding and steps of the numerical search are constants of the modules that need them.
    """

    # -- The start --
    # Reference of DNLO for the robust start. It is robust to jumps, and needs no noise levels.
    start_reference: str = "B3"
    # Rotation noise turns about the origin of a world if residuals at that origin are smaller
    # than this share of the residuals at the sensors.
    centre_ratio: float = 0.7

    # -- Noise levels, which are logarithms of variances --
    # Largest number of poses to fit noise levels with.
    most_poses: int = 300
    # Poses of one burst; the bursts are spread evenly. Bursts contain the fast errors, the time
    # between bursts the slow ones.
    burst: tuple[int, ...] = (0, 1, 2, 3, 5, 8, 13, 21, 34, 55)
    # Poses farther apart than this are no evidence of noise levels. Over such a gap a walk of the
    # rotation shifts positions in a way that the model of one increment does not follow. In
    # recordings of thousands of poses the walk fitted was a tenth of the true one.
    longest_gap: int = 60
    # Prior mean of the log variance of the jitter of stamps (s^2): the variance of 1 ms.
    jitter: float = -14.0
    # Prior precision of the levels of time constants.
    tau_precision: float = 0.3
    # Steps of the child count as noise until their squared differences from their neighbours
    # exceed the noise variance by this factor.
    caution: float = 10.0
    # Newton steps of the levels end if a step promises to lower the loss by less: noise levels need
    # a few per cent. The search for time-correlated errors ends by less per level.
    settled_loss: float = 0.05

    # -- Outliers and heavy tails --
    # False alarms expected in a whole recording.
    false_alarms: float = 0.01
    # A large step of a walk with heavy tails is a jump if its chi-square exceeds the threshold of
    # false alarms by this factor.
    heavy_jump_factor: float = 2.5
    # White errors have heavy tails if the mean square of their chi-squares exceeds the square of
    # the mean by this factor (4/3 for normal errors).
    heavy_kurtosis: float = 1.7
    # The same of the steps of the walk below the level of false alarms. One limit for both gives
    # errors that are 9 % larger on KITTI.
    walk_kurtosis: float = 1.5
    # First search for jumps: increments this many robust standard deviations out. The limit is wide
    # because the noise levels are not estimated yet.
    first_jump_sigmas: float = 5.0
    # Largest share of poses that are outliers.
    max_outlier_share: float = 0.2
    # The noise levels are fitted again if more than this share of poses changed status.
    negligible_share: float = 0.005

    # -- Rotation noise that is large beside the rotation --
    # Rotation noise is not small if it exceeds this share of the rotation between poses.
    noisy_share: float = 0.2
    # Strides tried if rotation noise exceeds the rotation between poses. Without them, the
    # recording primesense is 20 mm off at a sigma of 2 mm.
    strides: tuple[int, ...] = (3, 10, 30)

    # -- Time-correlated errors --
    # They are part of the model if they lower the loss by this: two levels each, by Akaike's
    # criterion and more.
    least_gain: float = 4.0
    # A process makes no difference if the data have less information than this on its level.
    min_information: float = 0.3
    # The search begins with processes of this share of the white and walking noise. White noise
    # and walk are at least as large then.
    start_share: float = 0.1
    # A time constant starts at the geometric mean of this many intervals ...
    start_tau_intervals: float = 10.0
    # ... and this share of the recording. A start at the mean of the bounds misses errors fixed to
    # the world in two of eight simulated drives.
    start_tau_share: float = 0.06
    # Variance of undetected body-fixed errors, as a share of the variance of detected errors. Such
    # errors have all time scales (flicker). Errors about as long as the recording are not detected;
    # X contains their mean.
    undetected_share: float = 0.05

    # -- Systematic errors --
    # Prior standard deviations if the error is present: of a scale, of a bias along each axis
    # (m/m), of a time offset (s), of a bias of rates (rad/s).
    sizes: tuple[float, ...] = (0.03, 0.03, 0.03, 0.03, 0.1, 1.0, 1.0, 1.0)
    # The same before errors are selected: biases are usually small.
    first_sizes: tuple[float, ...] = (0.03, 0.0026, 0.0026, 0.0026, 0.1, 1.0, 1.0, 1.0)
    # Prior odds that a systematic error is present.
    odds: float = 0.03
    # Prior standard deviation of an error that is absent.
    absent_sigma: float = 1e-6
    # A bias of the path counts with this share of its gain against a scale: a scale, or a bias
    # along the direction of travel, explains most of it.
    bias_gain_share: float = 0.75
    # A systematic error is not modelled if the standard deviations of X grow by this factor with
    # it: the error and X are hardly separable then. A child that slips sideways on a road has 4 or
    # more, simulations have 2 or less.
    max_sigma_growth: float = 3.0

    # -- The end --
    # Largest number of rounds of detecting outliers, and of steps of X at the end.
    max_rounds: int = 6
    # X is settled if it moves by less than this share of its standard deviation.
    settled_sigmas: float = 0.1
    # A translation with a larger standard deviation (m) need not settle: noise moves it on and on.
    unknown_m: float = 0.2

    # -- Positions (LeverArmSolution) --
    # Rounds of updating the orientations.
    rounds: int = 10
    # Rounds before which noise levels are fitted.
    fits: tuple[int, ...] = (1, 3, 5)
    # Lower bound, start and upper bound of the level (rad^2) of the walk of the orientations.
    rotation_walk: tuple[float, float, float] = (math.log(1e-12), math.log(1e-6), math.log(0.1))
    # Prior standard deviations: of the lever arm (m), of the scale of the odometry, of its
    # direction (rad: 0.15 deg), of the time offset (s), of the response of positions to
    # acceleration (s^2).
    of_positions: tuple[float, ...] = (*[10.0] * 3, 0.01, *[math.radians(0.15)] * 3, 1.0, 0.002)
    # Prior standard deviation of an unknown scale.
    any_scale: float = 1.0
    # Time (s) over which accelerations are taken.
    accelerating_s: float = 0.2
    # Accelerations across a gap, over more than this multiple of `accelerating_s`, are left out.
    near: float = 2.5
    # At a jump, the variance of the walk is this many times the variance that explains its step.
    jump_factor: float = 10.0
    # Number of neighbouring positions over which the quality of a position is measured.
    neighbours: int = 11
    # Positions whose squared errors exceed those of the best quarter of the recording by this
    # factor are left out: they would hardly count, and their errors last.
    worse: float = 16.0
    # Poses of a window. For the starting values, each window is aligned alone.
    window: int = 200


TUNING = Tuning()
