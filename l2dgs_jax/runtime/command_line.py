"""What the command lines share: parsing, errors in one sentence, the compilation cache, and huge pages."""

import os
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import tyro

from l2dgs_jax.errors import Interrupted, UserError
from l2dgs_jax.runtime import devices
from l2dgs_jax.runtime.files import is_writable
from l2dgs_jax.runtime.memory import memory_errors

T = TypeVar("T")

HELP_OPTIONS = frozenset({"-h", "--help"})


def run(
    command: Callable[[Sequence[str]], None], arguments: Sequence[str] | None = None, *, huge_pages: bool = False
) -> None:
    """Run a command; user errors and interruptions become one sentence on standard error and an exit code.

    Args:
        command: takes the arguments.
        arguments: if not given, those of the command line.
        huge_pages: whether to use huge pages, for commands that compute for long; the program then starts twice.
    """
    if huge_pages and not HELP_OPTIONS & set(sys.argv):
        use_huge_pages()
    devices.use_atomic_additions()
    use_compilation_cache()
    default = signal.getsignal(signal.SIGTERM) == signal.SIG_DFL  # which would leave behind what is half written
    if default:
        signal.signal(signal.SIGTERM, _terminate)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning  # type: ignore[assignment]
            try:
                with memory_errors(lambda: "at this size", "smaller or fewer images, or more memory"):
                    command(sys.argv[1:] if arguments is None else arguments)
            except SystemExit:  # after --help
                sys.stdout.flush()
                raise
            sys.stdout.flush()
    except BrokenPipeError:  # whatever reads the output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more when it ends
        sys.exit(128 + signal.SIGPIPE)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.code)
    except OSError as error:
        if error.filename is None:
            raise
        print(f"error: {error.filename}: {error.strerror}; expected a path that can be reached", file=sys.stderr)
        sys.exit(2)
    except Interrupted as stop:
        print(stop, file=sys.stderr)
        sys.exit(stop.code)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    finally:
        if default:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _terminate(number: int, _: Any) -> None:
    print("stopped", file=sys.stderr)
    sys.exit(128 + number)


def _show_warning(message: Warning | str, *_: Any) -> None:
    """Show a warning as one sentence; its place in the code does not help somebody who typed a command."""
    print(f"warning: {message}", file=sys.stderr)


def parse(kind: Callable[..., T], arguments: Sequence[str], program: str, default: T | None = None) -> T:
    """Parse command-line arguments into the dataclass `kind`, or a partial of it that sets defaults of some fields."""
    script = f"l2dgs {program}"
    program = script if sys.argv[0] == script else f"python -m l2dgs_jax.{program}"
    if default is None:
        return tyro.cli(kind, args=arguments, prog=program)
    return tyro.cli(kind, args=arguments, prog=program, default=default)  # type: ignore[call-overload]


def use_compilation_cache() -> None:
    """Keep compiled programs in the user's cache folder; L2DGS_JAX_CACHE names another folder, or is "off"."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    without_home = base.startswith("~")  # as in containers whose user has none
    folder = os.environ.get("L2DGS_JAX_CACHE", "off" if without_home else os.path.join(base, "l2dgs_jax"))
    if folder == "off":
        return
    if is_writable(Path(folder)):
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    else:
        _show_warning(
            f"{folder}: not writable, so compiled programs are not kept; L2DGS_JAX_CACHE names another folder"
        )


def use_huge_pages() -> None:
    """Restart the program with glibc set to ask Linux for huge pages, which is only possible at the start.

    Every step maps XLA's temporary buffers again; with pages of 4 KiB that takes more than a quarter of its time.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if sys.platform == "linux" and "glibc.malloc.hugetlb" not in tunables:
        tunables = ":".join(filter(None, [tunables, "glibc.malloc.hugetlb=1"]))
        os.execve(sys.executable, sys.orig_argv, os.environ | {"GLIBC_TUNABLES": tunables})
