"""Hypotheses about mistakes in two streams as data, and the usual ones.

:mod:`.hypotheses` finds the hypothesis under which two streams agree.
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

# A hypothesis holds (the streams agree under it) below this unexplained share.
HOLDS = 0.12
# A scale whose logarithm is farther from 0 than this counts as one more mistake.
_ODD_SCALE = 0.05
# A shape larger than this, or smaller than its negative, decides if the noise does not decide.
CLEAR_SHAPE = 0.4

# Codes of the mistakes of one stream.
_Codes: TypeAlias = tuple[str, ...]
EULER_ORDER: _Codes = ("euler_order",)


@dataclass(frozen=True)
class Hypothesis:
    """Mistakes of each stream.

    Attributes
    ----------
    parent, child : tuple of str
        Mistakes of each stream, as codes of findings.
    axes : (3, 3) array or None
        Matrix that corrects positions in wrong axes: corrected = axes @ position.
    detail : str
        Axes that (x, y, z) of the positions should be, such as "y -x z".
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
        """Key that sorts hypotheses, the simplest first.

        The first number is that of the mistakes; each wrong axis is one more. The second number
        sorts equal numbers of mistakes: mistakes of the child come first.
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
        """Return the other reading: the hypothesis under which both streams are also inverted.

        It fits equally well.
        """
        return Hypothesis(
            _toggle_inverse(self.parent), _toggle_inverse(self.child)
        )


def _toggle_inverse(codes: _Codes) -> _Codes:
    """Return the mistakes of one stream with "inverse" added, or removed if it is among them."""
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
        Evidence of the shape of the motion for the second hypothesis: the sum of the log ratios of
        paths and lever arms. A negative shape is evidence for the first hypothesis.
    paths : float
        Log ratio of the paths alone.
    is_small : bool
        Whether all sensors stay within the reach of an arm. The data of an arm beside a fixed
        camera look like inverse poses although they are right.
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
        """Whether the shape decides between the hypotheses.

        It does not if a fixed camera beside an arm is another cause of that shape.
        """
        is_fixed_camera = (
            self.is_small
            and self.hypotheses[0].is_uninverted
            and self.shape > 0.0
        )
        return self.by_shape != 0 and not is_fixed_camera

    def ordered(self) -> "Readings":
        """Return the readings with the hypothesis first that inverts neither stream."""
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
        Both readings, as poses and as inverse poses, if the other reading may be right.
    """

    hypothesis: Hypothesis
    fit: SimilarityFit
    findings: tuple[Finding, ...] = ()
    limit: float = HOLDS
    same_unit: bool = False
    readings: Readings | None = None

    @property
    def may_be_uninverted(self) -> bool:
        """Whether both readings are possible, and in the first one both streams contain poses."""
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
        """Key that sorts explanations, the simplest first. An odd scale is one more mistake."""
        n_mistakes, of_streams = self.hypothesis.complexity
        has_odd_scale = abs(np.log(self.fit.scale)) > _ODD_SCALE
        return n_mistakes + int(has_odd_scale), of_streams


_MIRROR = -np.eye(3)
# Mistakes of one stream in the convention of its poses. Inverted orientations whose quaternions are
# in the order w x y z are missing: they equal orientations in other axes.
CODES_OF_STREAM: list[_Codes] = [
    (),
    ("inverse",),
    ("inverse_orientation",),
    ("quaternion_order",),
    ("quaternion_order", "inverse"),
    ("quaternion_names",),
]
# All combinations for both streams.
CONVENTIONAL = list(
    itertools.starmap(Hypothesis, itertools.product(CODES_OF_STREAM, repeat=2))
)
# The hypothesis without a mistake.
PLAIN = CONVENTIONAL[0]


# Usual mistakes. Hypotheses with both streams inverted are missing: they fit as well as those
# with neither stream inverted.
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

    The mirror of all three axes is missing, because it is the mistake "left_handed". On flat ground
    some of these hypotheses fit as well as that of inverted orientations.
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
