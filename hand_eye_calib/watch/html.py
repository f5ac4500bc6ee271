"""A view as a piece of HTML, which the page in the browser puts in place."""

from collections.abc import Iterable, Iterator
from html import escape

from hand_eye_calib.watch.board import Bar, Line, Tone, View

_CLASSES = {tone: tone.name.lower() for tone in Tone}


def fragment(view: View) -> str:
    """Everything but the buttons: these stay in the page, so that none vanishes under a finger."""
    rows = (f"<dt>{escape(axis)}</dt><dd>{escape(text)}</dd>" for axis, text in view.values)
    watched = "the mount: what ten minutes of motion would show"
    return "".join(
        (
            f'<p class="node">{escape(view.node or "no node")}</p>',
            f'<section class="headline {_CLASSES[view.tone]}"><h1>{_sign(view.tone)} '
            f"{escape(view.word)}</h1><p>{escape(view.sentence)}</p></section>",
            f'<section class="answer">{_line(view.answer)}</section>' if view.answer else "",
            _section("axes", "precision against the target", map(_bar, view.bars)),
            _section("axes", watched, map(_line, view.watched)),
            '<div class="side">',
            _section("pose", view.title, ["<dl>", *rows, "</dl>"] if view.title else []),
            _section("health", "result and inputs", _health(view)),
            "</div>",
        )
    )


def _section(name: str, title: str, parts: Iterable[str]) -> str:
    """A section with a title; nothing if it is empty."""
    content = "".join(parts)
    if not content:
        return ""
    return f'<section class="{name}"><h2>{escape(title)}</h2>{content}</section>'


def _health(view: View) -> Iterator[str]:
    lines = [_line(line) for line in view.result]
    yield from lines[:1]
    if view.reasons:
        yield f"<ul>{''.join(f'<li>{escape(reason)}</li>' for reason in view.reasons)}</ul>"
    yield from lines[1:]
    yield from map(_line, view.health)


def _bar(bar: Bar) -> str:
    difference = f"from installed: {bar.difference}" if bar.difference else ""
    return (
        f'<div class="axis {_CLASSES[bar.tone]}"><b>{escape(bar.axis)}</b>'
        f'<progress max="1" value="{bar.share:.3f}" aria-label="{escape(bar.axis)}"></progress>'
        f'<span class="state">{_sign(bar.tone)} {escape(bar.word)}</span>'
        f'<span class="meaning">{escape(bar.meaning)}</span>'
        f'<span class="against">{escape(bar.against)}</span>'
        f'<span class="difference">{escape(difference)}</span></div>'
    )


def _line(line: Line) -> str:
    return (
        f'<p class="line {_CLASSES[line.tone]}">{_sign(line.tone)} <b>{escape(line.name)}</b> '
        f"{escape(line.text)}</p>"
    )


def _sign(tone: Tone) -> str:
    return f'<span class="sign">{tone.value}</span>'
