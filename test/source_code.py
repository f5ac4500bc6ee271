"""The package as text: what its files import."""

import ast
from functools import cache
from pathlib import Path

PACKAGE = "hand_eye_calib"
ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / PACKAGE


@cache
def imports_of(path, package_root):
    """Dotted names a file imports, inside functions too; relative ones resolved, import_module of a
    literal included.
    """
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = (PACKAGE, *path.relative_to(package_root).parts)[
                    : -node.level
                ]
                base = ".".join((*parents, base)).rstrip(".")
            names += [f"{base}.{alias.name}" for alias in node.names]
        elif (
            isinstance(node, ast.Call)
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if called in ("import_module", "__import__"):
                names.append(str(node.args[0].value))
    return names


def room_of(relative):
    if relative.name == "__init__.py" and len(relative.parts) == 1:
        return "root"
    return relative.parts[0].removesuffix(".py")
