"""Constants that decide the result of the adaptive estimator."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """Constants of the search, with defaults.

    ``solve(tuning=...)`` of poses and of positions takes all of them from its argument.
    ``python -m reproduction.ablation`` measures the gain of each stage.
    ``benchmarks/constants.csv`` contains the change of errors if a constant is halved or doubled.
    Limits of rounding and of numerical steps are constants of the modules that use them.
    """

    # -- The start --
    # Reference (distance between poses) of DNLO for the first estimate of X. DNLO is robust to
    # jumps and needs no noise levels.
    start_reference: str = "B3"

    # -- Noise levels, which are logarithms of variances --
    # Largest number of poses that noise levels are fitted to.
    most_poses: int = 300
    # Indices of the poses of one burst, relative to its first pose. Bursts are spread evenly. An
    # increment over more poses than the longest index is not used: over such a gap, a walk of the
    # rotation shifts positions, which the model of one increment does not contain. In recordings of
    # thousands of poses, the fitted walk was a tenth of the true one. So slow errors are visible
    # within a burst only, except in recordings below about 3,200 poses, whose bursts are connected.
    burst: tuple[int, ...] = (0, 1, 2, 3, 5, 8, 13, 21, 34, 55)
    # Prior mean of the log variance of the jitter of stamps (s^2): the variance of 1 ms.
    jitter: float = -14.0
    # Prior precision of log time constants: their prior standard deviation is 1.8, a factor of 6.
    tau_precision: float = 0.3
    # Differences between a step of the child and its neighbours are smoothed out as noise if their
    # variance is below this multiple of the noise variance.
    caution: float = 10.0
    # The search for noise levels ends if a Newton step is predicted to lower the loss by less than
    # this: a few per cent of a variance do not change X. The search for time-correlated errors ends
    # at this value for each level.
    settled_loss: float = 0.05

    # -- Outliers and heavy tails --
    # Expected number of false alarms among all poses of a recording, and among all increments.
    false_alarms: float = 0.01
    # If the walk has heavy tails, a step is a jump only if its chi-square exceeds the threshold of
    # false alarms by this factor.
    heavy_jump_factor: float = 2.5
    # White errors have heavy tails if the mean square of their chi-squares exceeds the squared mean
    # by this factor. The factor is 4/3 for normal errors.
    heavy_kurtosis: float = 1.7
    # The walk has heavy tails if, of its chi-squares below the threshold of false alarms, the mean
    # square exceeds the squared mean by this factor. With 1.7 as for white errors, errors on KITTI
    # would be 9 % larger.
    walk_kurtosis: float = 1.5
    # Before noise levels are known, an increment is a jump beyond this number of robust standard
    # deviations. The limit is wide because the residuals contain all errors.
    first_jump_sigmas: float = 5.0
    # Largest share of poses that may be outliers. If more are, no pose is an outlier, and all poses
    # get Student weights in the stage `tails`. At the first detection, before noise levels are
    # known, all large residuals are jumps then.
    max_outlier_share: float = 0.2
    # The noise levels are fitted again if more than this share of poses and increments became
    # outliers or jumps, or ceased to be.
    negligible_share: float = 0.005

    # -- Rotation noise that is large relative to the rotation between poses --
    # Poses are noisy if rotation noise exceeds this share of the rotation between poses.
    noisy_share: float = 0.2
    # Strides (numbers of poses) that are tried if poses of a camera that observes a target are
    # noisy. Without them, the recording primesense is 20 mm off at a sigma of 2 mm.
    strides: tuple[int, ...] = (3, 10, 30)

    # -- Time-correlated errors --
    # Time-correlated errors are added if all of them together, with white noise and walk fitted
    # again, lower the loss by at least this. Akaike's criterion for two levels would be 2. A
    # systematic error is added if it lowers the loss by this: its prior odds are exp(-4).
    least_gain: float = 4.0
    # A process is dropped if the data have less information than this on its log variance, unless
    # the first steps of the search have increased its variance.
    min_information: float = 0.3
    # At the start of the search, the variance of each process is this share of the variance of an
    # increment; white noise and walk have at least this share. Errors of the path (scale,
    # direction) start at 0.03 squared.
    start_share: float = 0.1
    # At the start, a time constant is the geometric mean of this number of intervals ...
    start_tau_intervals: float = 10.0
    # ... and of this share of the recording. A start at the mean of the bounds misses errors fixed
    # to the world in two of eight simulated drives.
    start_tau_share: float = 0.06
    # Variance of undetected errors fixed to the body, as a share of the variance of detected ones.
    # Such errors have all time scales (flicker). Those that are constant for about as long as the
    # recording are not detected, and X contains their mean.
    undetected_share: float = 0.05

    # -- Systematic errors --
    # Prior standard deviations of errors that are present: of a scale, of a bias along each axis
    # (m/m), of a time offset (s), of a bias of rates along each axis (rad/s).
    sizes: tuple[float, ...] = (0.03, 0.03, 0.03, 0.03, 0.1, 1.0, 1.0, 1.0)
    # Prior standard deviations before errors are selected. Biases are usually small.
    first_sizes: tuple[float, ...] = (
        0.03,
        0.0026,
        0.0026,
        0.0026,
        0.1,
        1.0,
        1.0,
        1.0,
    )
    # Prior standard deviation of an error that is absent: in effect, the error is zero.
    absent_sigma: float = 1e-6
    # The gain of a bias is multiplied by this factor when it is compared with that of a scale. A
    # scale and a bias along the direction of travel have almost the same effect.
    bias_gain_share: float = 0.75
    # A systematic error is rejected if it multiplies the standard deviation of X along any
    # direction by this factor or more: the error and X are hardly separable then. The factor is 4
    # or more for a child that slips sideways on a road, and at most 2 in simulations.
    max_sigma_growth: float = 3.0

    # -- The end --
    # Largest number of rounds in which outliers are detected. Also the largest number of steps of
    # X and all parameters at the end, the step that computes the solution included.
    max_rounds: int = 6
    # X is settled if its next step is shorter than this share of its standard deviation.
    settled_sigmas: float = 0.1
    # A direction of the translation with a standard deviation above this (m) need not settle: the
    # motion does not excite it, and noise moves it at each step.
    unknown_m: float = 0.2

    # -- Positions (LeverArmSolution) --
    # Largest number of rounds. Each round estimates the lever arm and updates the orientations.
    rounds: int = 10
    # Numbers of the rounds before which noise levels are fitted.
    fits: tuple[int, ...] = (1, 3, 5)
    # Log variance (rad^2) of the walk of the orientations: lower bound, start and upper bound.
    rotation_walk: tuple[float, float, float] = (
        math.log(1e-12),
        math.log(1e-6),
        math.log(0.1),
    )
    # Prior standard deviations: of the lever arm (m), of the scale of the odometry, of its
    # direction (rad: 0.15 deg), of the time offset (s), of the response of positions to
    # acceleration (s^2).
    of_positions: tuple[float, ...] = (
        *[10.0] * 3,
        0.01,
        *[math.radians(0.15)] * 3,
        1.0,
        0.002,
    )
    # Time (s) between the two positions of a velocity; an acceleration is the difference of two
    # velocities.
    accelerating_s: float = 0.2
    # An acceleration is not used if gaps between poses make its time span longer than the usual
    # span by this factor.
    longest_span_factor: float = 2.5
    # At a jump, the variance of the walk is this multiple of the variance that explains the step.
    jump_factor: float = 10.0
    # Number of neighbouring positions over which the quality of a position is measured.
    neighbours: int = 11
    # Positions are not used if their squared errors exceed those of the best quarter of the
    # recording by this factor: their weight would be small, and their errors are time-correlated.
    worst_error_factor: float = 16.0
    # Number of poses in a window. For the starting values, each window is aligned on its own.
    window: int = 200


TUNING = Tuning()
