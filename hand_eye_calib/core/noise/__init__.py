"""Noise model of two trajectories, and X by generalised least squares under this model.

Model, for poses i = 0 ... N - 1 and the increments from pose i to pose i + 1:

    e_i + J_i beta = c_{i+1} - Ad(B_i^-1) c_i + w_i
    c_i = v_i + sum_k M_ik g_ik,      g_{i+1,k} = phi_ik g_ik + q_ik

- e_i (6,): residual of an increment; B_i: motion of the child; J_i: derivatives of e_i.
- beta: xi in ``X exp(xi)``, and the systematic errors scale, bias, time offset and bias of rates.
- c_i (6,): error of a pair of poses in the child's frame; w_i: step of a random walk.
- v_i: white error; g_ik: first-order Gauss-Markov processes; together the state x_i.

The states x and the walk w are marginalised exactly. The levels, which are the logarithms of all
variances and time constants, are estimated by restricted maximum likelihood (REML), for which beta
is marginalised, too. beta is estimated by generalised least squares at these levels.

Reading order: :mod:`~hand_eye_calib.core.noise.increments` (e and J),
:mod:`~hand_eye_calib.core.noise.noise_model` (errors that are in the model),
:mod:`~hand_eye_calib.core.noise.state_space` (likelihood and posterior of the states),
:mod:`~hand_eye_calib.core.noise.normal` (linear algebra), :mod:`~hand_eye_calib.core.noise.reml`
(levels), :mod:`~hand_eye_calib.core.noise.outliers` (jumps, outlier poses and heavy tails),
:mod:`~hand_eye_calib.core.noise.stages` (steps of the search),
:mod:`~hand_eye_calib.core.noise.estimator` (the search and its solution). docs/adaptive.md has the
derivation.
"""
