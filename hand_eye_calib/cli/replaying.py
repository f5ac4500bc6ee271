"""A bag's poses, fed to the engine in the order they were recorded."""

import dataclasses
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import chain, islice, pairwise

import numpy as np

from hand_eye_calib.calibration import Calibration
from hand_eye_calib.cli.console import note, waiting_for, with_progress
from hand_eye_calib.cli.present import convergence_line
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.errors import InputError, NotEnoughDataError

_NS_PER_S = 1_000_000_000


@dataclass
class Replayed:
    """What came out of a bag.

    Attributes
    ----------
    calibration : Calibration
    inputs : dict
        Where the data came from, in plain values.
    files : list of pathlib.Path
        The files that were read.
    convergence : list of dict
        Estimates on the way, in plain values.
    calibrator : Calibrator
        The engine, with all poses.
    """

    calibration: Calibration
    inputs: dict
    files: list
    convergence: list = field(default_factory=list)
    calibrator: Calibrator | None = None


def replay(paths, parent, child, config, every_s=None, quiet=False):
    """Calibrate from one bag, or from several of one drive.

    Parameters
    ----------
    paths : list of path-like
    parent, child : str, TfSource or None
        Topic or pair of frames; chosen where the bag leaves no choice.
    config : CalibratorConfig
    every_s : float, optional
        Bag time between estimates on the way.
    quiet : bool
        Say nothing on stderr; what there is to say of the data is among the calibration's warnings
        anyway.

    Returns
    -------
    Replayed

    Raises
    ------
    HandEyeCalibError
        Where bag or poses cannot be used, or there are too few.
    """
    from hand_eye_calib.io.bags import PoseBag

    say, shown, waited_for = _silence if quiet else (note, with_progress, waiting_for)
    calibrator = Calibrator(config)
    with PoseBag(*paths) as bag:
        sources = dict(zip(("parent", "child"), bag.select_topics(parent, child), strict=True))
        if not (parent and child):
            say(
                f"parent is {sources['parent']}, child is {sources['child']}; --parent-topic and --child-topic say otherwise"
            )
        blocks = bag.blocks(*sources.values(), config.max_gap)
        with waited_for(f"opening {bag}"):
            blocks = _started(blocks)
        expected = bag.expected(*sources.values())
        convergence = Convergence(calibrator, every_s) if every_s else None
        found = feed(
            calibrator, shown(blocks, expected, f"reading {bag}", len), sources, convergence
        )
        found += bag.n_left_out
        warnings = bag.warnings
        files = bag.files()
    if expected is not None and found != expected:
        warnings.append(
            f"{bag} says it has {expected} messages on these topics, but {found} could be read; it may be damaged"
        )
    for text in warnings:
        say(text)
    with waited_for("solving"):
        calibration = calibrator.estimate()
    calibration = dataclasses.replace(calibration, warnings=(*calibration.warnings, *warnings))
    inputs = {"bag": str(bag), "options": calibrator.config.to_options()}
    inputs |= {
        stream: {"topic": str(source), **_counts(calibrator.statistics(stream))}
        for stream, source in sources.items()
    }
    return Replayed(
        calibration, inputs, files, convergence.history if convergence else [], calibrator
    )


def feed(calibrator, blocks, topics, convergence=None):
    """Give every pose to the engine.

    Parameters
    ----------
    calibrator : Calibrator
    blocks : iterable of PoseBlock
    topics : mapping
        "parent" and "child" to the names of their topics, for messages.
    convergence : Convergence, optional
        Told of every pose's bag time.

    Returns
    -------
    int
        How many there were.

    Raises
    ------
    InputError
        At the first message that cannot be used, naming topic, message and stamp.
    """
    count, frames = 0, {(stream, None) for stream in topics}
    for block in blocks:
        count += len(block)
        new_frames = {}
        for row, pair in enumerate(
            zip(block.streams.tolist(), block.sensor_frames.tolist(), strict=True)
        ):
            if pair not in frames:
                new_frames.setdefault(pair, row)
        cuts = {
            0,
            len(block),
            *new_frames.values(),
            *(convergence.cuts(block.bag_ns) if convergence else ()),
        }
        for first, last in pairwise(sorted(cuts)):
            part = block[first:last]
            if convergence is not None:
                convergence.reached(int(part.bag_ns[0]))
            try:
                if (pair := (part.streams[0], part.sensor_frames[0])) not in frames:
                    calibrator.set_frame(*pair)
                    frames.add(pair)
                calibrator.add_poses(
                    part.streams, part.stamps_ns, part.poses[:, :3], part.poses[:, 3:]
                )
            except InputError as error:
                row = getattr(error, "index", 0)
                seconds, nanoseconds = divmod(int(part.stamps_ns[row]), _NS_PER_S)
                raise InputError(
                    f"{topics[part.streams[row]]}, message {part.numbers[row]}, stamp {seconds}.{nanoseconds:09d}: {error}"
                ) from error
    return count


class Convergence:
    """Estimates on the way, every so much bag time.

    Parameters
    ----------
    calibrator : Calibrator
    every_s : float

    Attributes
    ----------
    history : list of dict
        Bag time in seconds since the first message, and the calibration in plain values, or why
        there was none.
    """

    def __init__(self, calibrator, every_s):
        self.history = []
        self._calibrator, self._every_ns = calibrator, round(every_s * _NS_PER_S)
        self._first_ns = self._next_ns = None

    def cuts(self, bag_ns):
        """Where in an array of bag times another period may begin."""
        first_ns = bag_ns[0] if self._first_ns is None else self._first_ns
        return (np.flatnonzero(np.diff((bag_ns - first_ns) // self._every_ns)) + 1).tolist()

    def reached(self, bag_ns):
        """Estimate where another period has passed; call it before the message of that time is
        added.
        """
        if self._first_ns is None:
            self._first_ns, self._next_ns = bag_ns, bag_ns + self._every_ns
        if bag_ns < self._next_ns:
            return
        periods = (bag_ns - self._first_ns) // self._every_ns
        self._next_ns = self._first_ns + (periods + 1) * self._every_ns
        self.history.append({"bag_time_s": periods * self._every_ns / _NS_PER_S} | self._estimate())
        note(convergence_line(self.history[-1]))

    def _estimate(self):
        try:
            return {"calibration": self._calibrator.estimate().to_dict()}
        except NotEnoughDataError as error:
            return {"calibration": None, "reason": str(error)}


def fingerprints(files, quiet=False):
    """Name, size and SHA-256 of the files that were read."""
    from hand_eye_calib.io.results import fingerprint

    return [
        fingerprint(file)
        for file in (files if quiet else with_progress(files, len(files), "hashing"))
    ]


def _started(blocks):
    """The same, after what a bag has to do before the first of them."""
    return chain(list(islice(blocks, 1)), blocks)


# In place of note, with_progress and waiting_for.
_silence = (lambda text: None, lambda items, *_: items, lambda what: nullcontext())


def _counts(statistics):
    return {
        "messages": statistics.received,
        "refused_duplicate": statistics.refused_duplicate,
        "refused_late": statistics.refused_late,
        "first_stamp_ns": statistics.first_stamp_ns,
        "last_stamp_ns": statistics.last_stamp_ns,
    }
