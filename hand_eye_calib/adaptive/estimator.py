"""The adaptive estimator: X by generalised least squares under a noise model that is estimated
along with it.

Instead of choosing which poses to compare, all evidence is weighed as the noise of these very
trajectories asks for: white noise favours long baselines, drift short ones, and a jump cuts the
trajectory. docs/adaptive.md derives and tests it.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive.block_tridiagonal import BLOCK, diagonal_blocks
from hand_eye_calib.adaptive.increments import (
    ALL_SYSTEMATIC,
    CENTRES,
    NUISANCES,
    Increments,
    nuisance_columns,
    nuisance_values,
)
from hand_eye_calib.adaptive.noise import (
    LOWEST_VARIANCE,
    NoiseLevels,
    Solve,
    covariance_factor,
    fit_rotation_variances,
    fit_translation_variances,
    generalised_least_squares,
    join_variances,
    joined_columns,
    solve_normal_equations,
    solve_weighted,
    starting_variances,
)
from hand_eye_calib.adaptive.solution import AdaptiveSolution
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs
from hand_eye_calib.solvers.registry import Method

# Robust start: DNLO over this reference sees through jumps, and does not need the noise levels.
_START_REFERENCE = "B3"

# First look for jumps: increments this many robust sigmas out. Wide, for the noise levels are not
# known yet.
_FIRST_JUMP_SIGMAS = 5.0
_MEDIAN_OF_CHI_3 = 1.538

# Once the noise is known: false alarms expected in a whole trajectory.
_FALSE_ALARMS = 0.01

# A jump is given up when an increment of its size or more has this probability.
_PROBABLE = 0.01

# No more than this share of the increments can be jumps: where the noise levels would have it so,
# they are wrong.
_MOST_JUMPS = 0.5

# Noise levels need no more increments than this; longer drives lend evenly spread stretches of
# them.
_MOST_NOISE_INCREMENTS = 800
_STRETCH = 100

# Noise levels and X are improved in turn until X moves by less than this share of its sigma and no
# jump appears.
_MAX_ROUNDS, _SETTLED_SIGMAS = 4, 0.1

# Rotation noise turns about the origin of a world if residuals seen from there are so much smaller
# than at the sensors.
_DECISIVE = 0.7

# Rotation noise this large beside the rotation between poses is not small. Then every so many poses
# are tried, if enough of them remain.
_DROWNED = 0.2
_STRIDES = (3, 10, 30)
_FEWEST_STRIDES = 50

# Systematic errors larger than this (of the length, m/m, s) are none: a wrong unit, a clock that
# was not aligned, or noise. Nor is one assumed that can hardly be told from X: on flat ground a
# child that slips sideways looks like one that is mounted askew.
_MOST_SCALE_ERROR, _MOST_BIAS, _MOST_OFFSET_S = 0.5, 0.2, 0.5
_MOST_GROWTH = 5.0

# Errors that outlast the model show in sums of so many innovations; an excess below this many
# standard deviations may be chance.
_SUMMED, _CHANCE_SIGMAS = 16, 3.0

_MAX_STEPS = 20
_CONVERGED_SIGMAS, _CONVERGED_STEP = 1e-4, 1e-10


def solve(stamps_ns, Ts_pw_p, Ts_cw_c, nuisances=NUISANCES):
    """Estimate T_parent_child, the noise of the trajectories, and their covariance.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
        Poses of both sensors in their own worlds at these stamps.
    nuisances : sequence of str
        Systematic errors to choose from, by Schwarz's criterion (BIC); the first is fitted in any
        case, and should be "none" if there are others.

    Returns
    -------
    AdaptiveSolution
    """
    poses, first = _Poses(stamps_ns, Ts_pw_p, Ts_cw_c), nuisances[0]
    plain = _at_best_stride(_fit(_start(poses, np.arange(len(stamps_ns)), first)))
    chosen = _with_systematic_errors(plain, nuisances) if len(nuisances) > 1 else plain
    if chosen.nuisance != first:
        solution = _polished(_fit(chosen))
        if solution.converged and _is_plausible(solution.nuisance, solution.parameters):
            return solution
    # What does not lead to an answer is given up in turn: systematic errors, then noise that turns
    # about the origin of a world.
    solution = _polished(plain)
    if not solution.converged and solution.centre != "sensors":
        solution = _polished(
            _fit(_start(poses, np.arange(len(stamps_ns)), first, centres=("sensors",)))
        )
    return solution


def solve_without(stamps_ns, Ts_pw_p, Ts_cw_c, solution, left_out):
    """Answers near a given one without the evidence of some increments, for resampling. The noise
    levels are kept.

    Leaving increments out as such would cut the trajectory there, and with white noise most is
    known across the gap: the spread of the answers would overstate the error. Left out is what each
    increment adds to those before it: its innovations. These are independent of each other if the
    model is right.

    Parameters
    ----------
    stamps_ns, Ts_pw_p, Ts_cw_c
        As for :func:`solve`.
    solution : AdaptiveSolution
        Their solution.
    left_out : (B, n) bool array
        Increments to leave out, for each of B answers.

    Returns
    -------
    (B, 4, 4) array
    """
    kept = np.flatnonzero(solution.used)
    increments = _Poses(stamps_ns, Ts_pw_p, Ts_cw_c).increments(kept, solution.centre)
    linearisation = increments.linearise(
        solution.T_parent_child, solution.nuisance, solution.parameters
    )
    factor = covariance_factor(
        linearisation.components, solution.noise.variances(), _across(kept, solution.jumps)
    )
    innovations = factor.whiten(joined_columns(linearisation.residuals, linearisation.jacobian))
    innovations = innovations.reshape(len(increments), BLOCK, -1)
    per_increment = np.swapaxes(innovations, 1, 2) @ innovations
    steps = [
        solve_normal_equations(per_increment[~row].sum(axis=0)).step[:6]
        for row in _across(kept, left_out)
    ]
    return solution.T_parent_child @ se3.exp(np.array(steps))


def _across(kept, flags):
    """Whether any of the increments (..., n) is flagged between each kept pose and the next."""
    return np.logical_or.reduceat(flags[..., : kept[-1]], kept[:-1], axis=-1)


@dataclass(frozen=True)
class _Poses:
    stamps_ns: np.ndarray
    Ts_pw_p: np.ndarray
    Ts_cw_c: np.ndarray

    def increments(self, kept, centre):
        typical_ns = float(np.median(np.diff(self.stamps_ns)))
        return Increments(
            self.stamps_ns[kept], self.Ts_pw_p[kept], self.Ts_cw_c[kept], centre, typical_ns
        )


@dataclass(frozen=True)
class _State:
    """Where the search stands."""

    poses: _Poses
    kept: np.ndarray
    increments: Increments
    jumps: np.ndarray
    spikes: np.ndarray
    T: np.ndarray
    nuisance: str
    parameters: np.ndarray
    variances: np.ndarray | None = None
    solve: Solve | None = None
    iterations: int = 0

    @property
    def arguments(self):
        return self.T, self.nuisance, self.parameters

    def moved(self, step):
        return dataclasses.replace(
            self, T=self.T @ se3.exp(step[:6]), parameters=self.parameters + step[6:]
        )

    def without_spikes(self):
        """Without poses between two jumps. The increments that bridge them count as jumps until
        shown to be none.
        """
        jumps, kept = self.jumps, self.kept
        spikes = np.r_[False, jumps[:-1] & jumps[1:], False]
        if not spikes.any():
            return self
        remaining = np.flatnonzero(~spikes)
        increments = self.poses.increments(kept[remaining], self.increments.centre)
        return dataclasses.replace(
            self,
            kept=kept[remaining],
            increments=increments,
            jumps=_across(remaining, jumps),
            spikes=np.union1d(self.spikes, kept[spikes]),
        )


def _start(poses, kept, nuisance, spikes=(), centres=CENTRES):
    """Robust first answer from some of the poses, and what it says about jumps and the centre of
    the rotation noise.
    """
    T = (
        Method("dnlo")
        .solve(motion_pairs(poses.Ts_pw_p[kept], poses.Ts_cw_c[kept], _START_REFERENCE))
        .T_parent_child
    )
    increments = poses.increments(kept, centres[0])
    increments = [increments.about(centre) for centre in centres]
    sizes = [
        np.median(np.linalg.norm(each.seen_from_centre(T)[:, 3:], axis=1)) for each in increments
    ]
    best = int(np.argmin(sizes))
    increments = increments[best if sizes[best] < _DECISIVE * sizes[0] else 0]
    jumps = _robust_jumps(increments.seen_from_centre(T))
    parameters = np.zeros(len(nuisance_columns(nuisance)))
    return _State(
        poses, kept, increments, jumps, np.array(spikes, dtype=int), T, nuisance, parameters
    )


def _at_best_stride(state):
    """The fit to every pose, or to every third, tenth ... where that states the smaller covariance.

    Where noise drowns the rotation between poses, the first order that all of this rests on does
    not hold, and fast cameras repeat their errors from pose to pose. Longer steps cure both.
    """
    angles = se3.rotation_angle(state.increments.rotation_a)
    if state.variances[0] < (_DROWNED * np.median(angles)) ** 2:
        return state
    best, kept = state, state.kept
    for stride in _STRIDES:
        if len(kept) < stride * _FEWEST_STRIDES:
            break
        rival = _fit(_start(state.poses, kept[::stride], state.nuisance, state.spikes))
        if _log_volume(rival) < _log_volume(best):
            best = rival
    return best


def _log_volume(state):
    """Logarithm of the size of the stated covariance; infinite if there are directions it says
    nothing about.
    """
    return (
        np.inf if state.solve.unseen.size else float(np.linalg.slogdet(state.solve.covariance)[1])
    )


def _fit(state):
    """Noise levels, jumps and X of a model in turn, until they agree."""
    for _ in range(_MAX_ROUNDS):
        state = state.without_spikes()
        linearisation, variances = _noise_levels(state, *state.arguments)
        solve = generalised_least_squares(linearisation, variances, state.jumps)
        known_jumps = state.jumps
        state = dataclasses.replace(
            state.moved(solve.step),
            variances=variances,
            iterations=state.iterations + 1,
            solve=solve,
        )
        residuals = state.increments.residuals(*state.arguments)
        jumps = _jumps(residuals, linearisation.components, variances, solve.factor, known_jumps)
        state = dataclasses.replace(state, jumps=jumps)
        settled = np.abs(solve.step) < _SETTLED_SIGMAS * np.sqrt(np.diag(solve.covariance))
        if np.array_equal(jumps, known_jumps) and settled.all():
            break
    return state


def _with_systematic_errors(state, nuisances):
    """The model of systematic errors that Schwarz's criterion asks for, one step from the fit
    without.

    All models are judged on the same evidence: the same jumps, and the noise levels that are left
    when all systematic errors are accounted for.
    """
    zeros = np.zeros(len(nuisance_columns(ALL_SYSTEMATIC)))
    linearisation, variances = _noise_levels(state, state.T, ALL_SYSTEMATIC, zeros)
    factor = covariance_factor(linearisation.components, variances, state.jumps)
    n_observations = 6 * int((~state.jumps).sum())

    whitened = factor.whiten(joined_columns(linearisation.residuals, linearisation.jacobian))
    products = whitened.T @ whitened

    def solve(nuisance):
        columns = [*range(6), *(6 + column for column in nuisance_columns(nuisance)), -1]
        return solve_normal_equations(products[np.ix_(columns, columns)], factor)

    solves = {nuisance: solve(nuisance) for nuisance in nuisances}
    known = solves[nuisances[0]].covariance[:6, :6]
    credible = [name for name, solved in solves.items() if _is_credible(solved, name, known)]
    best = min(
        credible,
        key=lambda name: (
            solves[name].cost + len(nuisance_columns(name)) * np.log(max(n_observations, 2))
        ),
    )
    chosen = dataclasses.replace(
        state, nuisance=best, parameters=np.zeros(len(nuisance_columns(best))), variances=variances
    )
    return chosen.moved(solves[best].step)


def _is_plausible(nuisance, parameters):
    """Whether systematic errors are of a size that sensors have."""
    scale, biases, offset_s = nuisance_values(nuisance, parameters)
    return (
        max(
            abs(scale) / _MOST_SCALE_ERROR,
            np.abs(biases).max() / _MOST_BIAS,
            abs(offset_s) / _MOST_OFFSET_S,
        )
        < 1.0
    )


def _is_credible(solve, nuisance, known):
    """Whether a model's systematic errors are of a plausible size, and X can be told from them."""
    if not _is_plausible(nuisance, solve.step[6:]):
        return False
    growth = np.linalg.eigvals(
        np.linalg.pinv(known, hermitian=True) @ solve.covariance[:6, :6]
    ).real.max()
    return growth < _MOST_GROWTH**2


def _polished(state):
    """The covariance is settled; what is left is to follow the residuals to the minimum."""
    increments, variances, jumps = state.increments, state.variances, state.jumps
    factor = covariance_factor(increments.components(*state.arguments), variances, jumps)
    converged, iterations = False, state.iterations
    while not converged and iterations < _MAX_STEPS:
        iterations += 1
        solve = solve_weighted(
            increments.residuals(*state.arguments), increments.jacobian(*state.arguments), factor
        )
        state = state.moved(solve.step)
        tolerance = np.maximum(
            _CONVERGED_SIGMAS * np.sqrt(np.diag(solve.covariance)), _CONVERGED_STEP
        )
        converged = bool((np.abs(solve.step) < tolerance).all())
    used, spikes = np.zeros((2, len(state.poses.stamps_ns)), dtype=bool)
    used[state.kept] = spikes[state.spikes] = True
    misfit = _misfit(
        factor.whiten(increments.residuals(*state.arguments).reshape(-1, 1)).reshape(-1, 6)[~jumps]
    )
    all_jumps = np.zeros(len(spikes) - 1, dtype=bool)
    # A jump across poses left out is said to be before the next pose that is not.
    all_jumps[state.kept[1:][jumps] - 1] = True
    return AdaptiveSolution(
        state.T,
        misfit * solve.covariance[:6, :6],
        solve.unseen[:6],
        NoiseLevels.from_variances(variances),
        increments.centre,
        state.nuisance,
        state.parameters,
        all_jumps,
        spikes,
        used,
        misfit,
        _metres(state.poses.Ts_pw_p[used]) / len(used),
        solve.loss(),
        converged,
        iterations,
    )


def _noise_levels(state, *arguments):
    """Linearisation at given arguments, and variances (4,) from it or, for long drives, from evenly
    spread stretches.
    """
    linearisation, jumps = state.increments.linearise(*arguments), state.jumps
    sampled = linearisation
    if len(jumps) > _MOST_NOISE_INCREMENTS:
        sample = _stretches(len(jumps))
        sampled, jumps = linearisation.rows(sample), jumps[sample]
    return linearisation, _fit_noise(sampled, jumps, state.variances)


def _metres(poses):
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def _misfit(innovations):
    """By how much the variance of sums of successive innovations (n, 6) exceeds that of independent
    ones; 1 if it may be chance.
    """
    n_sums = len(innovations) // _SUMMED
    if n_sums == 0:
        return 1.0
    sums = innovations[: n_sums * _SUMMED].reshape(n_sums, _SUMMED, 6).sum(axis=1)
    excess = max((sums[:, part] ** 2).mean() / _SUMMED for part in (slice(0, 3), slice(3, 6)))
    return float(excess) if excess > 1.0 + _CHANCE_SIGMAS * np.sqrt(2.0 / (3 * n_sums)) else 1.0


def _fit_noise(linearisation, jumps, variances):
    """Variances (4,) from some of the increments, starting from earlier ones if there are any."""
    if variances is None:
        rotation = starting_variances(linearisation.residuals[:, :3], jumps)
        translation = starting_variances(linearisation.residuals[:, 3:], jumps)
    else:
        rotation, translation = variances[::2], variances[1::2]
    rotation = fit_rotation_variances(linearisation, jumps, rotation)
    return join_variances(
        rotation, fit_translation_variances(linearisation, jumps, rotation, translation)
    )


def _robust_jumps(residuals):
    jumps = np.zeros(len(residuals), dtype=bool)
    for columns in (slice(0, 3), slice(3, 6)):
        sizes = np.linalg.norm(residuals[:, columns], axis=1)
        jumps |= sizes > max(
            _FIRST_JUMP_SIGMAS * np.median(sizes) / _MEDIAN_OF_CHI_3, 10 * np.sqrt(LOWEST_VARIANCE)
        )
    return jumps


def _jumps(residuals, components, variances, factor, known_jumps):
    """Increments that the noise does not explain.

    Judged by what is left of each once those before it are known. For a known jump that is next to
    nothing, its variance being huge; it stays one unless its whole size is quite probable after
    all.
    """
    innovations = factor.whiten(residuals.reshape(-1, 1)).reshape(-1, 6)
    surprising = (innovations**2).sum(axis=1) > _chi2_quantile(_FALSE_ALARMS / len(residuals))
    blocks = diagonal_blocks(components.covariance(variances))
    sizes = (residuals * np.linalg.solve(blocks, residuals[:, :, None])[:, :, 0]).sum(axis=1)
    jumps = surprising | (known_jumps & (sizes > _chi2_quantile(_PROBABLE)))
    excess = int(jumps.sum()) - int(_MOST_JUMPS * len(jumps))
    if excess > 0:
        flagged = np.flatnonzero(jumps)
        jumps[flagged[np.argsort(sizes[flagged], kind="stable")[:excess]]] = False
    return jumps


def _chi2_quantile(tail):
    """What chi-square with six degrees of freedom exceeds with this probability, from 1e-30 to
    0.99, without importing scipy.special.

    It exceeds 2 h with probability ``exp(-h) (1 + h + h^2 / 2)``. The negative logarithm of that is
    convex and grows with h: Newton's method converges from above, in ten steps or fewer.
    """
    half = 10.0 - 2.0 * np.log(tail)
    for _ in range(_MAX_STEPS):
        series = 1.0 + half + half**2 / 2
        excess = half - np.log(series) + np.log(tail)
        half -= excess * series / (half**2 / 2)
    return 2.0 * half


def _stretches(n_increments):
    """Indices of evenly spread stretches of the increments."""
    starts = np.linspace(0, n_increments - _STRETCH, _MOST_NOISE_INCREMENTS // _STRETCH).astype(int)
    return (starts[:, None] + np.arange(_STRETCH)).ravel()
