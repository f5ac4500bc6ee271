"""The live session: the engines that collect the poses, and the journal on disk."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import fields, replace
from pathlib import Path

from hand_eye_calib.core.base.config import (
    CalibratorConfig,
    NodeConfig,
    defaults_of,
)
from hand_eye_calib.core.base.errors import ConfigError, HandEyeCalibError
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.engine.calibrator import (
    BufferLimits,
    Calibrator,
    Calibrators,
)
from hand_eye_calib.core.engine.snapshot import STREAMS
from hand_eye_calib.formats.geodetic import LocalOrigin
from hand_eye_calib.formats.journal import (
    Journal,
    has_session,
    read_journal,
    replay_journal,
)
from hand_eye_calib.online.live.journal import SessionJournal
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.state import GRACE_S, JournalState, Level


class LiveSession:
    """Engines that collect the poses of a session, and the journal that stores them on disk.

    Parameters
    ----------
    log : NodeLog
    config : CalibratorConfig
    others : sequence of str
        Further child sensors, by the names of their inputs.

    Attributes
    ----------
    engines : dict of str to Calibrator
        Engine of each child sensor with the parent: "child", and the further child sensors.
    number : int
        Number of the session. It increases with every new session, so that the solve of another
        session is recognised as out of date.
    topics : dict of str to str
        Topic of each stream, for the journal.
    journal : SessionJournal or None
        None if no journal is written.
    """

    def __init__(
        self, log: NodeLog, config: CalibratorConfig, others: Sequence[str] = ()
    ) -> None:
        self.engines = Calibrators(child=Calibrator(config))
        self.engines |= {
            name: Calibrator(_for_other_child(config)) for name in others
        }
        self.number = 0
        self.topics: dict[str, str] = {}
        self.journal: SessionJournal | None = None
        self._log = log
        # False for the monitor of the mount, which uses the pairs without a solve.
        self._is_solved = True
        # Number of poses of the last solve.
        self._n_solved = 0
        # Options parent_measures and child_measures that follow from the message types.
        self._measures: Document = {}
        # Local origins of the streams with latitudes and longitudes.
        self._origins: dict[str, LocalOrigin] = {}

    @property
    def calibrator(self) -> Calibrator:
        """The engine of parent and child."""
        return self.engines["child"]

    @property
    def has_new_poses(self) -> bool:
        """Whether there are poses or options that were not part of a solve."""
        return self._is_solved and self._n_poses() > self._n_solved

    def copy_to_solve(self) -> Calibrator:
        """Return a copy of the engine, and count its poses as solved."""
        self._n_solved = self._n_poses()
        return deepcopy(self.calibrator)

    def watch_only(self, limits: BufferLimits | None) -> None:
        """Switch solves off, and store few poses only. The caller takes the pairs at once.

        Parameters
        ----------
        limits : BufferLimits or None
            Limits of the buffers. None switches solves on again.
        """
        self._is_solved = limits is None
        engine = Calibrator(self.calibrator.config, limits or BufferLimits())
        self.engines = Calibrators(child=engine)
        self._n_solved = 0

    def set_measures(self, stream: str, measures: str) -> None:
        """Set the measured quantity of a stream, according to its message type.

        Parameters
        ----------
        stream : str
        measures : str
            One of ``registry.MEASURES``, such as "poses" or "positions".

        Raises
        ------
        ConfigError
            If the session cannot use such a stream, alone or with the other stream.
        """
        is_pair = stream in STREAMS
        if measures != "poses" and not (is_pair and self._is_solved):
            raise ConfigError(
                f"a rig and the monitor need poses; {stream} has {measures}"
            )
        name = f"{stream}_measures"
        if not is_pair or self._measures.get(name, "poses") == measures:
            return
        options = {**self._measures, name: measures}
        # Raises an error for an impossible combination.
        _ = replace(self.calibrator.config, **options).measured
        self._measures = options
        self.reconfigure(self.calibrator.config)

    def origin(self, stream: str) -> LocalOrigin:
        """Return the local origin of a stream's latitudes and longitudes.

        A resumed session has the origin in its journal. Otherwise the first position is the origin.
        """
        return self._origins.setdefault(stream, LocalOrigin())

    def reconfigure(self, config: CalibratorConfig) -> None:
        """Apply changed options. The poses stay, and will be solved again."""
        for name, engine in self.engines.items():
            if name != "child":
                engine.reconfigure(_for_other_child(config))
        self.calibrator.reconfigure(replace(config, **self._measures))
        self._n_solved = 0

    def reset(self) -> None:
        """Drop all poses and begin a new session. The journal of the old session is kept aside."""
        for engine in self.engines.values():
            engine.reset()
        self.number += 1
        self._n_solved = 0
        if self.journal is not None:
            self.journal.begin()

    def _n_poses(self) -> int:
        return sum(
            self.calibrator.statistics(stream).received for stream in STREAMS
        )

    # -------------------------------------------------------------- journal

    def start_journal(
        self, options: NodeConfig, is_first: bool = False
    ) -> None:
        """Write a journal from now on, unless the options switch it off.

        Parameters
        ----------
        options : NodeConfig
        is_first : bool
            Whether the node has just started, so that it may resume the session on disk.

        Raises
        ------
        ConfigError
            If no directory is set to resume from, or another node writes there.
        """
        self.stop_journal()
        is_resuming = is_first and options.journal == "resume"
        if is_resuming and not options.output_directory:
            raise ConfigError(
                "journal resume needs output_directory: set the session's directory"
            )
        if (
            options.output_directory
            and options.journal != "off"
            and not options.monitor
        ):
            directory = (
                output_path(options.output_directory).resolve() / "journal"
            )
            resumed = self._resume(directory) if is_resuming else None
            self.journal = SessionJournal(
                directory, self._about, self._log, resumed
            )

    def flush_journal(self) -> None:
        """Write new poses to the disk. Call this method often."""
        if self.journal is not None:
            self.journal.flush()

    def stop_journal(self) -> None:
        """Write the last poses, and unlock the directory."""
        if self.journal is not None:
            self.journal.stop(GRACE_S)
            self.journal = None

    def journal_state(self, options: NodeConfig) -> JournalState:
        """Return the diagnostics of the journal."""
        journal = self.journal
        level = Level.OK
        text = "the session is being written"
        if journal is not None and journal.error:
            level = Level.ERROR
            text = (
                f"cannot write the journal: {journal.error}; "
                "save the result: a crash would lose the session"
            )
        elif journal is None and options.journal == "off":
            text = "off"
        elif journal is None:
            level = Level.WARN
            text = "off: output_directory was empty at the start"
        directory = str(journal.directory) if journal else ""
        return JournalState(level=level, text=text, directory=directory)

    def _resume(self, directory: Path) -> Journal | None:
        """Fill the engines from the session in a directory, and return its journal.

        Returns None if there is no session, or if the journal cannot be read.
        """
        if not has_session(directory):
            self._log.info(
                f"no session to resume in {directory}: a new session begins"
            )
            return None
        try:
            journal = read_journal(directory)
            replay_journal(journal, directory, self.engines)
        except HandEyeCalibError as error:
            self._log.error(f"cannot resume: {error}; a new session begins")
            for engine in self.engines.values():
                engine.reset()
            return None
        for stream, about in journal.about.items():
            if "origin" in about:
                self.origin(stream).geodetic = tuple(about["origin"])
        self._log.info(
            f"session resumed from {directory}: {self._n_poses()} poses"
        )
        return journal

    def _about(self) -> dict[str, Document]:
        """Return topic, options, frames and origin (rad, rad, m) of each stream."""
        config = self.calibrator.config
        options = config.to_options()
        about: dict[str, Document] = {}
        for stream in ("parent", *self.engines):
            own_stream, engine = self.engines.takers(stream)[0]
            origin = self._origins.get(stream, LocalOrigin()).geodetic
            about[stream] = {
                "topic": self.topics.get(stream, ""),
                "options": options,
                "given": sorted(config.given),
            }
            if frame := engine.frame(own_stream):
                about[stream]["frame"] = frame
            if world := engine.world(own_stream):
                about[stream]["world"] = world
            if origin:
                about[stream]["origin"] = [*origin]
        return about


def _for_other_child(config: CalibratorConfig) -> CalibratorConfig:
    """Return the options for a further child sensor, without the values for the first child."""
    names = {
        item.name
        for item in fields(config)
        if item.name.startswith(("prior_", "child_"))
    }
    for name in ("time_offset", "scale"):
        # A number belongs to the first child; a text such as "estimate" applies to all children.
        if not isinstance(getattr(config, name), str):
            names.add(name)
    return replace(config, given=config.given - names, **defaults_of(names))


def output_path(directory: str, base: Path | None = None) -> Path:
    """Return the path of an output directory, with ``~`` expanded.

    Raises
    ------
    ConfigError
        If the user of ``~`` is unknown, or if the path is neither ``base`` nor below it. Any
        program may set parameters of the running node, so the node writes to ``base`` only.
    """
    try:
        path = Path(directory).expanduser()
    except RuntimeError as error:
        text = (
            f"output_directory {directory!r}: {error}; write the absolute path"
        )
        raise ConfigError(text) from None
    if base is not None and not path.resolve().is_relative_to(base):
        raise ConfigError(
            f"output_directory must be {base} or below it while the node "
            f"runs; got {path}: start the node with the other directory"
        )
    return path
