"""What the command lines share: parsing, errors in one sentence, the compilation cache, and memory reuse."""

import ctypes
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import jax
import tyro

from l2dgs_jax.errors import UserError

T = TypeVar("T")


def main(command: Callable[[Sequence[str]], None], arguments: Sequence[str] | None = None) -> None:
    """Run a command: a user's mistake becomes one sentence on standard error and exit code 2."""
    use_compilation_cache()
    keep_freed_memory()
    try:
        command(sys.argv[1:] if arguments is None else arguments)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def parse(kind: type[T], arguments: Sequence[str], program: str, default: T | None = None) -> T:
    """Parse command-line arguments into the dataclass `kind`."""
    program = f"python -m l2dgs_jax.{program}"
    if default is None:
        return tyro.cli(kind, args=arguments, prog=program)
    return tyro.cli(kind, args=arguments, prog=program, default=default)


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder; L2DGS_JAX_CACHE names another, or "off"."""
    base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    folder = os.environ.get("L2DGS_JAX_CACHE", str(base / "l2dgs_jax"))
    if folder != "off":
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def keep_freed_memory() -> None:
    """Let glibc keep what XLA frees: mapping its temporaries anew in every step costs more than filling them."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return  # another C library
    arena_max, mmap_max, trim_threshold, top_pad = -8, -4, -1, -2
    for option, value in ((arena_max, 1), (mmap_max, 0), (trim_threshold, 2**31 - 1), (top_pad, 2**28)):
        mallopt(option, value)
