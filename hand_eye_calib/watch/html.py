"""A view as a piece of HTML, which the page in the browser puts in place."""

from collections.abc import Iterable, Sequence
from html import escape

from hand_eye_calib.watch.board import Bar, Line, Tone, View

# A vehicle from the side and its axes: x forward, y to the side, z up.
_SKETCH = (
    '<svg class="sketch" viewBox="0 0 170 92" role="img" aria-label="x forward, y sideways, z up">'
    '<path class="body" d="M22 66v-20h24l10-16h40l8 16h12v20z"/><circle cx="44" cy="68" r="9"/>'
    '<circle cx="98" cy="68" r="9"/><path d="M76 46h68m-7-5l7 5l-7 5M76 46V8m-5 7l5-7l5 7'
    'M76 46L52 60m4-8l-4 8l9 0"/><text x="148" y="50">x</text><text x="84" y="14">z</text>'
    '<text x="40" y="64">y</text></svg>'
)


def fragment(view: View, files: Sequence[str] = ()) -> str:
    """Everything but the buttons, which stay in the page, so that none vanishes under a finger: the
    attributes of the first element say which of them are shown.

    Parameters
    ----------
    view : View
    files : sequence of str
        Saved files that the page may have.
    """
    axes = "precision against the target"
    sketch = [_SKETCH] if any(bar.meaning for bar in view.bars) else []
    values = (f"<dt>{escape(axis)}</dt><dd>{escape(text)}</dd>" for axis, text in view.values)
    reasons = (f"<li>{escape(reason)}</li>" for reason in view.reasons)
    result = [*map(_line, view.result[:1]), *_wrapped("ul", reasons), *map(_line, view.result[1:])]
    links = (f'<a data-file="{escape(name)}" target="_blank">{escape(name)}</a> ' for name in files)
    topics = (f"<li>{escape(topic)}</li>" for topic in view.topics)
    sections = (
        _section("answer", "", [_line(view.answer)] if view.answer else []),
        _section("topics", "topics with poses", _wrapped("ul", topics)),
        _section("axes", axes, [*sketch, *map(_bar, view.bars)]),
        _section("axes", "the mount, after ten minutes of motion", map(_line, view.watched)),
        '<div class="side">',
        _section("pose", view.title, _wrapped("dl", values)),
        _section("health", "result and inputs", [*result, *links, *map(_line, view.health)]),
        "</div>",
    )
    facts = f'<p class="facts">{escape(view.facts)}</p>' if view.facts else ""
    return (
        f'<div id="state" class="{view.tone.css}" data-buttons="{" ".join(view.buttons)}" '
        f'data-by-hand="{escape(view.by_hand)}">'
        f'<p class="node">{escape(view.node or "no node")}</p>'
        f'<section class="headline"><h1>{_sign(view.tone)} {escape(view.word)}</h1>'
        f"<p>{escape(view.sentence)}</p>{facts}</section>{''.join(sections)}</div>"
    )


def _section(name: str, title: str, parts: Iterable[str]) -> str:
    """A section with a title; nothing if it is empty."""
    content = "".join(parts)
    head = f"<h2>{escape(title)}</h2>" if title else ""
    return f'<section class="{name}">{head}{content}</section>' if content else ""


def _wrapped(tag: str, parts: Iterable[str]) -> list[str]:
    content = "".join(parts)
    return [f"<{tag}>{content}</{tag}>"] if content else []


def _bar(bar: Bar) -> str:
    difference = f"from installed: {bar.difference}" if bar.difference else ""
    return (
        f'<div class="axis {bar.tone.css}"><b>{escape(bar.name)}</b>'
        f'<progress max="1" value="{bar.share:.3f}" aria-label="{escape(bar.name)}"></progress>'
        f'<span class="state">{_sign(bar.tone)} {escape(bar.word)}</span>'
        f'<span class="meaning">{escape(bar.meaning)}</span>'
        f'<span class="against">{escape(bar.against)}</span>'
        f'<span class="difference">{escape(difference)}</span></div>'
    )


def _line(line: Line) -> str:
    return (
        f'<p class="line {line.tone.css}">{_sign(line.tone)} <b>{escape(line.name)}</b> '
        f"{escape(line.text)}</p>"
    )


def _sign(tone: Tone) -> str:
    return f'<span class="sign">{tone.value}</span>'
