"""Stops: independent poses without an order, ``A_i X = Z B_i`` by robust maximum likelihood.

Where a robot stops, measures and moves on, the poses of neighbours tell no more than those of any
two stops. So each stop is measured against the pose Z of the child's world in the parent's world:
the base of a robot and a target, for instance (robot-world calibration; eye-to-hand if the arm
carries the target).
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.errors import NotEnoughDataError
from hand_eye_calib.core.base.stats import student_weights
from hand_eye_calib.core.geometry import se3

# A rotation about an axis needs two motions, that is three stops.
MIN_STOPS = 3

# Degrees of freedom of the errors' Student-t distribution. Between 4 and 30 the motions between
# stops that were left out close equally well, to 1 %, on two arms' recordings.
_TAILS = 12.0

# Outliers are left out: a stop this far off (squared distance of six values; 1 in 300,000 if errors
# are normal) under heavy tails of so many degrees of freedom, which few outliers do not widen.
_OUTLIER = 36.0
_OUTLIER_TAILS = 3.0

# Rounds of weights, levels and a Gauss-Newton step; steps below this many standard deviations end
# them.
_ROUNDS = 60
_SMALL_STEP = 1e-2

# Starts from so many stops each: two in three are clean with a tenth of outliers.
_STARTS = 12
_START_STOPS = 5

# Errors of copied poses are rounding (m^2, rad^2).
_SMALLEST_VARIANCE = 1e-24

# A direction is not determined unless the rotations between stops that show it are larger than this
# multiple of the squared error of a rotation, which looks like rotation itself.
_UNDETERMINED = 8.0

# Errors may last: over changes of the view (rad), beside a white share of their variance. The first
# row is of errors that do not last, the second of those that come back with their place, the others
# of those that last on the way from stop to stop. Within the smallest range stops that follow each
# other count as one where outliers are looked for, as an arm that rests gives many.
_LASTING = np.array([(0.03, 1.0), (0.05, 0.1), *((0.03 * 4.0**k, 0.1) for k in range(6))])

# Distances to a target are too long by this share: a usual one, of its size or the focal length.
STRETCH = 0.03

# So many stops at once are looked at.
_AT_ONCE = 300


@dataclass(frozen=True)
class Stops:
    """Poses of both sensors at N stops.

    Parameters
    ----------
    Ts_world_parent : (N, 4, 4) array
        A_i, in the parent's world, such as hand poses in the frame of a robot's base.
    Ts_world_child : (N, 4, 4) array
        B_i, in the child's world, such as poses of a camera in the frame of a target.
    child, world : (N,) int arrays
        Which child sensor (camera) and which world of it (target) it was; zeros if there is one.
    """

    Ts_world_parent: FloatArray
    Ts_world_child: FloatArray
    child: IntArray
    world: IntArray

    @classmethod
    def of_one(cls, Ts_world_parent: FloatArray, Ts_world_child: FloatArray) -> "Stops":
        """One child and one world of it."""
        zeros = np.zeros(len(Ts_world_parent), dtype=np.int64)
        return cls(Ts_world_parent, Ts_world_child, zeros, zeros)

    def __len__(self) -> int:
        return len(self.child)

    def __getitem__(self, which: IntArray | BoolArray) -> "Stops":
        A = self.Ts_world_parent[which]
        B = self.Ts_world_child[which]
        return Stops(A, B, self.child[which], self.world[which])


@dataclass(frozen=True)
class RobotWorld:
    """Solution of ``A_i X = Z B_i``.

    Attributes
    ----------
    Ts_parent_child : (C, 4, 4) array
        X of each child.
    Ts_world_world : (W, 4, 4) array
        Z: pose of each world of the children in the parent's world.
    covariance : (6 (C + W), 6 (C + W)) array
        Of the right perturbations (rho, phi) of all X, then all Z, in the frames of the children
        and of their worlds. Directions that the stops do not determine have large variances.
    information : (6 (C + W), 6 (C + W)) array
        Of the same, if the errors of each stop are independent and normal.
    weights : (N,) array
        Weight of each stop, 1 for the errors that the levels expect and less for larger ones.
    level_m, level_rad : float
        Standard deviations of the errors of a stop's position and rotation, per axis.
    objective : float
        Negative log likelihood.
    converged : bool
    scale_step, scale_sigma : float
        Share by which longer positions of the children would fit best, to first order, and its
        standard deviation; infinite if the stops do not determine it. Of several sensors or
        targets, those of the pair with most stops.
    """

    Ts_parent_child: FloatArray
    Ts_world_world: FloatArray
    covariance: FloatArray
    information: FloatArray
    weights: FloatArray
    level_m: float
    level_rad: float
    objective: float
    converged: bool
    scale_step: float = 0.0
    scale_sigma: float = float("inf")

    def undetermined(self, child: int = 0) -> FloatArray:
        """Directions (6, k) of X, as right perturbations, that the stops do not determine."""
        own = np.arange(len(self.information)) // 6 == child
        to_others = self.information[np.ix_(own, ~own)]
        others = np.linalg.pinv(self.information[np.ix_(~own, ~own)], hermitian=True)
        levels = np.repeat([self.level_m, self.level_rad], 3)
        # In units of the errors of a stop: the squared rotations between stops (rad^2).
        alone = self.information[np.ix_(own, own)] - to_others @ others @ to_others.T
        alone = alone * np.outer(levels, levels) / max(int(np.sum(self.weights > 0.0)), 1)
        powers, directions = np.linalg.eigh(alone)
        return directions[:, powers < _UNDETERMINED * self.level_rad**2]


def solve(stops: Stops, stretch: float = STRETCH) -> RobotWorld:
    """The most likely X and Z.

    Parameters
    ----------
    stops : Stops
        At least three.
    stretch : float
        Standard deviation, as a share, of the scale of the children's lengths before the solve;
        infinite if nothing is known of it. The covariance contains what it does.

    Raises
    ------
    NotEnoughDataError
        If there are fewer than three stops of a child or of one of its worlds.

    Notes
    -----
    Starts in closed form: rotations by M. Shah, *Solving the robot-world/hand-eye calibration
    problem using the Kronecker product*, Journal of Mechanisms and Robotics 5(3), 2013, eq. 18,
    then translations by linear least squares. Then the errors ``Log(B_i^-1 Z^-1 A_i X)``, moved
    into the frame in which they are likeliest, the child's or that of its world (a target whose
    pose a camera measured), follow a Student-t distribution with one level for positions and one
    for rotations.
    """
    n_children = 1 + int(stops.child.max(initial=0))
    n_worlds = 1 + int(stops.world.max(initial=0))
    counts = np.zeros((n_children, n_worlds), dtype=np.int64)
    np.add.at(counts, (stops.child, stops.world), 1)
    if counts.max() < MIN_STOPS or not counts.any(axis=1).all() or not counts.any(axis=0).all():
        raise NotEnoughDataError(
            f"{len(stops)} stops are too few: at least {MIN_STOPS} of each sensor, with rotations "
            "about two axes, are necessary; 15 or more are better"
        )
    starts = _starts(stops, counts)
    views = _views(stops)
    alone = _alone(views)
    fits = []
    # With heavier tails a few stops fit exactly, and all others are outliers.
    few = 8.0 * sum(counts.shape) / max(len(stops) - sum(counts.shape), 0.1)
    for in_world in (False, True):
        rough = _fit(stops, starts, in_world, max(few, _OUTLIER_TAILS), alone)
        kept = rough.weights > 0.0
        weights = np.zeros(len(stops))
        begin = rough.Ts_parent_child, rough.Ts_world_world
        fit = _fit(stops[kept], begin, in_world, max(few, _TAILS), alone[kept])
        weights[kept] = fit.weights
        # Each stop that is left out counts as an outlier at the limit.
        levels = 6.0 * (np.log(fit.level_m) + np.log(fit.level_rad))
        objective = fit.objective + 0.5 * float(np.sum(weights == 0.0)) * (levels + _OUTLIER)
        fits.append((replace(fit, weights=weights, objective=objective), in_world))
    best, in_world = min(fits, key=lambda each: each[0].objective)
    kept = best.weights > 0.0
    return _widened(stops[kept], best, in_world, alone[kept], views[kept], stretch)


def closest_rotations(
    R_a: FloatArray, R_b: FloatArray, weights: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Rotations X and Z (3, 3) that bring ``R_a X`` and ``Z R_b`` closest, in closed form.

    Parameters
    ----------
    R_a, R_b : (N, 3, 3) arrays
    weights : (N,) array, optional
        Weights of the stops.
    """
    weighted = R_a if weights is None else weights[:, None, None] * R_a
    # The sum of tr(X' R_a' Z R_b), as a bilinear form of X and Z.
    form = np.einsum("nji,nka->iajk", weighted, R_b).reshape(9, 9)
    left, _, right = np.linalg.svd(form)
    both = np.stack([left[:, 0].reshape(3, 3), right[0].reshape(3, 3)])
    sign = -1.0 if np.linalg.det(both[0]) < 0 else 1.0
    X, Z = se3.nearest_rotation(sign * both)
    return X, Z


def _closed_form(stops: Stops) -> tuple[FloatArray, FloatArray]:
    """X and Z (4, 4) of one child and one world."""
    A = stops.Ts_world_parent
    B = stops.Ts_world_child
    rotation_x, rotation_z = closest_rotations(A[:, :3, :3], B[:, :3, :3])
    columns = np.concatenate([A[:, :3, :3], -np.broadcast_to(np.eye(3), (len(A), 3, 3))], axis=2)
    values = B[:, :3, 3] @ rotation_z.T - A[:, :3, 3]
    translations = np.linalg.lstsq(columns.reshape(-1, 6), values.ravel(), rcond=1e-9)[0]
    return (
        se3.from_rotation_translation(rotation_x, translations[:3]),
        se3.from_rotation_translation(rotation_z, translations[3:]),
    )


def _robust_start(stops: Stops) -> tuple[FloatArray, FloatArray]:
    """The best of the closed forms of all stops and of a few, by the median error."""
    random = np.random.default_rng(0)
    choices = [np.arange(len(stops))]
    if len(stops) > 2 * _START_STOPS:
        choices += [random.choice(len(stops), _START_STOPS, replace=False) for _ in range(_STARTS)]
    candidates = [_closed_form(stops[choice]) for choice in choices]
    X, Z = (np.stack(each)[:, None] for each in zip(*candidates, strict=True))
    errors = se3.inverse(stops.Ts_world_child) @ se3.inverse(Z) @ stops.Ts_world_parent @ X
    return candidates[int(np.argmin(_logs_of_medians(errors)))]


def _starts(stops: Stops, counts: IntArray) -> tuple[FloatArray, FloatArray]:
    """X (C, 4, 4) of all children and Z (W, 4, 4) of all worlds, from the pair with most stops on.

    Raises
    ------
    NotEnoughDataError
        If some of them share no stops, directly or through others, with the rest.
    """
    Xs, Zs = (np.zeros((count, 4, 4)) for count in counts.shape)
    has_X, has_Z = (np.zeros(count, dtype=bool) for count in counts.shape)
    while not (has_X.all() and has_Z.all()):
        # Pairs of which one side is known; first, of all.
        near = np.where(has_X[:, None] ^ has_Z, counts, 0) if has_X.any() else counts
        if not near.any():
            raise NotEnoughDataError("the stops of some sensors or targets are tied to no others")
        child, world = (int(k) for k in np.unravel_index(np.argmax(near), near.shape))
        pair = stops[(stops.child == child) & (stops.world == world)]
        A = pair.Ts_world_parent
        B = pair.Ts_world_child
        if has_X[child]:
            Zs[world] = _most_central(A @ Xs[child] @ se3.inverse(B))
        elif has_Z[world]:
            Xs[child] = _most_central(se3.inverse(A) @ Zs[world] @ B)
        else:
            Xs[child], Zs[world] = _robust_start(pair)
        has_X[child] = has_Z[world] = True
    return Xs, Zs


def _most_central(Ts: FloatArray) -> FloatArray:
    """The transform (4, 4) of (N, 4, 4) with the smallest median distance to the others."""
    between = se3.inverse(Ts)[:, None] @ Ts
    return Ts[int(np.argmin(_logs_of_medians(between)))]


def _logs_of_medians(errors: FloatArray) -> FloatArray:
    """Logarithm (M,) of median distance times median angle of each row of errors (M, N, 4, 4)."""
    tiny = np.finfo(float).tiny
    distance_m = np.median(np.linalg.norm(errors[..., :3, 3], axis=-1), axis=1)
    angle_rad = np.median(se3.rotation_angle(errors[..., :3, :3]), axis=1)
    return np.asarray(np.log(distance_m + tiny) + np.log(angle_rad + tiny))


def _linearise(
    stops: Stops, Xs: FloatArray, Zs: FloatArray, in_world: bool
) -> tuple[FloatArray, FloatArray]:
    """Errors (N, 6), in the frames of the children or of their worlds, and their derivatives
    (N, 6, 12) by the X and the Z of each.
    """
    predicted = se3.inverse(Zs[stops.world]) @ stops.Ts_world_parent @ Xs[stops.child]
    back = se3.inverse(stops.Ts_world_child)
    errors = se3.log(predicted @ back if in_world else back @ predicted)
    frames = stops.Ts_world_child if in_world else np.broadcast_to(np.eye(4), predicted.shape)
    by_both = se3.adjoint(frames), -se3.adjoint(frames @ se3.inverse(predicted))
    return errors, np.concatenate(by_both, axis=2)


def _pairs(stops: Stops, n_children: int) -> list[tuple[IntArray, IntArray]]:
    """The stops of each sensor with each of its worlds, and the columns (12,) of that X and Z."""
    blocks = np.stack([stops.child, n_children + stops.world], axis=1)
    pairs, pair_of = np.unique(blocks, axis=0, return_inverse=True)
    columns = (6 * pairs[..., None] + np.arange(6)).reshape(-1, 12)
    return [(np.flatnonzero(pair_of.ravel() == k), each) for k, each in enumerate(columns)]


def _products(rows: FloatArray, pairs: list[tuple[IntArray, IntArray]], n: int) -> FloatArray:
    """Products (n + 1, n + 1) of columns: of rows (N, 6, 13) by X and Z of a stop, and one more."""
    whole = np.zeros((n + 1, n + 1))
    for own, columns in pairs:
        part = rows[own].reshape(-1, 13)
        at = np.append(columns, n)
        whole[at[:, None], at] += part.T @ part
    return whole


def _views(stops: Stops) -> FloatArray:
    """Views (N, 13) of the stops: change so far, rotations (rad), places over a usual distance."""
    A = stops.Ts_world_parent
    distances_m = np.linalg.norm(stops.Ts_world_child[:, :3, 3], axis=1)
    ways_m = np.linalg.norm(np.diff(A[:, :3, 3], axis=0), axis=1)
    usual_m = np.median(distances_m) + ways_m.sum() / len(A) + np.finfo(float).tiny
    turns = A[:, :3, :3].reshape(-1, 9) / np.sqrt(2.0)
    changes_rad = np.linalg.norm(np.diff(turns, axis=0), axis=1) + ways_m / usual_m
    return np.c_[np.cumsum(np.r_[0.0, changes_rad]), turns, A[:, :3, 3] / usual_m]


def _alone(views: FloatArray) -> FloatArray:
    """Weights (N,) of 1 on average: stops that follow each other at one place count as one."""
    path_rad = views[:, 0]
    first, end = (
        np.searchsorted(path_rad, path_rad + x) for x in (-_LASTING[0, 0], _LASTING[0, 0])
    )
    alone = 1.0 / np.maximum(end - first, 1)
    return np.asarray(alone / alone.mean())


def _kernels(views: FloatArray) -> FloatArray:
    """Correlations (K, N, N) of the errors of stops in their order, for each row of _LASTING."""
    ranges_rad, white = _LASTING.T[:, :, None, None]
    places = np.linalg.norm(views[:, None, 1:] - views[:, 1:], axis=2)
    way = np.abs(np.subtract.outer(views[:, 0], views[:, 0]))
    apart = np.stack([places, places, *[way] * (len(_LASTING) - 2)]) / ranges_rad
    return np.asarray(white * np.eye(len(views)) + (1.0 - white) * np.exp(-apart))


def _shares(kernels: FloatArray, rows: FloatArray) -> FloatArray:
    """Probability (K,) of each of the kernels times the variance that it finds, over that of none,
    from derivatives by all values and errors, the last of the columns of rows (N, 6, M + 1).

    Restricted likelihood: D. A. Harville, *Maximum likelihood approaches to variance component
    estimation*, JASA 72, 1977.
    """
    n = len(rows)
    n_columns = rows.shape[2]
    factors = np.linalg.cholesky(kernels)
    whitened = np.linalg.solve(factors, rows.reshape(1, n, -1))
    # The last of the triangle's rows is what no values explain.
    triangle = np.linalg.qr(whitened.reshape(len(kernels), 6 * n, n_columns), mode="r")
    sizes = np.abs(np.diagonal(triangle, 0, 1, 2)) + np.finfo(float).tiny
    levels = 2.0 * np.log(sizes[:, -1])
    logs = -0.5 * (6 * n + 1 - n_columns) * levels - np.log(sizes[:, :-1] + 1e-9).sum(axis=1)
    logs -= 6.0 * np.log(np.diagonal(factors, 0, 1, 2)).sum(axis=1)
    shares = np.exp(logs - logs.max())
    return np.asarray(shares / shares.sum() * np.exp(levels - levels[0]))


def _widened(
    stops: Stops,
    fit: RobotWorld,
    in_world: bool,
    alone: FloatArray,
    views: FloatArray,
    stretch: float,
) -> RobotWorld:
    """A fit with the covariance for time-correlated or recurring errors, and for targets of another
    size.
    """
    errors, jacobian = _linearise(stops, fit.Ts_parent_child, fit.Ts_world_world, in_world)
    T = stops.Ts_world_child if in_world else se3.inverse(stops.Ts_world_child)
    sign = -1.0 if in_world else 1.0
    longer = np.concatenate([sign * T[:, :3, 3], np.zeros((len(T), 3))], axis=1)
    rows = np.concatenate([jacobian, longer[..., None], errors[..., None]], axis=2)
    rows /= np.repeat([fit.level_m, fit.level_rad], 3)[:, None]
    told = rows * np.sqrt(fit.weights[fit.weights > 0.0])[:, None, None]
    pairs = _pairs(stops, len(fit.Ts_parent_child))
    most = max((own for own, _ in pairs), key=len)[:_AT_ONCE]
    shares = _shares(_kernels(views[most]), told[most])
    more = np.zeros_like(fit.information)
    for own, columns in pairs:
        for part in np.array_split(own, -(-len(own) // _AT_ONCE)):
            kernel = np.tensordot(shares, _kernels(views[part]), 1)
            kernel = alone[part, None] * kernel * alone[part] - np.diag(alone[part])
            across = np.swapaxes(rows[part, :, :12], 0, 1)
            more[np.ix_(columns, columns)] += np.einsum("kni,knj->ij", across, kernel @ across)
    more *= (_TAILS + 6.0) / (_TAILS + 8.0)
    larger = 1.0 + np.trace(more @ fit.covariance) / len(more)
    step = 0.0
    sigma = math.inf
    for own, columns in pairs:
        part = (np.sqrt(alone[own])[:, None, None] * told[own]).reshape(-1, 14)
        products = part.T @ part + 1e-12 * np.sum(part**2) * np.eye(14)
        of_one, of_errors = np.linalg.cholesky(products)[12:, 12]
        # What keeps the matrix definite is no information about the scale.
        is_known = of_one > 2e-6 * math.sqrt(float(np.sum(part**2)))
        if len(own) >= len(most) and is_known:
            step = -of_errors / of_one
            sigma = math.sqrt(larger) / of_one
        known = of_one**2 / larger + stretch**-2.0
        square = (of_one * of_errors / larger / known) ** 2 + 1.0 / known
        more[np.ix_(columns, columns)] += square * np.outer(products[:12, 12], products[:12, 12])
    few = 1.0 + 2.0 / max(3.0 * len(stops) - 0.5 * len(more), 0.5)  # hardly know the levels
    widened = few * (fit.covariance + fit.covariance @ more @ fit.covariance)
    sigma *= math.sqrt(few)
    return replace(fit, covariance=widened, scale_step=step, scale_sigma=sigma)


def _variances(means: FloatArray, stops: Stops, n_values: int) -> FloatArray:
    """Variances (2,) of positions and rotations; of one level if all positions may fit exactly."""
    if 3 * len(stops) <= n_values:
        places_m2 = stops.Ts_world_child[:, :3, 3].var(axis=0).sum() + _SMALLEST_VARIANCE
        means = means @ [0.5 / places_m2, 0.5] * np.array([places_m2, 1.0])
    return np.maximum(means, _SMALLEST_VARIANCE)


def _fit(
    stops: Stops, starts: tuple[FloatArray, ...], in_world: bool, tails: float, alone: FloatArray
) -> RobotWorld:
    """Weights, levels and Gauss-Newton steps in turn."""
    Xs, Zs = starts
    n = len(stops)
    n_values = 6 * (len(Xs) + len(Zs))
    pairs = _pairs(stops, len(Xs))
    # Values that the errors are fitted with make them smaller.
    n_free = max(3.0 * n - 0.5 * n_values, 0.5)
    # What the weights sum to in the end; levels that count with it from the start settle sooner:
    # C. Liu, D. B. Rubin, Y. N. Wu, *Parameter expansion to accelerate EM*, Biometrika 85, 1998.
    in_the_end = ((tails + 6.0) * n - 2.0 * n_free) / tails
    weights = alone
    for _ in range(_ROUNDS):
        errors, jacobian = _linearise(stops, Xs, Zs, in_world)
        squared = np.sum(errors.reshape(n, 2, 3) ** 2, axis=2)
        means = in_the_end / weights.sum() * (weights @ squared) / n_free
        variances = _variances(means, stops, n_values)
        distance = squared @ (1.0 / variances)
        weights = alone * student_weights(distance, tails)
        scale = np.sqrt(weights[:, None] * np.repeat(1.0 / variances, 3))
        rows = scale[..., None] * np.concatenate([jacobian, errors[..., None]], axis=2)
        products = _products(rows, pairs, n_values)
        # What is not determined stays where it is.
        held = 1e-13 * np.trace(products[:-1, :-1]) * np.eye(n_values)
        step = -np.linalg.solve(products[:-1, :-1] + held, products[:-1, -1])
        steps = se3.exp(step.reshape(-1, 6))
        Xs, Zs = Xs @ steps[: len(Xs)], Zs @ steps[len(Xs) :]
        if converged := bool(-step @ products[:-1, -1] < _SMALL_STEP**2):
            break
    # Of normal errors under a Student-t likelihood: Lange, Little, Taylor, *Robust statistical
    # modeling using the t distribution*, JASA 84, 1989, section 4.
    rows *= np.sqrt((tails + 6.0) / (tails + 8.0) * alone / weights)[:, None, None]
    fisher = _products(rows, pairs, n_values)[:-1, :-1]
    # What is not determined is known to a thousand times the errors of a stop.
    weak = np.diag(np.tile(np.repeat(1e-6 / variances, 3), n_values // 6))
    objective = 1.5 * n * np.log(variances).sum()
    objective += 0.5 * (tails + 6.0) * alone @ np.log1p(distance / tails)
    return RobotWorld(
        Ts_parent_child=Xs,
        Ts_world_world=Zs,
        covariance=np.asarray(np.linalg.inv(fisher + weak), dtype=float),
        information=fisher,
        weights=np.where(distance < _OUTLIER, np.minimum(weights / alone, 1.0), 0.0),
        level_m=float(np.sqrt(variances[0])),
        level_rad=float(np.sqrt(variances[1])),
        objective=float(objective),
        converged=converged,
    )
