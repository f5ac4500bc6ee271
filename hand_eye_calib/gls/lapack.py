"""LAPACK's routines for bands, tridiagonals and triangles as SciPy wraps them, without importing
the package ``scipy.linalg``.

That package imports much else, and takes twice as long as numpy to import; the wrapper itself takes
a millisecond or two.
"""

import importlib
import importlib.util
import sys
from importlib.machinery import PathFinder
from types import ModuleType

_WRAPPER = "scipy.linalg._flapack"
_USED = ("dpbtrf", "dtbtrs", "dpttrf", "dpttrs", "dtrtri")


def _load_wrapper() -> ModuleType:
    """The wrapper alone if it is where SciPy has always had it, otherwise SciPy's public module of
    the same functions.
    """
    if _WRAPPER not in sys.modules:
        scipy = importlib.util.find_spec("scipy")
        folders = (scipy.submodule_search_locations if scipy else None) or []
        spec = PathFinder.find_spec(_WRAPPER, [f"{folder}/linalg" for folder in folders])
        if spec is None or spec.loader is None:
            return importlib.import_module("scipy.linalg.lapack")
        wrapper = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(wrapper)
        # Under its own name, so that scipy.linalg, imported later, finds it there and does not load
        # it a second time.
        sys.modules[_WRAPPER] = wrapper
    wrapper = sys.modules[_WRAPPER]
    return (
        wrapper
        if all(hasattr(wrapper, name) for name in _USED)
        else importlib.import_module("scipy.linalg.lapack")
    )


_wrapper = _load_wrapper()
dpbtrf, dtbtrs, dpttrf, dpttrs, dtrtri = (getattr(_wrapper, name) for name in _USED)
