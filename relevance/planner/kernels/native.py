"""Call casadi functions from numba: generated C when a compiler is there, casadi's VM if not.

The C file is compiled once and cached under its content's hash; several processes that start
at once each build to a temporary name and the renames agree. Without a compiler the same
addresses point at callbacks into casadi's virtual machine: slower, same numbers.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
import warnings
from pathlib import Path

import casadi
import numpy as np
from llvmlite import ir
from numba import int32, int64, njit
from numba.extending import intrinsic

_FLAGS = ("-O2", "-ffp-contract=off", "-shared", "-fPIC")
_ENTRY = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int
)


class Native:
    """One casadi function of one flat input and one flat output, callable from numba.

    Write the input to `x`, run `call(handle)`, read the output from `y`. Not for threads.
    """

    def __init__(self, function: casadi.Function, library: ctypes.CDLL | None) -> None:
        self.x = np.zeros(function.numel_in(0))
        self.y = np.zeros(function.numel_out(0))
        self._iw = np.zeros(max(function.sz_iw(), 1), np.int64)
        self._w = np.zeros(max(function.sz_w(), 1))
        self._arg = np.zeros(max(function.sz_arg(), 1), np.int64)
        self._res = np.zeros(max(function.sz_res(), 1), np.int64)
        self._arg[0], self._res[0] = self.x.ctypes.data, self.y.ctypes.data
        if library is not None:
            self._entry = getattr(library, function.name())
        else:
            buffer, run = function.buffer()
            buffer.set_arg(0, self.x.data)  # pyright: ignore[reportCallIssue]
            buffer.set_res(0, self.y.data)  # pyright: ignore[reportCallIssue]
            self._keep = buffer
            self._entry = _ENTRY(lambda *_: run() or 0)
        address = ctypes.cast(self._entry, ctypes.c_void_p).value
        self.handle = np.array(
            [address, *(a.ctypes.data for a in (self._arg, self._res, self._iw, self._w))], np.int64
        )


def load(functions: list[casadi.Function]) -> list[Native]:
    """Natives for these functions, compiled if a C compiler is found."""
    compiler = shutil.which(os.environ.get("CC", "cc")) or shutil.which("gcc")
    library = None
    if compiler:
        library = ctypes.CDLL(str(_compile(functions, compiler)))
    else:
        warnings.warn("no C compiler found: kinematics run interpreted, slower", stacklevel=2)
    return [Native(function, library) for function in functions]


def _compile(functions: list[casadi.Function], compiler: str) -> Path:
    generator = casadi.CodeGenerator("relevance_kinematics.c")
    for function in functions:
        generator.add(function)
    source = generator.dump()
    digest = hashlib.sha256("\0".join([source, compiler, *_FLAGS]).encode()).hexdigest()[:16]
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "relevance"
    cache.mkdir(parents=True, exist_ok=True)
    target = cache / f"kinematics-{digest}.so"
    if not target.exists():
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            (Path(folder) / "kinematics.c").write_text(source)
            built = subprocess.run(
                [compiler, *_FLAGS, "-o", "kinematics.so", "kinematics.c", "-lm"],
                cwd=folder,
                capture_output=True,
                text=True,
                check=False,
            )
            if built.returncode:
                raise RuntimeError(f"{compiler} failed on the kinematics: {built.stderr.strip()}")
            os.replace(Path(folder) / "kinematics.so", target)
    return target


@intrinsic
def _enter(typingctx, entry, arg, res, iw, w):
    signature = int32(int64, int64, int64, int64, int64)

    def codegen(context, builder, signature, args):
        word = ir.IntType(64)
        kind = ir.FunctionType(ir.IntType(32), [word, word, word, word, ir.IntType(32)])
        function = builder.inttoptr(args[0], kind.as_pointer())
        return builder.call(function, [*args[1:], ir.Constant(ir.IntType(32), 0)])

    return signature, codegen


@njit(cache=True)
def call(handle):
    """Run the function behind a `Native.handle`."""
    return _enter(handle[0], handle[1], handle[2], handle[3], handle[4])  # pyright: ignore[reportCallIssue]
