"""Hypotheses about mistakes in two streams, and a list of the usual hypotheses.

:mod:`.hypotheses` searches for the hypothesis under which two streams agree.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hand_eye_calib.core.alignment.similarity import SimilarityFit
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.checks.findings import CONVENTIONS, Finding
from hand_eye_calib.core.checks.stream_pair import StreamPair
from hand_eye_calib.core.geometry import se3

# The streams agree under a hypothesis (it holds) if the unexplained share is below this limit.
HOLDS = 0.12
# A scale counts as one more mistake if its logarithm differs from 0 by more than this limit.
_ODD_SCALE = 0.05
# The shape of the motion decides between two readings if its absolute value exceeds this limit and
# the noise does not decide.
CLEAR_SHAPE = 0.4

# Codes of the mistakes of one stream.
_Codes: TypeAlias = tuple[str, ...]
EULER_ORDER: _Codes = ("euler_order",)


@dataclass(frozen=True)
class Hypothesis:
    """A combination of mistakes in both streams.

    Attributes
    ----------
    parent, child : tuple of str
        Mistakes of each stream, as codes of findings.
    axes : (3, 3) array or None
        Matrix that corrects positions in wrong axes: corrected = axes @ position.
    detail : str
        Corrected axes of the positions (x, y, z), such as "y -x z".
    """

    parent: _Codes = ()
    child: _Codes = ()
    axes: FloatArray | None = None
    detail: str = ""

    @property
    def is_uninverted(self) -> bool:
        """Whether both streams contain poses, not inverse poses."""
        return "inverse" not in self.parent and "inverse" not in self.child

    @property
    def mistakes(self) -> list[tuple[str, str]]:
        """Code and stream ("parent", "child" or "both") of each mistake."""
        streams = {
            (False, True): "child",
            (True, False): "parent",
            (True, True): "both",
        }
        codes = dict.fromkeys((*self.parent, *self.child))
        return [
            (code, streams[code in self.parent, code in self.child])
            for code in codes
        ]

    @property
    def complexity(self) -> tuple[int, int]:
        """Key that sorts hypotheses; the simplest is first.

        The first number counts the mistakes; each wrong axis counts as one more. The second number
        sorts hypotheses with equally many mistakes: mistakes of the child are before those of the
        parent.
        """
        n_mistakes = len(self.mistakes)
        if self.axes is not None:
            is_exchanged = (self.axes != np.eye(3)).any(axis=1)
            n_mistakes += int(is_exchanged.sum())
        return n_mistakes, 2 * len(self.parent) + len(self.child)

    def corrected(self, stream: str, poses: FloatArray) -> FloatArray:
        """Correct the poses (N, 4, 4) of the "parent" or the "child" stream for its mistakes."""
        codes = self.child if stream == "child" else self.parent
        if codes and self.axes is not None:
            return se3.from_rotation_translation(
                se3.rotation_of(poses), se3.translation_of(poses) @ self.axes.T
            )
        if codes == EULER_ORDER:
            rotations = se3.in_other_order(se3.rotation_of(poses))
            return se3.from_rotation_translation(
                rotations, se3.translation_of(poses)
            )
        return se3.put_right(poses, **dict(CONVENTIONS[code] for code in codes))

    def undo(self, streams: StreamPair) -> StreamPair:
        """Correct both streams for their mistakes."""
        if self is PLAIN:
            return streams
        parent = self.corrected("parent", streams.parent.poses)
        child = self.corrected("child", streams.child.poses)
        return replace(
            streams,
            parent=replace(streams.parent, poses=parent),
            child=replace(streams.child, poses=child),
        )

    def inverted(self) -> "Hypothesis":
        """Return the other reading: the same hypothesis with both streams inverted.

        It fits equally well.
        """
        return Hypothesis(
            _toggle_inverse(self.parent), _toggle_inverse(self.child)
        )


def _toggle_inverse(codes: _Codes) -> _Codes:
    """Add the mistake "inverse" to the mistakes of one stream; remove it if it is already there."""
    return tuple(
        [code for code in CONVENTIONS if (code in codes) != (code == "inverse")]
    )


@dataclass(frozen=True, kw_only=True)
class Readings:
    """Two hypotheses that fit equally well: the streams contain poses, or inverse poses.

    Attributes
    ----------
    hypotheses : tuple of two Hypothesis
        The second hypothesis is the first one with both streams inverted. If one of them inverts
        neither stream, :meth:`ordered` makes it the first.
    shape : float
        Sum of the log ratios of the paths and of the lever arms. A positive shape is evidence for
        the second hypothesis, a negative shape for the first.
    paths : float
        Log ratio of the paths without the lever arms.
    is_small : bool
        Whether all sensors stay within the reach of an arm. Correct data of an arm beside a fixed
        camera look like inverse poses.
    """

    hypotheses: tuple["Hypothesis", "Hypothesis"]
    shape: float
    paths: float
    is_small: bool

    @property
    def by_shape(self) -> int:
        """1 if the shape is clear evidence for the second reading, -1 for the first, else 0."""
        is_clear = abs(self.shape) > CLEAR_SHAPE
        return int(np.sign(self.shape)) if is_clear else 0

    @property
    def is_clear(self) -> bool:
        """Whether the shape of the motion decides between the hypotheses.

        It does not decide if a fixed camera beside an arm may be the cause of this shape.
        """
        is_fixed_camera = (
            self.is_small
            and self.hypotheses[0].is_uninverted
            and self.shape > 0.0
        )
        return self.by_shape != 0 and not is_fixed_camera

    def ordered(self) -> "Readings":
        """Return the readings, first the hypothesis that inverts neither stream."""
        first, second = self.hypotheses
        if not second.is_uninverted:
            return self
        return replace(
            self,
            hypotheses=(second, first),
            shape=-self.shape,
            paths=-self.paths,
        )


@dataclass(frozen=True)
class Explanation:
    """A hypothesis with its fit.

    Attributes
    ----------
    hypothesis : Hypothesis
    fit : SimilarityFit
    findings : tuple of Finding
        Findings about the mistakes of the hypothesis.
    limit : float
        Unexplained share below which the hypothesis holds.
    same_unit : bool
        Whether the scale of the fit was fixed to 1.
    readings : Readings or None
        Both readings (poses and inverse poses), if the other reading may be right; otherwise None.
    """

    hypothesis: Hypothesis
    fit: SimilarityFit
    findings: tuple[Finding, ...] = ()
    limit: float = HOLDS
    same_unit: bool = False
    readings: Readings | None = None

    @property
    def may_be_uninverted(self) -> bool:
        """Whether the other reading may be right, and the first reading inverts no stream."""
        return (
            self.readings is not None
            and self.readings.hypotheses[0].is_uninverted
        )

    @property
    def holds(self) -> bool:
        """Whether the streams agree under the hypothesis."""
        return self.fit.unexplained < self.limit

    @property
    def complexity(self) -> tuple[int, int]:
        """Key that sorts explanations, the simplest first. An odd scale counts as a mistake."""
        n_mistakes, of_streams = self.hypothesis.complexity
        has_odd_scale = abs(np.log(self.fit.scale)) > _ODD_SCALE
        return n_mistakes + int(has_odd_scale), of_streams


_MIRROR = -np.eye(3)
# Mistakes that one stream may have in the convention of its poses. One combination is left out:
# inverse orientations with quaternions in the order w x y z equal orientations in other axes.
CODES_OF_STREAM: list[_Codes] = [
    (),
    ("inverse",),
    ("inverse_orientation",),
    ("quaternion_order",),
    ("quaternion_order", "inverse"),
    ("quaternion_names",),
]
# All combinations of these mistakes in both streams.
CONVENTIONAL = list(
    itertools.starmap(Hypothesis, itertools.product(CODES_OF_STREAM, repeat=2))
)
# Hypothesis that both streams are without mistakes.
PLAIN = CONVENTIONAL[0]


# Usual mistakes. Hypotheses that invert both streams are left out: they fit as well as hypotheses
# that invert neither stream.
USUAL = [
    *(
        usual
        for usual in CONVENTIONAL[1:]
        if ("inverse", "both") not in usual.mistakes
    ),
    Hypothesis(child=("left_handed",), axes=_MIRROR),
    Hypothesis(parent=("left_handed",), axes=_MIRROR),
    Hypothesis(child=EULER_ORDER),
    Hypothesis(parent=EULER_ORDER),
]


def hypotheses_of_axes() -> Iterator[Hypothesis]:
    """Yield hypotheses with permuted and flipped axes of the positions, for either stream.

    The mirror of all three axes is left out: it is the mistake "left_handed". On flat ground some
    of these hypotheses fit as well as inverted orientations.
    """
    flips = itertools.product((1, -1), repeat=3)
    for order, signs in itertools.product(
        itertools.permutations(range(3)), flips
    ):
        matrix = np.diag(signs) @ np.eye(3)[list(order)]
        if np.array_equal(matrix, np.eye(3)) or np.array_equal(matrix, _MIRROR):
            continue
        names = []
        for axis, sign in zip(order, signs, strict=True):
            name = "xyz"[axis]
            names.append(name if sign > 0 else f"-{name}")
        detail = " ".join(names)
        yield Hypothesis((), ("axes",), matrix, detail)
        yield Hypothesis(("axes",), (), matrix, detail)
