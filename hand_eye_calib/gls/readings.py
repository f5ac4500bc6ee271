"""Two readings of the same poses, compared by the likelihood of their noise.

Two streams agree with each other as well if every pose of both is inverted: A Y = Y B then holds
for the pose Y of one world in the other. No residual tells which reading is right. The noise tells:
drift adds up in the frame of a sensor, and rotation errors turn about a sensor, or about the target
that a camera sees. In the wrong reading the same errors grow with the distance from a world.

The losses of two readings are comparable under these conditions:

- Motions, not poses, are the data. Inversion transforms motions by an adjoint of determinant 1, so
  both readings have the same units of probability.
- Both readings leave out the same jumps and outlier poses, and have no robust weights.
- Both have the same parameters with the same prior standard deviations.
- Each reading has the centre of rotation noise that suits it best. A camera's view of a target is
  as good an explanation of white noise as the inverse of a tracker's poses.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from hand_eye_calib.arrays import FloatArray, IntArray
from hand_eye_calib.gls import stages
from hand_eye_calib.gls.increments import PARAMETERS, SYSTEMATIC, Streams
from hand_eye_calib.gls.noise_model import CENTRES
from hand_eye_calib.gls.outliers import Outliers, bridged

# Most poses that are compared, evenly spread: the search takes about 1 ms a pose and reading.
MOST_POSES = 1500


def loss_difference(
    stamps_ns: IntArray,
    first: tuple[FloatArray, FloatArray],
    second: tuple[FloatArray, FloatArray],
) -> float:
    """Return the restricted negative log likelihood of the second reading less that of the first.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    first, second : tuples of two (N, 4, 4) arrays
        Poses of parent and child at these stamps. The lengths of both sensors are in one unit.

    Returns
    -------
    float
        Negative if the noise model explains the second reading better.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the noise model cannot be fitted to a reading.
    """
    stride = -(-len(stamps_ns) // MOST_POSES)
    problems = []
    for Ts_pw_p, Ts_cw_c in (first, second):
        stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
        streams = Streams(stamps_s, Ts_pw_p, Ts_cw_c)[::stride]
        columns = [column for name in SYSTEMATIC for column in PARAMETERS[name]]
        problems.append(stages.Problem(streams, columns))
    starts = []
    for problem in problems:
        noise = stages.noise(problem, stages.start(problem))
        starts.append(stages.outliers(problem, noise))
    common = Outliers(
        starts[0].outliers.jumps | starts[1].outliers.jumps,
        starts[0].outliers.spikes | starts[1].outliers.spikes,
    )
    losses = []
    for problem, start in zip(problems, starts, strict=True):
        losses.append(_least_loss(problem, start, common))
    return losses[1] - losses[0]


def _least_loss(problem: stages.Problem, start: stages.Fit, outliers: Outliers) -> float:
    """Return the least loss of a reading over the centres of rotation noise, with these outliers
    and without weights.
    """
    n_poses = len(problem.streams)
    fits = []
    for centre in CENTRES:
        plain = replace(
            start,
            poses=bridged(problem.streams, start.T, outliers.spikes),
            error=np.zeros((n_poses, 6)),
            model=replace(start.model, slow=(), centre=centre),
            outliers=outliers,
            weights=np.ones(n_poses),
            has_heavy_tails=False,
        )
        with suppress(np.linalg.LinAlgError):
            fits.append(stages.noise(problem, plain))
    if not fits:
        raise np.linalg.LinAlgError("no noise model fits these poses")
    best = min(fits, key=lambda fit: _loss(problem, fit))
    best = stages.lasting(problem, best)
    return min(_loss(problem, best), _loss(problem, stages.polish(problem, best)))


def _loss(problem: stages.Problem, fit: stages.Fit) -> float:
    """Return the restricted negative log likelihood, with the scale of the parameters' prior."""
    prior_sigmas = fit.sigmas[problem.columns]
    return problem.posterior(fit).loss + float(np.log(prior_sigmas).sum())
