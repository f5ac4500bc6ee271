"""Tables that higher layers fill, so that no layer imports a higher one.

Each layer and each extra has a function ``register()`` in its ``__init__.py``. The package calls
these functions once, when it is imported. A registered function imports its module only when it is
called, so the import of the package takes little time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from hand_eye_calib.core.base.errors import ConfigError

Entry = TypeVar("Entry")


class Registry(dict[str, Entry]):
    """Dictionary of registered entries by name.

    Parameters
    ----------
    noun : str
        Noun for an entry in messages, such as "command".

    Raises
    ------
    ConfigError
        If a name is not registered.
    """

    def __init__(self, noun: str) -> None:
        super().__init__()
        self._noun = noun

    def __missing__(self, name: str) -> Entry:
        names = ", ".join(self) or "none"
        raise ConfigError(
            f"unknown {self._noun} {name!r}; this installation has: {names}"
        )


class Command(NamedTuple):
    """Command of the command line.

    Attributes
    ----------
    help : str
        Help text of one line, for the list of commands.
    load : callable
        ``load()`` returns the module of the command. The module has the functions
        ``add_arguments(parser)`` and ``run(arguments) -> int``.
    """

    help: str
    load: Callable[[], Any]


class Route(NamedTuple):
    """Extension of the command ``calibrate`` for data other than two streams.

    Attributes
    ----------
    add_arguments : callable
        ``add_arguments(parser)`` declares the arguments of the route.
    takes : callable
        ``takes(arguments)`` returns whether the route applies to parsed arguments.
    run : callable
        Function ``run(arguments, restore_urls)`` that calibrates and returns the exit code.
        ``restore_urls`` replaces the paths of downloaded files by their URLs in plain values.
    """

    add_arguments: Callable[[Any], None]
    takes: Callable[[Any], bool]
    run: Callable[[Any, Callable[[Any], Any]], int]


class BesideMotion(NamedTuple):
    """Source of measurements of the extrinsic that do not come from motion, for bags.

    Attributes
    ----------
    add_arguments : callable
        ``add_arguments(parser)`` declares the argument whose name is the name of the source.
    find : callable
        ``find(paths, snapshot)`` returns measurements for ``Snapshot.beside_motion``, and notes for
        the user.
    topics : callable
        ``topics(bag)`` returns, for each topic of a bag that the source can read, the measured
        quantity and the frame of the sensor.
    """

    add_arguments: Callable[[Any], None]
    find: Callable[[Any, Any], tuple[tuple[Any, ...], list[str]]]
    topics: Callable[[Any], dict[str, tuple[str, str]]]


class ResultFile(NamedTuple):
    """File that ``calibrate`` writes on request, in addition to ``--out``.

    Attributes
    ----------
    add_arguments : callable
        ``add_arguments(parser)`` declares the argument with the path, which has the name of the
        entry.
    write : callable
        ``write(path, calibration, snapshot)`` writes the file.
    """

    add_arguments: Callable[[Any], None]
    write: Callable[[Any, Any, Any], None]


class Measure(NamedTuple):
    """Quantity that a stream may measure.

    Attributes
    ----------
    kind : str
        Kind of data of this stream together with a stream of poses, as a name in ``KINDS``.
    needs_poses : str
        Reason why the other stream must measure poses; empty if it may measure the same quantity.
    read_as : str
        Quantity that is read from messages, if it differs from the measured quantity; otherwise
        empty.
    is_parent : bool
        Whether only the parent may measure this quantity.
    """

    kind: str
    needs_poses: str = ""
    read_as: str = ""
    is_parent: bool = False


class ExtraRule(NamedTuple):
    """Rule of the verdict that an extra adds, see ``core/results/rules.py``.

    Attributes
    ----------
    after : str
        Name of the preceding rule in the table of rules.
    forbids : bool
        Whether the reasons of the rule lead to DO NOT USE; otherwise to USE WITH CARE.
    when : str
        Condition in words, for the documentation.
    find : callable
        ``find(result)`` yields the grounds (``Ground`` of that module) against a result.
    """

    after: str
    forbids: bool
    when: str
    find: Callable[[Any], Any]


#: Rules of the verdict that extras add, by their names.
EXTRA_RULES: Registry[ExtraRule] = Registry("rule")

#: Parts of results that layers above the core add: functions that return a ``Part``.
RESULT_PARTS: Registry[Callable[[], Any]] = Registry("part of a result")

#: Functions ``examine(result, snapshot)`` that return the result of a solve with a further part.
RESULT_EXAMINATIONS: Registry[Callable[[Any, Any], Any]] = Registry(
    "examination of results"
)

#: Modules of the public names of the extras.
PUBLIC_NAMES: Registry[str] = Registry("public name")

#: Commands of the command line, in the order of its help.
COMMANDS: Registry[Command] = Registry("command")

#: Routes of ``calibrate`` for other data than two streams. The first route that takes the arguments
#: is run.
ROUTES: Registry[Route] = Registry("way to calibrate")

#: Sources of measurements of the extrinsic that do not come from motion.
BESIDE_MOTION: Registry[BesideMotion] = Registry(
    "source of measurements beside motion"
)

#: Functions ``run(arguments, bags_of_recordings)`` that combine several recordings of a rig in one
#: result. They return the exit code.
SEVERAL_RECORDINGS: Registry[Callable[..., int]] = Registry(
    "way to join recordings"
)

#: Functions ``start(session, installed, reason, log)`` that monitor the mount. ``installed`` is the
#: installed transform; if it is unknown, ``reason`` explains this.
MOUNT_MONITORS: Registry[Callable[..., Any]] = Registry("monitor of the mount")

#: Functions ``compare(arguments)`` of the command ``compare`` for files other than results. They
#: return the exit code, or None for files that they do not accept.
COMPARISONS: Registry[Callable[[Any], int | None]] = Registry("comparison")

#: Methods of a result that need a layer above the core: save, plot, report, export.
RESULT_METHODS: Registry[Callable[..., Any]] = Registry("method of a result")

#: Functions ``write(output_directory, session_result)`` that write pages of a session of the node.
SESSION_PAGES: Registry[Callable[..., None]] = Registry("page of a session")

#: Functions ``read(bag, stream, topic, rest)`` that read messages without poses. The key is the
#: message type, or "images of a target". ``rest`` is the text after the topic in the name of the
#: source.
BAG_READINGS: Registry[Callable[..., Any]] = Registry("kind of messages")

#: Functions ``read(topic, measures)`` that return the reader of a live topic whose messages are
#: integrated to poses. The key is the message type. The reader converts the bytes of a message to
#: ``PoseFields``.
LIVE_READINGS: Registry[Callable[[str, str], Any]] = Registry(
    "kind of live messages"
)

#: Functions that return a module for images of a target. "folder" detects targets in the images of
#: a folder, and "corners" draws the corners of the target on the images.
TARGET_IMAGES: Registry[Callable[[], Any]] = Registry(
    "reader of images of a target"
)

#: Functions ``draw(calibration, snapshot, suffix)`` that return further figures of the report: a
#: list of ``Drawn`` of ``offline/report/style.py``. The names of the figures end in ``suffix``.
REPORT_PICTURES: Registry[Callable[[Any, Any, str], Any]] = Registry(
    "picture of the report"
)

#: Files that ``calibrate`` writes for two streams, by the name of their argument.
RESULT_FILES: Registry[ResultFile] = Registry("file of a result")

#: Functions ``read(path, content, options)`` that read trajectory files of other programs. They
#: return None for a file that they do not accept.
FILE_READERS: Registry[Callable[..., Any]] = Registry("reader of files")

#: Quantities that a stream may measure: values of the options ``parent_measures`` and
#: ``child_measures``.
MEASURES: Registry[Measure] = Registry("measure")

#: Axes that a kind of data can never determine, by the name of the kind. Kinds that can determine
#: all axes are left out.
OUT_OF_REACH: Registry[tuple[str, ...]] = Registry("kind of streams")

#: Functions that return a kind of data (:class:`hand_eye_calib.core.engine.kinds.Kind`), by the
#: name of the kind.
KINDS: Registry[Callable[[], Any]] = Registry("kind of streams")

#: Kinds of data that obey an option which other kinds ignore, by the field name of the option. The
#: default value of such an option means unknown.
KINDS_OF_OPTIONS: Registry[str] = Registry("option of one kind of streams")

#: Functions that return the sentences of findings
#: (:class:`hand_eye_calib.core.checks.words.FindingWords`) by the key of the finding.
FINDING_WORDS: Registry[Callable[[], Any]] = Registry("sentences of findings")
