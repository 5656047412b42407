"""Files that are either the old one or the new one, whenever the program is killed."""

import os
import pathlib

ASIDE = ".part"
"""What the name of a file ends with until it is whole."""


def write_atomically(path: pathlib.Path, content: bytes) -> None:
    """Replace a file in one step."""
    aside = path.with_name(path.name + ASIDE)
    with aside.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)
