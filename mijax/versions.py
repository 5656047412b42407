"""What a result was made with."""

import importlib.metadata
import pathlib
import platform
import subprocess
from typing import Any

_PACKAGES = ("mijax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


def current_versions() -> dict[str, Any]:
    """What works here: python, packages, platform, commit."""
    def version(package: str) -> str | None:
        try:
            return importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            return None

    packages = {package: version(package) for package in _PACKAGES}
    return {"python": platform.python_version(), **packages, "platform": platform.platform(), "commit": _commit()}


def _commit() -> str | None:
    """The commit of the source tree, with `+changes` when it differs from it; None outside a repository."""
    tree = pathlib.Path(__file__).resolve().parents[1]
    if not (tree / ".git").exists():
        return None

    def git(*arguments: str) -> str:
        command = ("git", "-C", str(tree), *arguments)
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+changes" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None
