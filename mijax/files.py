"""Files that are either the old one or the new one, whenever the program is killed."""

import os
import pathlib

from envs_mjx.errors import UserError

ASIDE = ".part"
"""What the name of a file ends with until it is whole."""


def make_folder(path: pathlib.Path) -> None:
    """Make the folder that --out names, before there is anything to lose; `UserError` where that cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out: got {path}, accepted: a folder that can be made ({error.strerror})") from None


def write_atomically(path: pathlib.Path, content: bytes) -> None:
    """Replace a file in one step."""
    aside = path.with_name(path.name + ASIDE)
    with aside.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)
