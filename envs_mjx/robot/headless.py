"""OpenGL without a display: which one there is, and making `mujoco.Renderer` use it."""

import functools
import importlib
import os
import subprocess
import sys

BACKENDS = ("egl", "osmesa")
"""In the order in which they are tried; MUJOCO_GL names another one."""
_TRY = """
import mujoco
renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8)
renderer.update_scene(mujoco.MjData(renderer.model))
renderer.render()
renderer.close()
"""


@functools.cache
def bind() -> str | None:
    """Let this process render without a display; the name of what it renders with, None where there is nothing.

    Tried in a process of its own first, since a library that is missing can end the process. MuJoCo chooses when it is
    first imported, which may have happened long ago: the choice is then changed.
    """
    named = os.environ.get("MUJOCO_GL")
    for backend in (named,) if named else BACKENDS:
        run = subprocess.run([sys.executable, "-c", _TRY], capture_output=True, check=False,
                             env={**os.environ, "MUJOCO_GL": backend})
        if run.returncode == 0:
            os.environ["MUJOCO_GL"] = backend
            if backend in BACKENDS:
                from mujoco.rendering.classic import gl_context

                gl_context.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext
            return backend
    return None
