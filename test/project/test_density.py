"""Code is laid out to be read once: nodes of the syntax tree, for each line and in all.

Lines are free. What a reader pays for is what a line says, and how much there is in all.
"""

import ast
import io
import tokenize

import pytest
from source_code import ROOT

# Nodes of the syntax tree, nodes a line of code, and numeric constants: today's with 5 % of room.
# Whoever makes one smaller lowers its limit. The aim is 132,000 nodes, 6.0 a line, 300 constants.
LIMITS = {
    "hand_eye_calib": (239_000, 6.0, 990),
    "test": (192_500, 6.1, 320),
    "reproduction": (53_500, 6.12, 211),
}

_NOT_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
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


def n_constants(statement):
    """Numbers that a statement at the top of a module names, and fields of a class Tuning."""
    if isinstance(statement, ast.ClassDef) and statement.name.endswith(
        "Tuning"
    ):
        return sum(isinstance(field, ast.AnnAssign) for field in statement.body)
    if isinstance(statement, ast.Assign):
        targets = statement.targets
    elif isinstance(statement, ast.AnnAssign) and statement.value is not None:
        targets = [statement.target]
    else:
        return 0
    nodes = [node for target in targets for node in ast.walk(target)]
    names = [node.id for node in nodes if isinstance(node, ast.Name)]
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
