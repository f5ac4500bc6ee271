"""Draw a view on a terminal, or as lines for a file or a pipe."""

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from hand_eye_calib.online.watch.view import KEYS, Line, Tone, View

_STYLES = {
    Tone.GOOD: "bold green",
    Tone.BUSY: "bold cyan",
    Tone.ACT: "bold yellow",
    Tone.BAD: "bold red",
    Tone.UNKNOWN: "bold magenta",
}

# Length of a progress bar, in columns.
_BAR_LENGTH = 16

# Smallest width of a terminal (characters). A narrower one does not display the texts after the
# bars.
_MIN_WIDTH = 76

# Largest number of reasons that are displayed.
_MAX_REASONS = 3

# Labels of requests, if they differ from their names.
_LABELS = {"forget": "remove typed values"}


def screen(view: View, width: int, footer: str = "") -> RenderableType:
    """Return the view for a terminal, with the most important content first.

    Parameters
    ----------
    view : View
    width : int
        Width of the terminal (columns).
    footer : str
        Text after the keys, such as the address of the page.
    """
    word = f" {view.tone.value} {view.word} "
    rows: list[RenderableType] = [
        Text.assemble((word, f"reverse {_STYLES[view.tone]}")),
        Text(view.text, style="bold"),
    ]
    if view.facts:
        rows.append(_dim(view.facts))
    if view.answer:
        rows.append(_lines(view.answer))
    rows += [Text(f"    {topic}") for topic in view.topics]
    if view.bars:
        rows += [_bars(view, width), _dim(view.title), _pose(view)]
    if view.watched:
        rows += [
            _dim("the mount, and what ten minutes of motion detect"),
            _lines(view.watched),
        ]
    rows.append(_lines(view.result + view.health))
    rows += [_dim(f"    - {reason}") for reason in view.reasons[:_MAX_REASONS]]
    keys = [
        f"{KEYS[name]} {_LABELS.get(name, name)}   " for name in view.buttons
    ]
    title = Text(f"hand_eye_calib watch {view.node}".rstrip())
    panel = Panel(Group(*rows), title=title, title_align="left")
    return Group(_dim(f" {''.join(keys)}q quit   {footer}".rstrip()), panel)


def lines(view: View) -> list[str]:
    """Return the headline and the answer to the last button as lines, for a file or a pipe."""
    answers = [
        f"{line.tone.value} {line.name}: {line.text}" for line in view.answer
    ]
    return [f"{view.tone.value} {view.word}: {view.text}", *answers]


def _dim(text: str) -> Text:
    return Text(text, style="dim")


def _pose(view: View) -> Table:
    """Return a table of the pose with two rows: x, y, z and roll, pitch, yaw."""
    table = Table.grid(padding=(0, 3))
    values = [
        Text.assemble((axis, "bold"), f" {text}") for axis, text in view.values
    ]
    table.add_row(*values[:3])
    table.add_row(*values[3:])
    return table


def _bars(view: View, width: int) -> Table:
    """Return a table with a row per axis. The last column needs a wide terminal."""
    table = Table.grid(padding=(0, 1))
    for bar in view.bars:
        style = _STYLES[bar.tone]
        cells: list[RenderableType] = [
            Text(bar.name, style="bold"),
            ProgressBar(
                1.0,
                bar.share,
                _BAR_LENGTH,
                complete_style=style,
                finished_style=style,
            ),
            Text(f"{bar.tone.value} {bar.word}", style=style),
            Text(bar.sigma),
        ]
        if width >= _MIN_WIDTH:
            cells.append(Text(bar.difference or bar.meaning))
        table.add_row(*cells)
    return table


def _lines(lines: tuple[Line, ...]) -> Table:
    table = Table.grid(padding=(0, 1))
    for line in lines:
        sign = Text(line.tone.value, style=_STYLES[line.tone])
        table.add_row(sign, Text(line.name), Text(line.text))
    return table
