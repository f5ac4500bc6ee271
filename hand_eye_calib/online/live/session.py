"""The live session: its engines, its number, and its journal on disk."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import fields, replace
from pathlib import Path

from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig, defaults_of
from hand_eye_calib.core.base.errors import ConfigError, HandEyeCalibError
from hand_eye_calib.core.base.plain import Document
from hand_eye_calib.core.engine.calibrator import BufferLimits, Calibrator, Calibrators
from hand_eye_calib.core.engine.snapshot import STREAMS
from hand_eye_calib.formats.geodetic import LocalOrigin
from hand_eye_calib.formats.journal import Journal, has_session, read_journal, replay_journal
from hand_eye_calib.online.live.journal import SessionJournal
from hand_eye_calib.online.live.log import NodeLog
from hand_eye_calib.online.live.state import GRACE_S, JournalState, Level


class LiveSession:
    """The engines that take the poses, and the journal that keeps them on disk, if there is one.

    Parameters
    ----------
    log : NodeLog
    config : CalibratorConfig
    others : sequence of str
        Further child sensors, by the names of their inputs.

    Attributes
    ----------
    engines : dict of str to Calibrator
        By child sensor: that of "child", and those of further ones, each with the parent.
    number : int
        Rises with every new session; a result of another number is out of date.
    topics : dict of str to str
        Where the poses of each stream come from, for the journal.
    journal : SessionJournal or None
        Takes the poses that the engines have taken.
    """

    def __init__(self, log: NodeLog, config: CalibratorConfig, others: Sequence[str] = ()) -> None:
        self.engines = Calibrators(child=Calibrator(config))
        self.engines |= {name: Calibrator(_of_other(config)) for name in others}
        self.number = 0
        self.topics: dict[str, str] = {}
        self._is_solved = True
        self._n_solved = 0
        self._log = log
        self._measures: Document = {}
        self._origins: dict[str, LocalOrigin] = {}
        self.journal: SessionJournal | None = None

    @property
    def calibrator(self) -> Calibrator:
        """The engine of parent and child."""
        return self.engines["child"]

    @property
    def has_new_poses(self) -> bool:
        """Whether a solve would have something new to go by: poses or options."""
        return self._is_solved and self._n_poses() > self._n_solved

    def copy_to_solve(self) -> Calibrator:
        """The engine as it is now; its poses are no longer new."""
        self._n_solved = self._n_poses()
        return deepcopy(self.calibrator)

    def watch_only(self, limits: BufferLimits | None) -> None:
        """Never solve, and keep few poses: somebody takes the pairs as they are made. With None,
        calibrate again.
        """
        self._is_solved = limits is None
        made = Calibrator(self.calibrator.config, limits or BufferLimits())
        self.engines = Calibrators(child=made)
        self._n_solved = 0

    def set_measures(self, stream: str, measures: str) -> None:
        """Take what a stream measures, as its message type says, one of config.MEASURES.

        Raises
        ------
        ConfigError
            If nothing can be done with that, or with what the other stream measures.
        """
        if measures != "poses" and (stream not in STREAMS or not self._is_solved):
            raise ConfigError(f"a rig and monitor take poses; {stream} has {measures}")
        name = f"{stream}_measures"
        if stream in STREAMS and self._measures.get(name, "poses") != measures:
            measured = self._measures | {name: measures}
            _ = replace(self.calibrator.config, **measured).measured  # or it raises
            self._measures = measured
            self.reconfigure(self.calibrator.config)

    def origin(self, stream: str) -> LocalOrigin:
        """Where the latitudes and longitudes of a stream count from, also after a restart."""
        return self._origins.setdefault(stream, LocalOrigin())

    def reconfigure(self, config: CalibratorConfig) -> None:
        """Put other options in force; the poses stay, and are to be solved again."""
        for name, engine in self.engines.items():
            if name != "child":
                engine.reconfigure(_of_other(config))
        self.calibrator.reconfigure(replace(config, **self._measures))
        self._n_solved = 0

    def reset(self) -> None:
        """Forget everything and begin a new session; the journal of the old one is kept aside."""
        for engine in self.engines.values():
            engine.reset()
        self.number += 1
        self._n_solved = 0
        if self.journal is not None:
            self.journal.begin()

    def _n_poses(self) -> int:
        return sum(self.calibrator.statistics(stream).received for stream in STREAMS)

    # -------------------------------------------------------------- journal

    def start_journal(self, options: NodeConfig, is_first: bool = False) -> None:
        """Write a journal from now on, if the options want one; at the start of the node, when the
        session on disk may go on, and when it goes over to calibrating.

        Raises
        ------
        ConfigError
            If there is no directory to resume from, or another node writes there.
        """
        self.stop_journal()
        is_resuming = is_first and options.journal == "resume"
        if is_resuming and not options.output_directory:
            raise ConfigError(
                "journal resume needs output_directory: that is where the session to resume is"
            )
        if options.output_directory and options.journal != "off" and not options.monitor:
            directory = output_path(options.output_directory).resolve() / "journal"
            resumed = self._resume(directory) if is_resuming else None
            self.journal = SessionJournal(directory, self._about, self._log, resumed)

    def flush_journal(self) -> None:
        """Hand what came in to the disk; to be called often."""
        if self.journal is not None:
            self.journal.flush()

    def stop_journal(self) -> None:
        """Write what is left, and leave the directory to others."""
        if self.journal is not None:
            self.journal.stop(GRACE_S)
            self.journal = None

    def journal_state(self, options: NodeConfig) -> JournalState:
        """Whether a crash would lose the session."""
        journal = self.journal
        level = Level.OK
        text = "the session is being written"
        if journal is not None and journal.error:
            level = Level.ERROR
            text = f"cannot write the journal: {journal.error}; "
            text += "save the result: a crash would lose the session"
        elif journal is None:
            text = "off"
            if options.journal != "off":
                level = Level.WARN
                text = "off: the node began without output_directory"
        directory = str(journal.directory) if journal else ""
        return JournalState(level=level, text=text, directory=directory)

    def _resume(self, directory: Path) -> Journal | None:
        """The session in a directory, which goes on; None if there is none that can."""
        if not has_session(directory):
            self._log.info(f"no session to resume in {directory}: a new one begins")
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
        self._log.info(f"session resumed from {directory}: {self._n_poses()} poses")
        return journal

    def _about(self) -> dict[str, Document]:
        """Options, topics, frames and origins (rad, rad, m), for whoever reads the journal."""
        config = self.calibrator.config
        of_all = {"options": config.to_options(), "given": sorted(config.given)}
        about: dict[str, Document] = {}
        for stream in ("parent", *self.engines):
            own_stream, engine = self.engines.takers(stream)[0]
            origin = self._origins.get(stream, LocalOrigin()).geodetic
            known: Document = {
                "frame": engine.frame(own_stream),
                "world": engine.world(own_stream),
                "origin": [*(origin or ())],
            }
            known = {name: each for name, each in known.items() if each}
            about[stream] = {"topic": self.topics.get(stream, ""), **of_all, **known}
        return about


def _of_other(config: CalibratorConfig) -> CalibratorConfig:
    """The options for a further child sensor: what is set for the child in numbers is not its."""
    of_child = {each.name for each in fields(config) if each.name.startswith(("prior_", "child_"))}
    numbers = ("time_offset", "scale")
    of_child |= {name for name in numbers if not isinstance(getattr(config, name), str)}
    return replace(config, given=config.given - of_child, **defaults_of(of_child))


def output_path(directory: str, base: Path | None = None) -> Path:
    """The path of an output directory, ``~`` expanded. Raises ConfigError for an unknown user, and
    if it is neither ``base`` nor below it: any participant may set it while the node runs, and must
    not write elsewhere.
    """
    try:
        path = Path(directory).expanduser()
    except RuntimeError as error:
        text = f"output_directory {directory!r}: {error}; write the whole path"
        raise ConfigError(text) from None
    if base is not None and not path.resolve().is_relative_to(base):
        raise ConfigError(
            f"output_directory must be {base} or below it while the node runs; got {path}: "
            "start the node with the directory that is wanted"
        )
    return path
