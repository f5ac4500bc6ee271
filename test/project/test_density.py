"""Code is laid out to be read once: nodes of the syntax tree, for each line and in all.

Lines are free. What a reader pays for is what a line says, and how much there is in all.
"""

import ast
import io
import tokenize

import pytest
from source_code import ROOT

# Nodes of the syntax tree, nodes a line of code, and numeric constants: today's with 4 % of room.
# Whoever makes one smaller lowers its limit. The aim is 132,000 nodes, 300 constants.
LIMITS = {
    "hand_eye_calib": (252_000, 5.4, 1012),
    "test": (202_000, 5.5, 332),
    "reproduction": (54_000, 5.7, 208),
}

# Largest number of lines of a function and of a file.
MOST_LINES_OF_FUNCTION = 60
MOST_LINES_OF_FILE = 600
# Public functions whose options, each explained, are longer than that. Their bodies are short.
LONG_BY_THEIR_OPTIONS = {
    "hand_eye_calib/offline/calibrate.py:calibrate",
    "hand_eye_calib/formats/trajectory_files/reading.py:read_trajectory",
}

_NOT_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_DOCUMENTED = (ast.Module, ast.ClassDef, *_FUNCTIONS)
# Parts of the tree that repeat what their parent says.
_SILENT = (ast.expr_context, ast.operator, ast.unaryop, ast.cmpop, ast.boolop)


def n_nodes(tree):
    nodes = [node for node in ast.walk(tree) if not isinstance(node, _SILENT)]
    return len(nodes)


def n_code_lines(source, tree):
    """Lines that are neither docstring, comment nor blank."""
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NOT_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(tree):
        if (
            isinstance(node, _DOCUMENTED)
            and ast.get_docstring(node, clean=False) is not None
        ):
            docstring = node.body[0]
            lines.difference_update(
                range(docstring.lineno, docstring.end_lineno + 1)
            )
    return len(lines)


def has_number(expression):
    """True if an expression contains a number."""
    for node in ast.walk(expression):
        if isinstance(node, ast.Constant) and type(node.value) in (int, float):
            return True
    return False


def is_field(statement):
    return isinstance(statement, ast.AnnAssign)


def names_assigned(statement):
    """Names that a statement gives a value; empty for other statements."""
    if isinstance(statement, ast.Assign):
        targets = statement.targets
    elif is_field(statement) and statement.value is not None:
        targets = [statement.target]
    else:
        return []
    nodes = [node for target in targets for node in ast.walk(target)]
    return [node.id for node in nodes if isinstance(node, ast.Name)]


def n_constants(statement):
    """Numbers that a statement at the top of a module names, and fields of a class Tuning."""
    if isinstance(statement, ast.ClassDef):
        is_tuning = statement.name.endswith("Tuning")
        fields = [part for part in statement.body if is_field(part)]
        return len(fields) if is_tuning else 0
    names = names_assigned(statement)
    if not names:
        return 0
    is_constant = all(name.lstrip("_").isupper() for name in names)
    if is_constant and has_number(statement.value):
        return len(names)
    return 0


def measured(folder):
    nodes = 0
    lines = 0
    constants = 0
    for path in folder.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        tree = ast.parse(source)
        nodes += n_nodes(tree)
        lines += n_code_lines(source, tree)
        constants += sum(n_constants(statement) for statement in tree.body)
    return nodes, nodes / lines, constants


@pytest.mark.parametrize("name", LIMITS)
def test_code_is_no_more_and_no_denser_than_it_was(name):
    nodes, nodes_a_line, constants = measured(ROOT / name)
    most_nodes, most_a_line, most_constants = LIMITS[name]
    assert nodes <= most_nodes, "more code than before: can something go?"
    assert nodes_a_line <= most_a_line, (
        "denser code than before: give each step a line"
    )
    assert constants <= most_constants, (
        "more constants than before: can one be derived?"
    )


def too_long(folder, root=ROOT):
    """Names of functions and files with too many lines."""
    names = []
    for path in sorted(folder.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        file = path.relative_to(root).as_posix()
        if len(source.splitlines()) > MOST_LINES_OF_FILE:
            names.append(file)
        for node in ast.walk(ast.parse(source)):
            if (
                isinstance(node, _FUNCTIONS)
                and node.end_lineno - node.lineno >= MOST_LINES_OF_FUNCTION
            ):
                names.append(f"{file}:{node.name}")
    return names


@pytest.mark.parametrize("name", LIMITS)
def test_functions_and_files_are_short(name):
    long = {*too_long(ROOT / name)} - LONG_BY_THEIR_OPTIONS
    assert not long, "name the steps of a function, split a file by its topics"


def test_what_is_long(tmp_path):
    body = "    pass\n" * MOST_LINES_OF_FUNCTION
    (tmp_path / "short.py").write_text(f"def short():\n{body[9:]}")
    assert too_long(tmp_path, tmp_path) == []
    (tmp_path / "long.py").write_text(f"def long():\n{body}" + "\n" * 540)
    assert too_long(tmp_path, tmp_path) == ["long.py", "long.py:long"]


def test_what_is_counted(tmp_path):
    (tmp_path / "module.py").write_text(
        '"""About."""\n\n# A comment.\nA, _B = 1, 2\nC: int = 3\nD = "text"\nlower = 4\n'
        "class PlainTuning:\n    field: float = 1.0\n"
    )
    nodes, nodes_a_line, constants = measured(tmp_path)
    assert constants == 4
    assert nodes_a_line == nodes / 6
    # Module, its docstring's statement and text; then the six statements with their parts.
    assert nodes == 3 + 7 + 4 + 3 + 3 + 5
