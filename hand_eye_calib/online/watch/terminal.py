"""A view on a terminal: redrawn in place, or as lines where nothing can be redrawn."""

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from hand_eye_calib.online.watch.board import Line, Tone, View

_STYLES = {
    Tone.GOOD: "bold green",
    Tone.BUSY: "bold cyan",
    Tone.ACT: "bold yellow",
    Tone.BAD: "bold red",
    Tone.UNKNOWN: "bold magenta",
}
_BAR_CELLS = 16

# Narrower terminals do without the last column.
_WIDE = 76

# Of a request whose key is not its first letter.
_KEYS = {"save": "w"}
# Requests with another name beside their key.
_LABELS = {"forget": "forget priors"}


def screen(view: View, width: int, footer: str = "") -> RenderableType:
    """The whole view, on a terminal of so many columns; what is most important comes first, if it
    is too low for all. The footer is such as the address of the page.
    """
    head = Text.assemble((f" {view.tone.value} {view.word} ", f"reverse {_STYLES[view.tone]}"))
    parts: list[RenderableType] = [head, Text(view.sentence, style="bold")]
    parts += [Text(view.facts, style="dim")] * bool(view.facts)
    parts += [_lines(view.answer)] * bool(view.answer)
    parts += [Text(f"    {topic}") for topic in view.topics]
    if view.bars:
        values = Table.grid(padding=(0, 3))  # x, y, z above roll, pitch, yaw
        texts = [Text.assemble((axis, "bold"), f" {text}") for axis, text in view.values]
        for row in (texts[:3], texts[3:]):
            values.add_row(*row)
        parts += [_bars(view, width), Text(view.title, style="dim"), values]
    if view.watched:
        title = Text("the mount, after ten minutes of motion", style="dim")
        parts += [title, _lines(view.watched)]
    parts.append(_lines((*view.result, *view.health)))
    parts += [Text(f"    - {reason}", style="dim") for reason in view.reasons[:3]]
    keys = [f"{_KEYS.get(name, name[0])} {_LABELS.get(name, name)}   " for name in view.buttons]
    title = Text(f"hand_eye_calib watch {view.node}".rstrip())
    body = Panel(Group(*parts), title=title, title_align="left")
    return Group(Text(f" {''.join(keys)}q quit   {footer}".rstrip(), style="dim"), body)


def _bars(view: View, width: int) -> Table:
    table = Table.grid(padding=(0, 1))
    for bar in view.bars:
        style = _STYLES[bar.tone]
        drawn = ProgressBar(1.0, bar.share, _BAR_CELLS, complete_style=style, finished_style=style)
        sign = Text(f"{bar.tone.value} {bar.word}", style=style)
        more = [Text(bar.difference or bar.meaning)] * (width >= _WIDE)
        table.add_row(Text(bar.name, style="bold"), drawn, sign, Text(bar.against), *more)
    return table


def _lines(lines: tuple[Line, ...]) -> Table:
    table = Table.grid(padding=(0, 1))
    for line in lines:
        style = _STYLES[line.tone]
        table.add_row(Text(line.tone.value, style=style), Text(line.name), Text(line.text))
    return table


def lines(view: View) -> list[str]:
    """The headline, and the answer to a button: for a file or a pipe."""
    answers = [f"{each.tone.value} {each.name}: {each.text}" for each in view.answer]
    return [f"{view.tone.value} {view.word}: {view.sentence}", *answers]
