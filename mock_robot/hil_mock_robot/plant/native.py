"""Optional libraries of the plant, and calls of MuJoCo from compiled code.

numba cannot cache a function that closes over a ctypes pointer. Therefore addresses are passed as
integers, and `call` emits the indirect call.
"""

from __future__ import annotations

import ctypes
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hil.core import PluginError, plugins

HINT = 'pip install "hil[mock]"'


def require_libraries() -> None:
    """Raise if MuJoCo or numba is not installed, without importing them.

    Raises:
        PluginError: MuJoCo or numba is not installed.
    """
    missing = [name for name in ("mujoco", "numba") if find_spec(name) is None]
    if missing:
        raise plugins.not_installed("the mock robot", missing, "mock")


require_libraries()  # before the imports, for a clear error message

import mujoco  # noqa: E402
from llvmlite import ir  # noqa: E402
from numba import types  # noqa: E402
from numba.extending import intrinsic  # noqa: E402


def address_of(function: str) -> int:
    """Return the address of a C function of MuJoCo, for compiled code."""
    pointer = ctypes.cast(getattr(_library(), function), ctypes.c_void_p).value
    assert pointer is not None
    return pointer


@cache
def _library() -> ctypes.CDLL:
    """Return the libmujoco of the wheel, which `import mujoco` has already loaded."""
    pattern = {"darwin": "libmujoco*.dylib", "win32": "mujoco.dll"}.get(
        sys.platform, "libmujoco.so*"
    )
    found = sorted(Path(mujoco.__file__).parent.glob(pattern))
    if not found:
        raise PluginError(f"mujoco {mujoco.__version__} ships no {pattern}", hint=HINT)
    return ctypes.CDLL(str(found[0]))


def _call(typingctx: Any, function: Any, model: Any, data: Any) -> Any:
    signature = types.void(types.intp, types.intp, types.intp)

    def emit(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        pointer = ir.IntType(8 * ctypes.sizeof(ctypes.c_void_p))
        kind = ir.FunctionType(ir.VoidType(), [pointer, pointer])
        target = builder.inttoptr(arguments[0], kind.as_pointer())
        builder.call(target, [arguments[1], arguments[2]])
        return context.get_dummy_value()

    return signature, emit


call: Any = intrinsic(_call)
"""`call(function, model, data)` calls `void function(mjModel*, mjData*)`, all as addresses."""
