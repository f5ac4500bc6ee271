"""Lever arm of a sensor that measures only positions: a GNSS antenna, the prism of a total station.

The odometry of the other sensor has the poses (R_i, t_i). The measured positions are

    q_i = W_i (R_i l + t_i) + o_i + white noise

l is the lever arm. (W_i, o_i) is the pose of the odometry's world in the world of the positions,
which drifts. The orientations Q_i = W_i R_i are latent: their error is white without bounds, and
they change from pose to pose like the odometry, up to its drift. This is the state space of the
adaptive estimator (:mod:`~hand_eye_calib.core.noise.state_space`, docs/adaptive.md) for X = (I, l).
The orientations are updated from the positions until they settle. The search starts from windows of
the recording, each aligned on its own.

Errors that act like a lever arm are parameters, too, with the prior of usual sensors: scale and
direction of the odometry's path, and a time offset. Positions may also respond to acceleration with
a factor kappa (s^2), for instance if they are smoothed. A drone tilts to accelerate, so the
response shifts the vertical lever arm by kappa g. This model cannot estimate kappa well: above
about 0.8 Hz the accelerations of a drone are mostly noise of the odometry, which looks like
smoothed positions. Here the response is only in the covariance.
:attr:`LeverArmSolution.by_response` is the change of the lever arm for a response that
:mod:`~hand_eye_calib.extras.partial.position_columns` estimates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from hand_eye_calib.core.assessment.noise_words import events
from hand_eye_calib.core.base.arrays import BoolArray, FloatArray, IntArray
from hand_eye_calib.core.base.text import angle, length
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.noise import increments, reml
from hand_eye_calib.core.noise.estimator import (
    MIN_REPORTED_SIGMAS,
    ModelSolution,
)
from hand_eye_calib.core.noise.noise_model import (
    JITTER,
    MIN_VARIANCE,
    N_FAST,
    ROTATION,
    ROTATIONS,
    TRANSLATIONS,
    WALK_ROTATION,
    WALK_TRANSLATION,
    NoiseModel,
    fast_sigmas,
    rough_levels,
)
from hand_eye_calib.core.noise.normal import NormalEquations, prior_products
from hand_eye_calib.core.noise.outliers import (
    Outliers,
    bridge_outliers,
    detect_outliers,
    leave_one_out_chi_squares,
)
from hand_eye_calib.core.noise.stages import sample
from hand_eye_calib.core.noise.state_space import Posterior, StateSpace
from hand_eye_calib.core.results.records import Noise
from hand_eye_calib.extras.partial.position_tuning import TUNING, PositionTuning
from hand_eye_calib.extras.partial.position_windows import fit_windows

# Index of a parameter that poses do not have: the response to acceleration (s^2) of the positions
# minus that of the odometry. It is not estimated with the other parameters.
RESPONSE = increments.N_SYSTEMATIC

# Log variance (rad^2) of orientations without bounds.
_ANY_ROTATION = math.log(100.0)

# Parameters that are estimated together with the lever arm.
_SHARED = [increments.SCALE, *increments.BIAS, increments.TIME]


@dataclass(frozen=True, kw_only=True)
class LeverArmSolution(ModelSolution):
    """Lever arm with its noise model.

    Attributes
    ----------
    lever_arm : (3,) array
        Position of the antenna (m) in the axes of the sensor with poses.
    covariance : (3, 3) array
        Covariance under the model, with the misfit.
    by_response : (3,) array
        Change of the lever arm (m) if positions respond to acceleration by 1 s^2.
    imprecise : (N,) bool array
        Positions that are not used: their neighbourhood is far less precise than the best part of
        the recording.
    """

    lever_arm: FloatArray
    covariance: FloatArray
    by_response: FloatArray
    imprecise: BoolArray
    prior_scale_sigma: float

    def describe(self, stamps_ns: IntArray) -> Noise:
        """Return the noise as numbers and as sentences."""
        sigmas = fast_sigmas(self.levels)
        white = length(sigmas.translation_m)
        drift = f"{length(sigmas.walk_translation_m)} and {angle(sigmas.walk_rotation_rad)}"
        sentences = [
            f"each position is off by {white} per axis, and the odometry drifts by {drift} from "
            "one to the next"
        ]
        if self.imprecise.any():
            share = f"{self.imprecise.mean():.0%} of the positions"
            sentences.append(f"{share} are far less precise, and are left out")
        response_mm = -1e3 * self.parameters[RESPONSE]
        sigma_mm = 1e3 * self.parameter_sigmas[RESPONSE]
        if abs(response_mm) > MIN_REPORTED_SIGMAS * sigma_mm:
            sentences.append(
                f"acceleration shifts the positions by {response_mm:.1f} +/- {sigma_mm:.1g} mm per "
                "m/s^2 (one of the sensors smooths); the +/- values contain the effect of this"
            )
        sentences += events(self, stamps_ns)
        return Noise(
            translation_white_m=sigmas.translation_m,
            translation_drift_m_per_pose=sigmas.walk_translation_m,
            rotation_drift_rad_per_pose=sigmas.walk_rotation_rad,
            misfit=self.misfit,
            in_words=tuple(sentences),
        )


def solve(
    stamps_ns: IntArray,
    Ts_pw_p: FloatArray,
    positions: FloatArray,
    with_scale: bool = False,
    tuning: PositionTuning = TUNING,
) -> LeverArmSolution:
    """Estimate the lever arm of a sensor that measures positions.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    Ts_pw_p : (N, 4, 4) array
        Poses of the other sensor in its world.
    positions : (N, 3) array
        Positions at the same stamps, in their own world.
    with_scale : bool
        Whether to estimate the scale between both worlds.
    tuning : PositionTuning
    """
    lever_arm, scale, rotations = fit_windows(
        Ts_pw_p, positions, with_scale, tuning.window
    )
    stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
    Ts = se3.from_rotation_translation(rotations, scale * positions)
    streams = increments.Streams(stamps_s, Ts_pw_p, Ts)
    state = _State.initial(streams, lever_arm, with_scale, tuning)
    for number in range(tuning.rounds):
        if number in tuning.fits:
            is_first_fit = number == tuning.fits[0]
            state = state.fitted(("body", "world") if is_first_fit else ())
        posterior = Posterior(state.space(), state.levels)
        if number + 1 in tuning.fits[1:]:
            state = state.with_outliers(posterior)
        normal = NormalEquations(_solved(posterior.products))
        step = normal.step
        sigmas = np.sqrt(np.diag(normal.covariance)[:3])
        is_small = np.abs(step[:3]) < tuning.settled_sigmas * sigmas
        is_settled = bool((is_small | (sigmas > tuning.unknown_m)).all())
        converged = number > tuning.fits[-1] and is_settled
        if converged:
            break
        state = state.after(posterior, step)
    return _solution(state, posterior, converged, scale)


@dataclass(frozen=True, kw_only=True)
class _State:
    """State of the search.

    Attributes
    ----------
    positions : (N, 3) array
    streams : Streams
        Poses of both sensors. The child's poses are the positions with the current orientations.
        Unused positions are bridged.
    X : (4, 4) array
        (I, l).
    sigmas : (9,) array
        Prior standard deviations of the lever arm and the parameters.
    parameters : (9,) array
    model : NoiseModel
    levels : (m,) array
    outliers : Outliers
    walk_factors : (n,) array
        Factors of the variance of the walk; above 1 at jumps.
    imprecise : (N,) bool array
        Positions whose neighbourhood is far less precise than the best part of the recording.
    tuning : PositionTuning
    """

    positions: FloatArray
    streams: increments.Streams
    X: FloatArray
    sigmas: FloatArray
    parameters: FloatArray
    model: NoiseModel
    levels: FloatArray
    outliers: Outliers
    walk_factors: FloatArray
    imprecise: BoolArray
    tuning: PositionTuning

    @classmethod
    def initial(
        cls,
        streams: increments.Streams,
        lever_arm: FloatArray,
        with_scale: bool,
        tuning: PositionTuning,
    ) -> _State:
        """Return the state at the start of the search."""
        stamps_s = streams.stamps_s
        n = len(streams) - 1
        sigmas = np.array(tuning.of_positions)
        if with_scale:
            sigmas[3] = np.inf
        interval_s = float(np.median(np.diff(stamps_s)))
        duration_s = float(stamps_s[-1])
        state = cls(
            positions=se3.translation_of(streams.Ts_cw_c),
            streams=streams,
            X=se3.from_rotation_translation(np.eye(3), lever_arm),
            sigmas=sigmas,
            parameters=np.zeros(RESPONSE + 1),
            model=NoiseModel((), "sensors", interval_s, duration_s, tuning),
            levels=np.zeros(0),
            outliers=Outliers(
                np.zeros(n, dtype=bool), np.zeros(n + 1, dtype=bool)
            ),
            walk_factors=np.ones(n),
            imprecise=np.zeros(n + 1, dtype=bool),
            tuning=tuning,
        )
        residuals = state.linearised().residuals
        squares = (residuals[:, :3] ** 2).sum(axis=1)
        square_of_position = [
            squares[:1],
            0.5 * (squares[1:] + squares[:-1]),
            squares[-1:],
        ]
        imprecise = _imprecise(
            np.concatenate(square_of_position), tuning, MIN_VARIANCE
        )
        levels = rough_levels(
            residuals, imprecise[1:] | imprecise[:-1], tuning.jitter
        )
        levels[ROTATION] = _ANY_ROTATION
        levels[WALK_ROTATION] = tuning.rotation_walk[1]
        streams = bridge_outliers(streams, state.X, imprecise)
        return replace(
            state, streams=streams, levels=levels, imprecise=imprecise
        )

    @property
    def left_out(self) -> BoolArray:
        """Positions (N,) that are not used: outliers and imprecise positions."""
        return self.outliers.spikes | self.imprecise

    @property
    def course(self) -> increments.Course:
        """Path of the antenna (the end of the lever arm), predicted by the odometry.

        The path is in the axes of the positions' world, and without the noise of the positions.
        """
        streams = self.streams
        course = increments.course_of(
            replace(streams, Ts_cw_c=streams.Ts_pw_p @ self.X), self.X
        )
        back_p = np.swapaxes(streams.Ts_pw_p[:-1, :3, :3], 1, 2)
        worlds = streams.Ts_cw_c[:-1, :3, :3] @ back_p
        return replace(
            course,
            path=increments.cumulative_sum(
                se3.times(worlds, np.diff(course.path, axis=0))
            ),
            along=increments.cumulative_sum(
                worlds @ np.diff(course.along, axis=0)
            ),
        )

    def linearised(self) -> increments.Linearisation:
        """Linearise increments between poses with respect to lever arm and parameters."""
        accelerations = _accelerations(self.streams, self.X, self.tuning)
        linearisation = increments.linearise(
            self.streams,
            self.course,
            self.X,
            self.parameters[:RESPONSE],
            _SHARED,
        )
        response = (
            se3.times(linearisation.adjoints, accelerations[:-1])
            - accelerations[1:]
        )
        columns = np.insert(linearisation.columns, -1, response, axis=2)
        return replace(
            linearisation, columns=np.delete(columns, [3, 4, 5], axis=2)
        )

    def space(self, model: NoiseModel | None = None) -> StateSpace:
        """Return the state space of all poses.

        The state space estimates no rotation. Its orientations have no bounds, and its walk is that
        of the odometry.
        """
        values = np.r_[
            se3.translation_of(self.X), self.parameters[[*_SHARED, RESPONSE]]
        ]
        prior = prior_products(values, self.sigmas, len(values) + 1)
        space = (model or self.model).state_space(
            self.streams,
            self.linearised(),
            self.course.twists,
            self.X,
            np.where(self.left_out, 0.0, 1.0),
            np.zeros(len(self.walk_factors), dtype=bool),
            prior,
        )
        to_child = se3.adjoint(se3.inverse(self.X))
        return replace(
            space,
            walk_factors=space.walk_factors * self.walk_factors,
            white_bases=(
                TRANSLATIONS[None],
                ROTATIONS[None],
                space.white_bases[JITTER],
            ),
            walk_bases=(TRANSLATIONS, to_child @ ROTATIONS @ to_child.T),
        )

    def sampled_space(self, model: NoiseModel | None = None) -> StateSpace:
        """Return the state space of a sample of the poses that suffices for the noise levels."""
        kept = sample(len(self.streams), self.tuning)
        if kept is None:
            return self.space(model)
        jumps = self.outliers.across(kept, self.tuning.burst[-1]).jumps
        subset = replace(
            self,
            streams=self.streams[kept],
            outliers=Outliers(jumps, self.outliers.spikes[kept]),
            # A kept increment may span several jumps. Give it the factor of the worst jump.
            walk_factors=np.where(jumps, self.walk_factors.max(), 1.0),
            imprecise=self.imprecise[kept],
        )
        return subset.space(model)

    def fitted(self, kinds: tuple[str, ...] = ()) -> _State:
        """Return the state with fitted noise levels.

        A time-correlated error of the positions is added if it lowers the loss by more than
        ``least_gain``.
        """
        tuning = self.tuning
        prior = _level_prior(self.model, self.levels, tuning)
        fit, _ = reml.fit(
            self.sampled_space(), self.levels, prior, tuning.settled_loss
        )
        best = replace(self, levels=fit.levels)
        loss = fit.loss - tuning.least_gain
        for kind in kinds:
            model, levels = self.model.with_processes(
                ((kind, "translation"),), fit.levels
            )
            prior = _level_prior(model, levels, tuning)
            rival, _ = reml.fit(
                self.sampled_space(model), levels, prior, tuning.settled_loss
            )
            if rival.loss < loss:
                best = replace(self, model=model, levels=rival.levels)
                loss = rival.loss
        return best

    def with_outliers(self, posterior: Posterior) -> _State:
        """Return the state with detected jumps, outliers and imprecise positions.

        Jumps are large steps of the walk. Outliers are single wrong positions.
        """
        of_walk, of_white = leave_one_out_chi_squares(posterior, self.left_out)
        tuning = self.tuning
        outliers = detect_outliers(self.outliers, of_walk, of_white, tuning)
        jump_factors = np.maximum(
            tuning.jump_factor * of_walk, self.walk_factors
        )
        errors = posterior.states_after(posterior.normal.step)[:, :3]
        Ts_cw_c = self.streams.Ts_cw_c.copy()
        path = se3.translation_of(Ts_cw_c) + se3.times(
            se3.rotation_of(Ts_cw_c), errors
        )
        spread = posterior.factor.selected_inverse[0][:, range(3), range(3)]
        drift = 3.0 * float(np.exp(self.levels[WALK_TRANSLATION]))
        squares = ((self.positions - path) ** 2 + spread).sum(axis=1)
        imprecise = _imprecise(squares, tuning, drift)
        Ts_cw_c[:, :3, 3] = np.where(imprecise[:, None], path, self.positions)
        return replace(
            self,
            outliers=outliers,
            walk_factors=np.where(outliers.jumps, jump_factors, 1.0),
            streams=replace(self.streams, Ts_cw_c=Ts_cw_c),
            imprecise=imprecise,
        )

    def after(self, posterior: Posterior, step: FloatArray) -> _State:
        """Return the state after a step, with new orientations that fit the positions best."""
        turns = posterior.states_after(np.r_[step, 0.0])[:, 3:6]
        Ts_cw_c = self.streams.Ts_cw_c.copy()
        Ts_cw_c[:, :3, :3] = se3.rotation_of(Ts_cw_c) @ se3.rotation_exp(turns)
        X = self.X.copy()
        parameters = self.parameters.copy()
        X[:3, 3] += step[:3]
        parameters[_SHARED] += step[3:]
        streams = replace(self.streams, Ts_cw_c=Ts_cw_c)
        return replace(self, streams=streams, X=X, parameters=parameters)


def _imprecise(
    squares: FloatArray, tuning: PositionTuning, drift_m2: float
) -> BoolArray:
    """Detect positions (N,) in a neighbourhood that is far less precise than the best quarter.

    Parameters
    ----------
    squares : (N,) array
        Squared errors, m^2.
    tuning : PositionTuning
    drift_m2 : float
        Variance of the odometry's drift between successive positions. It is a lower bound of the
        usual square.
    """
    window = np.ones(min(tuning.neighbours, len(squares)))
    sums = np.convolve(squares, window, mode="same")
    counts = np.convolve(np.ones(len(squares)), window, mode="same")
    means = sums / counts
    usual = max(float(np.quantile(means, 0.25)), drift_m2)
    return sums > tuning.worst_error_factor * usual * counts


def _level_prior(
    model: NoiseModel, levels: FloatArray, tuning: PositionTuning
) -> reml.Prior:
    """Return the prior of the log levels, for a search that starts at ``levels``."""
    prior = model.prior(levels)
    prior.lower[ROTATION] = prior.upper[ROTATION] = _ANY_ROTATION
    lowest, _, highest = tuning.rotation_walk
    prior.lower[WALK_ROTATION] = lowest
    prior.upper[WALK_ROTATION] = highest
    return prior


def _solution(
    state: _State, posterior: Posterior, converged: bool, first_scale: float
) -> LeverArmSolution:
    """Return the solution of the last round, in the scale of the start."""
    normal = NormalEquations(_solved(posterior.products))
    n_evidence = len(state.walk_factors) - int(state.left_out.sum())
    misfit = float(normal.cost) / max(3 * n_evidence - 3 - len(_SHARED), 1)
    # The lever arm is estimated without the response to acceleration, but its covariance allows for
    # a response. It is the covariance of the estimate with the response, plus the square of the
    # shift of the lever arm by this response.
    with_response = posterior.normal
    covariance = max(misfit, 1.0) * with_response.covariance
    shift = (with_response.step[:-1] - normal.step)[:3]
    sigmas = np.zeros(RESPONSE + 1)
    parameters = state.parameters.copy()
    sigmas[[*_SHARED, RESPONSE]] = np.sqrt(np.diag(covariance)[3:])
    parameters[[*_SHARED, RESPONSE]] += np.r_[
        normal.step[3:], with_response.step[-1]
    ]
    # An error that is correlated over a part of the recording may also have a part that is constant
    # over the whole recording. X absorbs the constant part, so the variance of the error is added.
    lasting = 0.0
    if state.model.processes:
        lasting = float(np.exp(state.levels[N_FAST]))
    of_lever_arm = covariance[:3, :3] + np.outer(shift, shift)
    return LeverArmSolution(
        lever_arm=se3.translation_of(state.X) + normal.step[:3],
        covariance=of_lever_arm + lasting * np.eye(3),
        by_response=_by_response(posterior.products),
        parameters=parameters,
        parameter_sigmas=sigmas,
        scale=first_scale * (1.0 + float(parameters[increments.SCALE])),
        scale_sigma=first_scale * float(sigmas[increments.SCALE]),
        time_offset_s=-float(parameters[increments.TIME]),
        time_offset_sigma_s=float(sigmas[increments.TIME]),
        model=state.model,
        levels=state.levels,
        imprecise=state.imprecise,
        prior_scale_sigma=state.tuning.of_positions[3],
        jumps=state.outliers.jumps,
        spikes=state.outliers.spikes,
        part_products=_solved(posterior.part_products()),
        misfit=misfit,
        objective=0.5 * (posterior.log_determinant + float(normal.cost)),
        converged=converged,
    )


def _solved(products: FloatArray) -> FloatArray:
    """Return the products (..., 9, 9) without the row and column of the response.

    The rows are the lever arm, the parameters that are estimated with it, and the residuals.
    """
    response = 3 + len(_SHARED)
    return np.delete(np.delete(products, response, axis=-2), response, axis=-1)


def _by_response(products: FloatArray) -> FloatArray:
    """Return the change (3,) of the lever arm for a response of 1 s^2, from products (10, 10)."""
    response = 3 + len(_SHARED)
    information = products[:response, :response]
    with_response = products[:response, response]
    return np.asarray(
        -np.linalg.solve(information, with_response)[:3], dtype=float
    )


def _accelerations(
    streams: increments.Streams, X: FloatArray, tuning: PositionTuning
) -> FloatArray:
    """Return the accelerations (N, 6) of the antenna by the odometry, m/s^2, in body axes.

    An acceleration is the difference of two velocities, before and after a pose. It does not
    contain the noise of this pose. Accelerations near gaps and at the ends are zero, and so are the
    last three columns.
    """
    path = se3.translation_of(streams.Ts_pw_p @ X)
    stamps_s = streams.stamps_s
    accelerations = np.zeros((len(path), 6))
    interval_s = float(np.median(np.diff(stamps_s)))
    k = max(round(tuning.accelerating_s / interval_s), 1)
    if len(path) <= 4 * k:
        return accelerations
    steps = path[k:] - path[:-k]
    durations_s = stamps_s[k:] - stamps_s[:-k]
    velocities = steps / durations_s[:, None]
    spans_s = (stamps_s[4 * k :] - stamps_s[: -4 * k])[:, None]
    # Both velocities are means over a quarter of the span. Their centres are three quarters of the
    # span apart.
    in_world = (velocities[3 * k :] - velocities[: -3 * k]) / (0.75 * spans_s)
    middle = slice(2 * k, -2 * k)
    to_body = np.swapaxes(streams.Ts_pw_p[middle, :3, :3], 1, 2)
    is_near = spans_s < tuning.longest_span_factor * 4 * k * interval_s
    accelerations[middle, :3] = np.where(
        is_near, se3.times(to_body, in_world), 0.0
    )
    return accelerations
