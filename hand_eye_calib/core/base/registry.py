"""Tables that layers above fill, so that no layer imports one above it.

Each layer and each extra has a function ``register()`` in its ``__init__.py``; the package calls
all of them once, when it is imported. A registered function imports its module when it is called,
so that importing the package takes no time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from hand_eye_calib.core.base.errors import ConfigError

Entry = TypeVar("Entry")


class Registry(dict[str, Entry]):
    """Entries by name.

    Parameters
    ----------
    what : str
        What an entry is, for messages.

    Raises
    ------
    ConfigError
        If a name is looked up that no layer has registered.
    """

    def __init__(self, what: str) -> None:
        super().__init__()
        self.what = what

    def __missing__(self, name: str) -> Entry:
        names = ", ".join(self) or "none"
        raise ConfigError(f"unknown {self.what} {name!r}; this installation has: {names}")


class Command(NamedTuple):
    """A command of the command line.

    Attributes
    ----------
    help : str
        One line for the list of commands.
    load : callable
        Return the module of the command, with ``add_arguments(parser)`` and
        ``run(arguments) -> int``.
    """

    help: str
    load: Callable[[], Any]


class Route(NamedTuple):
    """A way of ``calibrate`` for other data than two streams.

    Attributes
    ----------
    add_arguments : callable
        Declare the arguments of the route on a parser.
    takes : callable
        Return whether parsed arguments ask for the route.
    run : callable
        Calibrate; called with the arguments and what puts URLs back into plain values. Return the
        exit code.
    """

    add_arguments: Callable[[Any], None]
    takes: Callable[[Any], bool]
    run: Callable[[Any, Callable[[Any], Any]], int]


class Measure(NamedTuple):
    """What a stream may measure.

    Attributes
    ----------
    kind : str
        Name in ``KINDS`` of the kind of data that the stream makes together with poses.
    needs_poses : str
        Why the other stream must be of poses; empty if it need not be.
    """

    kind: str
    needs_poses: str = ""


class ExtraRule(NamedTuple):
    """A rule of the verdict that an extra adds, see ``core/results/verdict.py``.

    Attributes
    ----------
    after : str
        Name of the rule that it follows.
    forbids : bool
        Whether its reasons lead to DO NOT USE, rather than to USE WITH CARE.
    when : str
        The condition in words.
    find : callable
        Yield the grounds against a result, ``Ground`` of that module.
    """

    after: str
    forbids: bool
    when: str
    find: Callable[[Any], Any]


#: Rules of the verdict that extras add, by their names.
EXTRA_RULES: Registry[ExtraRule] = Registry("rule")

#: Parts of results that layers above the core add: functions that return a ``Part``.
RESULT_PARTS: Registry[Callable[[], Any]] = Registry("part of a result")

#: Modules of the public names of the extras.
PUBLIC_NAMES: Registry[str] = Registry("public name")

#: Commands of the command line, in the order of its help.
COMMANDS: Registry[Command] = Registry("command")

#: Ways of ``calibrate`` for other data than two streams; the first that takes the arguments counts.
ROUTES: Registry[Route] = Registry("way to calibrate")

#: How several recordings of one rig become one result. Called with the arguments and the bags of
#: each recording; returns the exit code.
SEVERAL_RECORDINGS: Registry[Callable[..., int]] = Registry("way to join recordings")

#: Monitors of the mount. Called with the session, what is installed, why that is unknown, and the
#: log.
MOUNT_MONITORS: Registry[Callable[..., Any]] = Registry("monitor of the mount")

#: Methods of a result that take a layer above the core: save, plot, report, export.
RESULT_METHODS: Registry[Callable[..., Any]] = Registry("method of a result")

#: Writers of the pages of a session of the node. Called with the output directory and the session's
#: result.
SESSION_PAGES: Registry[Callable[..., None]] = Registry("page of a session")

#: Readers of messages that are no poses, by their type, or "images of a target". Called with the
#: bag, the stream, the topic and what the source names behind it.
BAG_READINGS: Registry[Callable[..., Any]] = Registry("kind of messages")

#: Modules that find targets in images of a folder: functions that return one.
TARGET_IMAGES: Registry[Callable[[], Any]] = Registry("reader of images of a target")

#: Readers of trajectory files of other programs. Called with the path, the bytes, and the options;
#: return None for a file of another format.
FILE_READERS: Registry[Callable[..., Any]] = Registry("reader of files")

#: What a stream may measure: the values of the options ``parent_measures`` and ``child_measures``.
MEASURES: Registry[Measure] = Registry("measure")

#: Axes that a kind of data has no information about, by the name of the kind; missing for none.
OUT_OF_REACH: Registry[tuple[str, ...]] = Registry("kind of streams")

#: Functions that return a kind of data (:class:`hand_eye_calib.core.engine.kinds.Kind`), by what
#: both sensors measure together.
KINDS: Registry[Callable[[], Any]] = Registry("kind of streams")

#: Sentences of findings: functions that return
#: :class:`hand_eye_calib.core.checks.words.FindingWords` by the key of the finding.
FINDING_WORDS: Registry[Callable[[], Any]] = Registry("sentences of findings")
