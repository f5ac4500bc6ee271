"""A view as a piece of HTML, which the page in the browser puts in place."""

from html import escape

from hand_eye_calib.watch.board import Bar, Line, Tone, View

_SHOWN = ' aria-current="true"'
_CLASSES = {tone: tone.name.lower() for tone in Tone}


def fragment(view: View) -> str:
    """Everything but the buttons: these stay in the page, so that none vanishes under a finger."""
    return "".join(
        (
            _nodes(view),
            f'<section class="headline {_CLASSES[view.tone]}"><h1>{_sign(view.tone)} '
            f"{escape(view.word)}</h1><p>{escape(view.sentence)}</p></section>",
            _answer(view.answer),
            '<section class="axes"><h2>precision against the target</h2>',
            *map(_bar, view.bars),
            "</section>",
            _pose(view),
            '<section class="health"><h2>result and inputs</h2>',
            _line(view.verdict),
            _reasons(view.reasons),
            *map(_line, (view.comparison, *view.health)),
            "</section>",
        )
    )


def _nodes(view: View) -> str:
    """A link for each node, if there are several."""
    if len(view.nodes) < 2:
        return f'<p class="node">{escape(view.node or "no node")}</p>'
    links = (
        f'<a href="#" data-node="{escape(name)}"{_SHOWN * (name == view.node)}>{escape(name)}</a>'
        for name in view.nodes
    )
    return f'<nav aria-label="nodes">{"".join(links)}</nav>'


def _bar(bar: Bar) -> str:
    difference = f"installed: {bar.difference}" if bar.difference else ""
    return (
        f'<div class="axis {_CLASSES[bar.tone]}"><b>{escape(bar.axis)}</b>'
        f'<progress max="1" value="{bar.share:.3f}" aria-label="{escape(bar.axis)}"></progress>'
        f'<span class="state">{_sign(bar.tone)} {escape(bar.word)}</span>'
        f'<span class="meaning">{escape(bar.meaning)}</span>'
        f'<span class="against">{escape(bar.against)}</span>'
        f'<span class="difference">{escape(difference)}</span></div>'
    )


def _pose(view: View) -> str:
    rows = (f"<dt>{escape(axis)}</dt><dd>{escape(text)}</dd>" for axis, text in view.values)
    return f'<section class="pose"><h2>{escape(view.title)}</h2><dl>{"".join(rows)}</dl></section>'


def _line(line: Line) -> str:
    return (
        f'<p class="line {_CLASSES[line.tone]}">{_sign(line.tone)} <b>{escape(line.name)}</b> '
        f"{escape(line.text)}</p>"
    )


def _answer(line: Line | None) -> str:
    return f'<section class="answer">{_line(line)}</section>' if line is not None else ""


def _reasons(reasons: tuple[str, ...]) -> str:
    if not reasons:
        return ""
    return f"<ul>{''.join(f'<li>{escape(reason)}</li>' for reason in reasons)}</ul>"


def _sign(tone: Tone) -> str:
    return f'<span class="sign">{tone.value}</span>'
