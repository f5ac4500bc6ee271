"""The size of the package: lines, code, constants, long files and functions, rooms, and what one
command enters.
"""

import ast
import io
import subprocess
import sys
import tokenize
from functools import cache

from source_code import SOURCE, imports_of, room_of

ROOT = SOURCE.parent

# What may not be exceeded: the sizes of today, which may only be lowered. Goal still ahead: 450
# functions entered by ``calibrate a b``.
LIMITS = {
    "lines": 29_420,
    "lines of code": 18_959,
    "numeric constants": 395,
    "files above 500 lines": 0,
    "functions above 50 lines": 4,
    "rooms": 28,
    "floors": 17,
    "arrows between rooms": 166,
    "functions entered by calibrate": 500,
    "files entered by calibrate": 49,
    "lines of reproduction": 6_960,
    "lines of tests": 19_000,
    "words of documentation": 34_900,
}

_LONG_FILE, _LONG_FUNCTION = 500, 50
_NOT_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
_NOT_CODE |= {tokenize.ENDMARKER}
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_ENTERED = """
import contextlib, io, sys
seen = set()
def note(frame, event, _):
    file = frame.f_code.co_filename
    if event == "call" and "/hand_eye_calib/" in file:
        seen.add((file, frame.f_code.co_qualname))
sys.setprofile(note)
from hand_eye_calib.cli.main import main
with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
    main(sys.argv[1:])
sys.setprofile(None)
named = {one for one in seen if not one[1].rpartition(".")[2].startswith("<")}
print(len(named), len({file for file, _ in named}))
"""


def code_lines(source, tree):
    """Numbers of the lines that are neither docstring, comment nor blank."""
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NOT_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        is_documented = isinstance(node, (ast.Module, ast.ClassDef, *_FUNCTIONS))
        if is_documented and ast.get_docstring(node, clean=False) is not None:
            lines.difference_update(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return lines


def numeric_constants(tree):
    """How many names in capitals a module gives values with numbers; a table counts once."""
    count = 0
    for node in tree.body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = [one for each in targets for one in ast.walk(each) if isinstance(one, ast.Name)]
            values = [one.value for one in ast.walk(node.value) if isinstance(one, ast.Constant)]
            if all(name.id.lstrip("_").isupper() for name in names):
                count += len(names) if any(type(one) in (int, float) for one in values) else 0
    return count


def sizes(package):
    """The first five of the limits, of a folder of Python files."""
    found = dict.fromkeys(list(LIMITS)[:5], 0)
    for path in package.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        tree, n_lines = ast.parse(source), len(source.splitlines())
        lengths = [n.end_lineno - n.lineno + 1 for n in ast.walk(tree) if isinstance(n, _FUNCTIONS)]
        found["lines"] += n_lines
        found["lines of code"] += len(code_lines(source, tree))
        found["numeric constants"] += numeric_constants(tree)
        found["files above 500 lines"] += n_lines > _LONG_FILE
        found["functions above 50 lines"] += sum(length > _LONG_FUNCTION for length in lengths)
    return found


def room_graph(package):
    """Room to the rooms that it imports."""
    graph = {room_of(path.relative_to(package)): set() for path in package.rglob("*.py")}
    for path in package.rglob("*.py"):
        room = room_of(path.relative_to(package))
        for name in imports_of(path, package):
            top, *rest = name.split(".")
            if top == package.name:
                graph[room].add(rest[0] if rest and rest[0] in graph else "root")
    return {room: targets - {room} for room, targets in graph.items()}


def floors(graph):
    """The number of rooms in the longest chain of imports."""

    @cache
    def height(room):
        return 1 + max((height(target) for target in graph[room]), default=0)

    return max(map(height, graph))


def lines_below(folder):
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in folder.rglob("*.py"))


def test_the_package_its_tests_and_its_pages_stay_within_their_budget():
    graph = room_graph(SOURCE)
    pages = (ROOT / "docs").rglob("*.md")
    found = sizes(SOURCE) | {
        "rooms": len(graph),
        "floors": floors(graph),
        "arrows between rooms": sum(map(len, graph.values())),
        "lines of reproduction": lines_below(ROOT / "reproduction"),
        "lines of tests": lines_below(ROOT / "test"),
        "words of documentation": sum(len(page.read_text("utf-8").split()) for page in pages),
    }

    assert {name: count for name, count in found.items() if count > LIMITS[name]} == {}


def test_a_calibration_of_two_files_enters_few_functions_and_files(tmp_path):
    simulate = ["simulate", "--out", tmp_path, "--drive", "hilly", "--mixture"]
    subprocess.run([sys.executable, "-m", "hand_eye_calib", *simulate], check=True)
    pair = sorted(tmp_path.rglob("T_S?_W?.txt"))
    command = [sys.executable, "-c", _ENTERED, "calibrate", *pair]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    functions, files = map(int, done.stdout.split())
    assert 100 < functions <= LIMITS["functions entered by calibrate"]
    assert 20 < files <= LIMITS["files entered by calibrate"]


def test_what_is_counted(tmp_path):
    text = '"""About."""\n\n# A comment.\nA, _B = 1, 2\nC: int = 3\nD = "text"\nlower = 4\n'
    of_49 = "def f():\n" + "    x = 1\n" * 49
    (tmp_path / "module.py").write_text(text + of_49 + of_49 + "    x = 1\n" + "y = 1\n" * 394)
    assert sizes(tmp_path) == {
        "lines": 502,
        "lines of code": 499,
        "numeric constants": 3,
        "files above 500 lines": 1,
        "functions above 50 lines": 1,
    }
