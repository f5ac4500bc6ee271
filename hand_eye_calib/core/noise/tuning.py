"""Every number that decides something in the search, with its unit and its reason."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """Numbers of the search. ``python -m reproduction.ablation`` shows what each stage gains."""

    # -- The start --
    # Robust start: DNLO over this reference sees through jumps, and needs no noise levels.
    start_reference: str = "B3"
    # Rotation noise turns about the origin of a world if residuals seen from there are so much
    # smaller than at the sensors.
    decisive_centre: float = 0.7
    # No lever arm is that long (m).
    longest_step_m: float = 1000.0

    # -- Noise levels, which are logarithms of variances --
    # They need no more poses than this, in bursts that are spread evenly: bursts show the fast
    # errors, the time between them the slow ones.
    most_poses: int = 300
    burst: tuple[int, ...] = (0, 1, 2, 3, 5, 8, 13, 21, 34, 55)
    # Poses farther apart than this say nothing of the noise levels: over such a gap a walk of the
    # rotation shifts positions in a way that the model of one increment does not follow. In
    # recordings of thousands of poses the walk fitted was a tenth of the true one.
    longest_gap: int = 60
    # Variances never fall below this (rad^2, m^2, s^2): rounding, not noise. White noise and walk
    # do not fall below these shares of the whole (logarithms), either; the precisions of both stand
    # in one matrix.
    lowest_variance: float = 1e-14
    least_white: float = -14.0
    least_walk: float = -12.0
    # No level is above this.
    highest_level: float = 14.0
    # Expected level of the jitter of stamps (s^2), 1 ms, and how well it is known; precision of the
    # level of time constants, too.
    jitter: float = -14.0
    jitter_precision: float = 0.05
    tau_precision: float = 0.3
    # A walk's variance over an increment, in units of a typical one: bounded, so that neither a gap
    # nor twin stamps dominate.
    relative: tuple[float, float] = (0.1, 100.0)
    # Bounds of white noise and walk at the start, as shares of the whole.
    first_white: tuple[float, float] = (0.05, 0.5)
    first_walk: float = 0.02
    # Steps of the child count as noise until they differ from their neighbours by so many times its
    # variance.
    caution: float = 10.0

    # -- Newton steps of the levels --
    # They end if a step promises to lower the loss by less (noise levels need no more than a few
    # per cent; the search of errors that last: by less per level), or is so short; after so many
    # steps at the latest.
    settled_loss: float = 0.05
    settled_level: float = 1e-3
    max_steps: int = 20
    # Steps stay within a radius, which grows where a step keeps this share of what it promises,
    # and shrinks where it keeps less than that, or, to this share, where the loss rises.
    first_radius: float = 1.5
    largest_radius: float = 3.0
    good: float = 0.5
    poor: float = 0.2
    shrink: float = 0.3
    # Information that every level has beforehand: bounds the step along levels that do not matter.
    least_curvature: float = 0.05

    # -- Outliers and heavy tails --
    outlier_rounds: int = 4
    tail_rounds: int = 3
    # False alarms expected in a whole recording.
    false_alarms: float = 0.01
    # Large steps of a walk with heavy tails are no jumps: these exceed the level of false alarms
    # by this factor.
    decisive: float = 2.5
    # Tails are heavy if the fourth moment exceeds the square of the second by this factor (4/3 for
    # normal errors): of the steps of the walk that are below the level of false alarms, and of the
    # white errors.
    walk_kurtosis: float = 1.5
    heavy_kurtosis: float = 1.7
    # First look for jumps: increments this many robust sigmas out, at least so large (m, rad).
    # Wide, for the noise levels are not known yet.
    first_jump_sigmas: float = 5.0
    least_jump: float = 1e-6
    # At most this share of the poses are outliers.
    most_spikes: float = 0.2
    # The noise levels are fitted again only if more than this share of poses changed status.
    negligible: float = 0.005
    # Poses on either side that may share a level of the white errors; a level that changes is
    # believed if it lowers the loss per pose by so much.
    widths: tuple[int, ...] = (2, 5, 12, 30)
    least_gain_of_widths: float = 0.1

    # -- Rotation beside its noise --
    # Rotation noise this large beside the rotation between poses is not small.
    noisy: float = 0.2
    # Every so many poses where a target's camera is noisy, if so many of them remain: without,
    # primesense is 20 mm off at a stated 2 mm.
    strides: tuple[int, ...] = (3, 10, 30)
    fewest_strides: int = 50

    # -- Time-correlated errors --
    # They are part of the model if that lowers the loss by so much: two levels each, by Akaike and
    # more. One whose level the data say less about than this makes no difference.
    least_gain: float = 4.0
    least_information: float = 0.3
    # The search goes on without such a one once its level has fallen by so much.
    faded: float = 0.2
    # Time constants are between an interval and this share of the recording.
    longest_share: float = 0.25
    # The search begins at this share of the white and walking noise, below which no white noise is
    # then, nor a walk below this share of the whole; at this level of a scale and a direction of
    # travel that drift; at a time constant between so many intervals and this share of the time.
    audible: float = 0.1
    audible_walk: float = 1e-3
    first_of_path: float = -10.0
    first_tau: float = 10.0
    last_tau: float = 0.06
    # Those that are fixed to the body last on all scales (flicker). A recording hardly shows those
    # about as long as itself, and X takes their mean: this share of the variance of those found.
    unseen_share: float = 0.05

    # -- Systematic errors --
    # Standard deviations beforehand: of a scale, of a bias along each axis (m/m), of a time offset
    # (s), of a bias of rates (rad/s), if they are there, at these odds; and that for none.
    sizes: tuple[float, ...] = (0.03, 0.03, 0.03, 0.03, 0.1, 1.0, 1.0, 1.0)
    # As long as it is not decided which are there: biases are usually small.
    first_sizes: tuple[float, ...] = (0.03, 0.0026, 0.0026, 0.0026, 0.1, 1.0, 1.0, 1.0)
    odds: float = 0.03
    none: float = 1e-6
    # A bias of the path that does not gain a third more than a scale is a scale, or one along the
    # direction of travel.
    like_scale: float = 0.75
    # None is assumed that can hardly be told from X, whose standard deviations would grow by this
    # factor: by 4 or more where a child slips sideways on a road, by 2 or less in simulations.
    most_growth: float = 3.0

    # -- The end --
    # X is followed until it moves by less than this share of its sigma, or by so little (m, rad).
    max_rounds: int = 6
    settled_sigmas: float = 0.1
    settled_step: float = 1e-9
    # A translation that is not known to this (m) need not settle: noise moves it on and on.
    unknown_m: float = 0.2
    # What is beyond so many standard deviations is there.
    plain: float = 3.0
    # Stamps that jitter by less are not worth a sentence (ms).
    notable_jitter_ms: float = 0.1
    # Parts of a recording for the jackknife.
    n_parts: int = 20

    # -- Positions (LeverArmSolution) --
    # Rounds of updating the orientations, and those before which noise levels are fitted.
    rounds: int = 10
    fits: tuple[int, ...] = (1, 3, 5)
    # Level (rad^2) of orientations that may be anything; bounds and start of that of their walk.
    any_rotation: float = math.log(100.0)
    rotation_walk: tuple[float, float, float] = (math.log(1e-12), math.log(1e-6), math.log(0.1))
    # Standard deviations beforehand: of the lever arm (m), of the scale of the odometry, of its
    # direction (rad: 0.15 deg), of the time offset (s), and of what the positions answer to
    # acceleration (s^2); and of a scale that is not known.
    of_positions: tuple[float, ...] = (*[10.0] * 3, 0.01, *[math.radians(0.15)] * 3, 1.0, 0.002)
    any_scale: float = 1.0
    # Accelerations are those over this time (s), where no gap makes it longer by this factor.
    accelerating_s: float = 0.2
    near: float = 2.5
    # A jump is a step of the walk with this many times the variance that it needs.
    jump_factor: float = 10.0
    # The quality of a solution is that of so many positions around; those whose squared errors
    # exceed that of the best quarter of the recording by this factor are left out: they would
    # hardly count, and their errors last.
    neighbours: int = 11
    worse: float = 16.0
    # Poses of the windows that are aligned by themselves for the start, and its steps. The first
    # lever arm is drawn to zero by so much where the motion does not tell it.
    window: int = 200
    start_steps: int = 50
    drawn: float = 1e-6
    # Parts of a recording whose paths are compared by themselves.
    path_parts: int = 10

    # -- Rounding --
    # Information below this share of what a parameter's own diagonal promises.
    least_information_share: float = 1e-12
    # Diagonals of precisions are raised by this share, covariances by that, so that neither they
    # nor differences of them can be negative. Variances below the last (m^2, rad^2) are zero.
    raised: float = 1e-13
    raised_covariance: float = 1e-9
    least_variance: float = 1e-18
    # Precision (1/m^2, 1/rad^2) of poses that may be anywhere.
    free: float = 1.0

    # -- Speed --
    # The blocks that are left when they have so few rows together are one dense matrix; as many
    # triangular matrices are inverted row by row, all at once: half the time of LAPACK.
    few: int = 64


TUNING = Tuning()
