"""Noise model of two trajectories, and X by generalised least squares under this model.

Model, for poses i = 0 ... N - 1 and the increments from pose i to pose i + 1:

    e_i + J_i beta = c_{i+1} - Ad(B_i^-1) c_i + D_i d_i + w_i
    c_i = v_i + sum_k M_ik g_ik
    g_{i+1,k} = phi_ik g_ik + q_ik

- e_i (6,): residual ``Log(B_i^-1 X^-1 A_i X)`` of the motions A_i of the parent and B_i of the
  child. All vectors of six are in the child's frame: translation (m), then rotation (rad).
- beta (p,): corrections of the present estimate: xi of ``X Exp(xi)``, then the systematic errors
  (scale, bias per metre of path, time offset, bias of angular rates).
- J_i (6, p): derivatives of e_i with respect to beta.
- c_i (6,): error of a pair of poses, one of each sensor at the same instant. v_i (6,): its white
  part.
- g_ik: time-correlated errors, which are first-order Gauss-Markov processes; q_ik: their white
  driving noise. M_ik is the matrix from process k to c_i.
- d_i: errors of the path, a drifting scale and direction, which are processes like g_ik; D_i is the
  derivative of e_i with respect to them. A path that is too long by d_i changes e_i like a scale
  of d_i in beta, so D_i and J_i have the same column for both. The scale in beta is a correction
  (-d_i for a constant error), and so it is on the left side.
- w_i (6,): step of a random walk, the drift of odometry. Its variance grows with time, not with the
  length of the path. w is white, and no state contains the walk itself.
- x_i (d,): state of pose i, which is v_i followed by all processes.

v, g and w are Gaussian. Their variances and the time constants of g are unknown: a *level* is the
logarithm of one of them. The estimate has three parts:

1. The states x and the walk w are marginalised exactly, by linear algebra in time linear in N.
2. The levels maximise their posterior density: the restricted likelihood (REML), in which beta is
   marginalised, too, times weak priors of the jitter and of the time constants. The variances have
   only bounds. The levels are fitted to a sample of the poses if there are many.
3. beta is estimated by generalised least squares at these levels, and e is linearised again.

Jumps, outlier poses and the choice of processes and systematic errors are decided between these
parts, in the order of the stages.

A process g_ik is one scalar. The one or three processes of one error share variance and time
constant, and form a *group*. The noise model names a group by its kind and part, for example
``("body", "translation")``, and calls the whole group a process.

Limits: the linearisation is of first order, the noise levels are constant in time, and about 30
poses are needed. Method "auto" uses DNLO instead if X does not settle, or if the rotation noise of
single poses exceeds their rotation. The covariance is that of this model: constant errors and a
shift of the mount are added in :mod:`hand_eye_calib.core.assessment`.

Reading order: :mod:`~hand_eye_calib.core.noise.tuning` (limits, in the order of their
use), :mod:`~hand_eye_calib.core.noise.increments` (e and J),
:mod:`~hand_eye_calib.core.noise.noise_model` (errors that are in the model),
:mod:`~hand_eye_calib.core.noise.state_space` (likelihood and posterior of the states),
:mod:`~hand_eye_calib.core.noise.normal` (linear algebra), :mod:`~hand_eye_calib.core.noise.reml`
(levels), :mod:`~hand_eye_calib.core.noise.outliers` (jumps, outlier poses and heavy tails),
:mod:`~hand_eye_calib.core.noise.fit` (state of the search),
:mod:`~hand_eye_calib.core.noise.stages` (steps of the search),
:mod:`~hand_eye_calib.core.noise.estimator` (the search and its solution). docs/adaptive.md has the
derivation.
"""
