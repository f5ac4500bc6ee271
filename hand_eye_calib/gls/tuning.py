"""Every number that decides something in the search, with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tuning:
    """Numbers of the search. ``python -m reproduction.ablation`` shows what each stage gains."""

    # Robust start: DNLO over this reference sees through jumps, and needs no noise levels.
    start_reference: str = "B3"
    # Rotation noise turns about the origin of a world if residuals seen from there are so much
    # smaller than at the sensors.
    decisive_centre: float = 0.7
    # No lever arm is that long (m).
    longest_step_m: float = 1000.0
    # Noise levels need no more poses than this, in bursts that are spread evenly: bursts show the
    # fast errors, the time between them the slow ones. Slow errors take more time and need fewer.
    most_poses: int = 300
    most_poses_lasting: int = 200
    burst: tuple[int, ...] = (0, 1, 2, 3, 5, 8, 13, 21, 34, 55)
    # Rounds of looking for jumps; of weighing heavy tails.
    outlier_rounds: int = 4
    tail_rounds: int = 3
    # No more than this share of the poses are wrong by themselves.
    most_spikes: float = 0.2
    # The noise levels are fitted again only if more than this share of poses changed status.
    negligible: float = 0.005
    # Rotation noise this large beside the rotation between poses is not small.
    noisy: float = 0.2
    # Every so many poses where a target's camera is noisy, if so many of them remain: without,
    # primesense is 20 mm off at a stated 2 mm.
    strides: tuple[int, ...] = (3, 10, 30)
    fewest_strides: int = 50
    # Errors that last are part of the model if that lowers the loss by so much: two levels each, by
    # Akaike and more.
    least_gain: float = 4.0
    # Errors that are fixed to the body last on all scales (flicker). A recording hardly shows those
    # about as long as itself, and X takes their mean: this share of the variance of those found.
    unseen_share: float = 0.05
    # X is followed until it moves by less than this share of its sigma, or by so little (m, rad).
    max_rounds: int = 6
    settled_sigmas: float = 0.1
    settled_step: float = 1e-9
    # A translation that is not known to this (m) need not settle: noise moves it on and on.
    unknown_m: float = 0.2
    # Standard deviations of systematic errors beforehand: of a scale, of a bias along each axis
    # (m/m), of a time offset (s), of a bias of rates (rad/s), if they are there, at these odds;
    # and the one that stands for none. A time offset that is not known beforehand is all but
    # certain (log odds).
    sizes: tuple[float, ...] = (0.03, 0.03, 0.03, 0.03, 0.1, 1.0, 1.0, 1.0)
    odds: float = 0.03
    none: float = 1e-6
    certain: float = 50.0
    # A bias of the path that gains hardly more than a scale is one along the direction of travel.
    like_scale: float = 0.95
    # None is assumed that can hardly be told from X, whose standard deviations would grow by this
    # factor: on a road a child that slips sideways looks like one that is mounted askew.
    # There such biases grow them by 4 or more, biases of the published simulations by 2 or less.
    most_growth: float = 3.0


TUNING = Tuning()
