"""What a command sets before JAX starts: host devices and the persistent compilation cache."""

import ctypes
import gc
import os
import pathlib
import sys
from collections.abc import Callable
from typing import NoReturn

import jax

from envs_mjx.errors import UserError, one_line

CACHE_VARIABLE = "JAX_COMPILATION_CACHE_DIR"
INTERRUPTED = 130
"""What a command returns after Ctrl-C."""


def cores() -> int:
    """CPU cores this process may use: at most the variable NPROC, which XLA keeps to as well."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("NPROC", "")
    return min(available, int(limit)) if limit.isdecimal() and int(limit) > 0 else available


def prepare(host_devices: int = 1) -> None:
    """Call once, before anything is computed.

    Args:
        host_devices: devices to make of a CPU; without effect on an accelerator.
    """
    if not os.environ.get(CACHE_VARIABLE):
        cache = pathlib.Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "mijax" / "jax"
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    if host_devices > 1 and "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        jax.config.update("jax_num_cpu_devices", host_devices)
    asked = os.environ.get("JAX_PLATFORMS", "")
    if asked not in ("", "cpu"):
        try:
            jax.devices()
        except Exception as error:  # of a backend that is not installed JAX has several kinds, some without a message
            raise UserError(f"JAX_PLATFORMS: got {asked!r}, accepted: one that is installed here, such as cpu "
                            f"({one_line(error)})") from None


def release_memory() -> None:
    """Give memory that compiling has left over back to the system, where glibc can.

    A CarFlag-2D learner keeps 978 MiB with it and 1 869 without: LLVM's heap is free, but stays with the process.
    """
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def leave(code: int) -> NoReturn:
    """End the process with this code: at once after Ctrl-C, when a thread may be in a long computation, which the
    interpreter would wait for."""
    if code == INTERRUPTED:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def exit_code(work: Callable[[], object], *others: type[Exception]) -> int:
    """0 once a command's work is done; 1 after one line on what the user can mend (`UserError`, an error of the file
    system, `others`); 130 after Ctrl-C, whose exception may say how to go on."""
    try:
        work()
    except KeyboardInterrupt as stopped:
        print(str(stopped) or "stopped", file=sys.stderr)
        return INTERRUPTED
    except (UserError, OSError, *others) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0
