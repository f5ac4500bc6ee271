"""Every regular expression of the package is linear in texts that are made against it."""

import ast
import re
import re._parser as sre
import signal
from contextlib import contextmanager

import pytest
from source_code import SOURCE

_FLAGS = ("MULTILINE", "DOTALL", "IGNORECASE")
_FUNCTIONS = {
    "compile",
    "search",
    "match",
    "fullmatch",
    "sub",
    "split",
    "findall",
    "finditer",
}
# Characters of a hostile text; a line of a trajectory file may have more.
_LENGTH = 30_000
# Processor time (s) for a pattern and a text. A linear pattern needs milliseconds, a quadratic one
# several seconds, an exponential one years.
_MOST_S = 2.0
# Patterns that meet only what the package has drawn itself.
_OF_OWN_TEXT = {"offline/report/style.py"}
# Most characters of a pattern from which hostile texts are made.
_ALPHABET = 5


def patterns():
    """Every pattern that stands in the source as text: place to pattern, flags and functions.

    A compiled pattern is applied by the methods that its file calls it with.
    """
    collected = {}
    for path in sorted(SOURCE.rglob("*.py")):
        file = str(path.relative_to(SOURCE))
        tree = ast.parse(path.read_text("utf-8"))
        names = {
            id(node.value): ast.unparse(node.targets[0])
            for node in ast.walk(tree)
            if isinstance(node, ast.Assign)
        }
        for call in filter(is_of_re, ast.walk(tree)):
            if file not in _OF_OWN_TEXT:
                flags = sum(
                    getattr(re, name)
                    for name in _FLAGS
                    if name in ast.unparse(call)
                )
                functions = {call.func.attr}
                if call.func.attr == "compile":
                    functions = methods_of(names.get(id(call)), tree) or {
                        "finditer"
                    }
                place = f"{file}:{call.lineno} {call.func.attr}"
                collected[place] = (call.args[0].value, flags, functions)
    return collected


def methods_of(name, tree):
    """The methods of a compiled pattern that a module calls by the pattern's name."""
    attributes = [
        node for node in ast.walk(tree) if isinstance(node, ast.Attribute)
    ]
    return {node.attr for node in attributes if ast.unparse(node.value) == name}


def is_of_re(node):
    """Whether a node of the syntax tree calls a function of re with a literal pattern."""
    if (
        not isinstance(node, ast.Call)
        or not isinstance(node.func, ast.Attribute)
        or not node.args
    ):
        return False
    module = node.func.value
    has_module = isinstance(module, ast.Name) and module.id == "re"
    return (
        has_module
        and node.func.attr in _FUNCTIONS
        and isinstance(node.args[0], ast.Constant)
    )


def alphabet(pattern):
    """Characters that the pattern names or has in a class: signs first, then letters."""
    of_class = {
        sre.CATEGORY_DIGIT: "1",
        sre.CATEGORY_SPACE: " \n",
        sre.CATEGORY_WORD: "a_",
        sre.CATEGORY_NOT_SPACE: "a.",
    }
    characters = {"a", "1", " "}

    def visit(item):
        match item:
            case (sre.LITERAL | sre.NOT_LITERAL, code):
                characters.add(chr(code))
            case (sre.RANGE, (first, _)):
                characters.add(chr(first))
            case (sre.CATEGORY, category):
                characters.update(of_class.get(category, ""))
            case tuple() | list() | sre.SubPattern():
                for child in item:
                    visit(child)

    visit(sre.parse(pattern))
    return sorted(
        characters, key=lambda character: (character.isalpha(), character)
    )[:_ALPHABET]


def hostile_texts(pattern):
    """Long repetitions of one or two characters that the pattern names, after some of them."""
    characters = alphabet(pattern)
    pairs = [
        first + second
        for first in characters
        for second in characters
        if first != second
    ]
    for unit in (*characters, *pairs):
        for start in ("", *characters[:2]):
            yield start + unit * (_LENGTH // len(unit)) + "\0"


def applied(pattern, flags, functions, text):
    """Apply the functions to a text, as often as they match."""
    if isinstance(pattern, bytes):
        text = text.encode()
    compiled = re.compile(pattern, flags)
    anchored = functions & {"fullmatch", "match"}
    for name in anchored:
        getattr(compiled, name)(text)
    if functions - anchored:
        for _ in compiled.finditer(text):
            pass


@contextmanager
def processor_time(seconds, pattern):
    """Fail if the block takes more processor time."""

    def stop(*_):
        raise AssertionError(
            f"{pattern}: more than {seconds:g} s for {_LENGTH} characters"
        )

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


@pytest.mark.parametrize("place", patterns())
def test_a_pattern_is_linear_in_hostile_texts(place):
    pattern, flags, functions = patterns()[place]
    for text in hostile_texts(
        pattern.decode() if isinstance(pattern, bytes) else pattern
    ):
        with processor_time(_MOST_S, f"{pattern!r} on {text[:12]!r} ..."):
            applied(pattern, flags, functions, text)


@pytest.mark.parametrize("pattern", [r"(a+)+b", r"\d*\.?\d*x", r"\s*\s*:"])
def test_a_pattern_that_is_not_linear_is_noticed(pattern):
    def on_hostile_texts():
        for text in hostile_texts(pattern):
            with processor_time(_MOST_S, pattern):
                applied(pattern, 0, {"search"}, text)

    with pytest.raises(AssertionError, match="more than"):
        on_hostile_texts()
