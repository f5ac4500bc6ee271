"""Constants that decide the result of the adaptive estimator."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """Constants of the search, with defaults.

    ``solve(tuning=...)`` obeys all of them. ``python -m reproduction.ablation`` measures the gain
    of each stage. ``benchmarks/constants.csv`` contains the change of errors if a constant is
    halved or doubled. Limits of rounding and of numerical steps are constants of the modules that
    use them.
    """

    # -- The start --
    # Reference (distance between poses) with which DNLO makes the first estimate of X. DNLO is
    # robust to jumps and needs no noise levels.
    start_reference: str = "B3"

    # -- Noise levels (log variances) --
    # Largest number of poses to which noise levels are fitted.
    most_poses: int = 300
    # Indices of the poses in a burst, relative to its first pose. Bursts are spread evenly over the
    # recording. A gap longer than the last index is not used as an increment: over such a gap, the
    # walk of the rotation shifts positions, which the model of one increment does not contain. With
    # such increments, the fitted walk was a tenth of the true walk in recordings of thousands of
    # poses. As a consequence, slow errors are visible only within a burst. Bursts are connected in
    # recordings below about 3,200 poses.
    burst: tuple[int, ...] = (0, 1, 2, 3, 5, 8, 13, 21, 34, 55)
    # Prior mean of the log variance of the jitter of stamps (s^2). It corresponds to 1 ms.
    jitter: float = -14.0
    # Prior precision of log time constants. It corresponds to a standard deviation of 1.8, a factor
    # of 6.
    tau_precision: float = 0.3
    # The difference between a step of the child and its neighbours is smoothed as noise if its
    # variance is below this multiple of the noise variance.
    caution: float = 10.0
    # The search for noise levels ends if a Newton step is predicted to lower the loss by less than
    # this: some per cent of a variance do not change X. In the search for time-correlated errors,
    # the limit applies to each level.
    settled_loss: float = 0.05

    # -- Outliers and heavy tails --
    # Expected number of false alarms in a recording: among all poses, and again among all
    # increments.
    false_alarms: float = 0.01
    # If the walk has heavy tails, a step is a jump only if its chi-square exceeds this multiple of
    # the threshold of false alarms.
    heavy_jump_factor: float = 2.5
    # White errors have heavy tails if the mean square of their chi-squares exceeds this multiple of
    # the squared mean. For normal errors the ratio is 4/3.
    heavy_kurtosis: float = 1.7
    # The same limit for the walk, whose chi-squares above the threshold of false alarms are left
    # out. With 1.7, as for white errors, errors on KITTI would be 9 % larger.
    walk_kurtosis: float = 1.5
    # Before noise levels are known, an increment is a jump if its residual exceeds this number of
    # robust standard deviations. The limit is high because the residuals contain all errors.
    first_jump_sigmas: float = 5.0
    # Largest share of poses that may be outliers. Above it, no pose is an outlier, and all poses
    # get Student weights in the stage `tails`. At the first detection, before noise levels are
    # known, all large residuals are then jumps.
    max_outlier_share: float = 0.2

    # -- Rotation noise that is large relative to the rotation between poses --
    # White rotation errors turn about the origin of a world if the median residual there is below
    # this share of that at the sensors. By chance, noise makes the share a little smaller than 1.
    # Without the limit, 3 of 27 simulated arms had 4 to 24 times the rotation error.
    centre_ratio: float = 0.7
    # Poses are noisy if their rotation noise exceeds this share of the rotation between poses.
    noisy_share: float = 0.2
    # Strides (numbers of poses) that are tried if the poses of a camera that observes a target are
    # noisy. Without strides, the recording primesense is 20 mm off with a sigma of 2 mm.
    strides: tuple[int, ...] = (3, 10, 30)

    # -- Time-correlated errors --
    # Smallest decrease of the loss for which time-correlated errors are added, all of them
    # together. The levels of white noise and walk are fitted again with them, so this decrease
    # counts, too. Akaike's criterion for two levels would be 2. The same limit applies to a
    # systematic error: its prior odds are exp(-4).
    least_gain: float = 4.0
    # A process is dropped if the information of the data on its log variance is below this limit,
    # unless the first steps of the search have increased its variance.
    min_information: float = 0.3
    # Starting variance of each process, as a share of the variance of an increment. White noise and
    # walk start with at least this share. Errors of the path (scale, direction) start at 0.03
    # squared.
    start_share: float = 0.1
    # The starting time constant is the geometric mean of this number of intervals between poses ...
    start_tau_intervals: float = 10.0
    # ... and of this share of the duration. A start at the mean of the bounds would miss errors
    # fixed to the world in two of eight simulated drives.
    start_tau_share: float = 0.06
    # Variance of undetected errors fixed to the body, as a share of the variance of detected
    # errors. Such errors have all time scales (flicker noise). Those that are constant for about as
    # long as the recording are not detected, and X contains their mean.
    undetected_share: float = 0.05

    # -- Systematic errors --
    # Prior standard deviations of errors that are present, in the order of PARAMETERS: scale, bias
    # along each axis (m/m), time offset (s), bias of angular rates along each axis (rad/s).
    sizes: tuple[float, ...] = (0.03, 0.03, 0.03, 0.03, 0.1, 1.0, 1.0, 1.0)
    # Prior standard deviations before errors are selected. Biases are usually
    # small.
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
    # Prior standard deviation of an absent error. It keeps the error at zero in effect.
    absent_sigma: float = 1e-6
    # Factor of the gain of a bias in the comparison with a scale. A scale and a bias along the
    # direction of travel have almost the same effect.
    bias_gain_share: float = 0.75
    # A systematic error is rejected if it multiplies the standard deviation of X in any direction
    # by this factor or more: the error and X are then hardly separable. The factor is at least 4
    # for a child that slips sideways on a road, and at most 2 in simulations.
    max_sigma_growth: float = 3.0

    # -- The end --
    # Largest number of rounds in which outliers are detected. Also the largest number of final
    # steps of X and all parameters, including the step that computes the solution.
    max_rounds: int = 6
    # X has settled if its next step is shorter than this share of its standard deviation.
    settled_sigmas: float = 0.1
    # A direction of the translation with a larger standard deviation (m) need not settle: the
    # motion does not excite it, and noise moves it at each step.
    unknown_m: float = 0.2


TUNING = Tuning()
