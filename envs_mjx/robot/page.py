"""An episode of a robot task as one HTML file that needs no network: brax's viewer with all its scripts inside.

brax's page (`brax.io.html`) loads its own viewer, three.js, lil-gui and pako from the network. Here they come from the
installed brax and from a folder of node modules (`make viewer` fills one), and each becomes a `data:` URL of the page's
import map.
"""

import base64
import importlib.util
import json
import pathlib
import re
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from envs_mjx.errors import UserError
from envs_mjx.robot import scene, window
from envs_mjx.robot.task import RobotState, RobotTask

MODULES = {
    "three": "three/build/three.module.js",
    "three/addons/controls/OrbitControls.js": "three/examples/jsm/controls/OrbitControls.js",
    "lilgui": "lil-gui/dist/lil-gui.esm.js",
}
"""What the viewer imports, and where node modules have it."""
_VIEWER = ("viewer", "animator", "selector", "system")
_SHAPES = {int(mujoco.mjtGeom.mjGEOM_PLANE): "Plane",  # pyright: ignore[reportAttributeAccessIssue]
           int(mujoco.mjtGeom.mjGEOM_SPHERE): "Sphere",  # pyright: ignore[reportAttributeAccessIssue]
           int(mujoco.mjtGeom.mjGEOM_CAPSULE): "Capsule",  # pyright: ignore[reportAttributeAccessIssue]
           int(mujoco.mjtGeom.mjGEOM_BOX): "Box"}  # pyright: ignore[reportAttributeAccessIssue]
_RED, _BLUE, _GREY, _YELLOW = [0.8, 0.2, 0.2, 1.0], [0.2, 0.4, 0.8, 1.0], [0.3, 0.3, 0.3, 1.0], [0.9, 0.8, 0.2, 1.0]
_STEP_SECONDS = scene.TIME_STEP * scene.SUBSTEPS


class ViewerMissing(UserError):
    """A script of the viewer is not installed; the message tells which, and how to get it."""


def page(env: RobotTask, states: Sequence[RobotState], scripts: dict[str, str]) -> str:
    """The HTML text.

    Args:
        env: the task.
        states: the moments of one episode, on the host.
        scripts: those of `load_scripts`.
    """
    return _PAGE.replace("IMPORTS", json.dumps({"imports": scripts})).replace(
        "SYSTEM", json.dumps(system(env, states))).replace("TITLE", env.name)


def load_scripts(libraries: pathlib.Path) -> dict[str, str]:
    """All that the viewer imports, as `data:` URLs by the names that it imports them under.

    Args:
        libraries: a folder of node modules that has three and lil-gui.

    Raises:
        ViewerMissing: brax is not installed, or a module is missing.
    """
    sources = {name: _read(libraries / place, libraries) for name, place in MODULES.items()}
    sources |= {f"brax/{name}.js": re.sub(r"from '\./", "from 'brax/", source) for name, source in _viewer().items()}
    return {name: "data:text/javascript;base64," + base64.b64encode(source.encode()).decode()
            for name, source in sources.items()}


def system(env: RobotTask, states: Sequence[RobotState]) -> dict[str, Any]:
    """The scene and its motion as brax's viewer reads them: geoms by body, and each body's pose at every moment."""
    model: Any = mujoco.MjModel.from_xml_string(env.xml(visual=True))  # pyright: ignore[reportAttributeAccessIssue]
    data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    geoms: dict[str, list[dict[str, Any]]] = {}
    for geom in range(model.ngeom):
        if model.geom_group[geom] == 3:
            continue  # only for contacts
        body = int(model.geom_bodyid[geom])
        name = model.body(body).name
        colour = _RED if name.startswith("loose") else _BLUE if name.startswith("fixed") else _GREY
        geoms.setdefault(name, []).append({
            "name": _SHAPES[int(model.geom_type[geom])], "link_idx": body - 1, "rgba": colour,
            "pos": model.geom_pos[geom].tolist(), "rot": model.geom_quat[geom].tolist(),
            "size": model.geom_size[geom].tolist()})
    centre = np.mean(np.asarray(states[0].poses)[:, :2], axis=0).tolist()
    geoms["world"] = [_fixed("Plane", [*centre, 0.0], [1.0, 1.0, 0.1], [0.6, 0.6, 0.6, 1.0])]
    if env.has_pad:
        half = window.PAD_SIDE / 2
        geoms["world"].append(_fixed("Box", [*map(float, states[0].goal), 0.0], [half, half, 0.0005], _YELLOW))
    moments = []
    for env_state in states:
        data.qpos[:] = np.asarray(env_state.qpos, np.float64)
        scene.place(model, env.placed, np.asarray(env.placed_poses(env_state)))
        mujoco.mj_kinematics(model, data)  # pyright: ignore[reportAttributeAccessIssue]
        moments.append({"pos": data.xpos[1:].tolist(), "rot": data.xquat[1:].tolist()})
    return {"opt": {"timestep": _STEP_SECONDS}, "geoms": geoms, "states": {"x": moments}, "centre": centre}


def _fixed(shape: str, place: list[float], size: list[float], colour: list[float]) -> dict[str, Any]:
    return {"name": shape, "link_idx": -1, "pos": place, "rot": [1.0, 0.0, 0.0, 0.0], "size": size, "rgba": colour}


def _viewer() -> dict[str, str]:
    """The scripts of brax's viewer, by name; brax itself is not imported."""
    spec = importlib.util.find_spec("brax")
    if spec is None or not spec.submodule_search_locations:
        raise ViewerMissing("the HTML viewer is brax's, which is not installed: pip install -e '.[robot]'")
    folder = pathlib.Path(next(iter(spec.submodule_search_locations))) / "visualizer" / "js"
    return {name: _read(folder / f"{name}.js", folder) for name in _VIEWER}


def _read(path: pathlib.Path, folder: pathlib.Path) -> str:
    try:
        return path.read_text()
    except OSError:
        raise ViewerMissing(f"--viewer-libraries {folder}: {path} is missing; `make viewer` installs it") from None


_PAGE = """<!DOCTYPE html>
<html>
<head>
<meta charset="utf-8">
<title>TITLE</title>
<style>body { margin: 0; } #viewer { height: 100vh; width: 100vw; overflow: hidden; }</style>
<script type="importmap">IMPORTS</script>
</head>
<body>
<div id="viewer"></div>
<script type="application/json" id="system">SYSTEM</script>
<script type="module">
import {Viewer} from 'brax/viewer.js';
const system = JSON.parse(document.getElementById('system').textContent);
const viewer = new Viewer(document.getElementById('viewer'), system);
// brax's view is for scenes of some metres in bright light; this one has half a metre.
const [x, y] = system.centre;
viewer.camera.follow = false;
viewer.camera.near = 0.01;
viewer.camera.position.set(x + 0.45, y - 0.55, 0.5);
viewer.camera.updateProjectionMatrix();
viewer.controls.target.set(x, y, 0.03);
viewer.scene.traverse((one) => { if (one.isLight) one.intensity *= 0.55; });
const shade = viewer.dirLight.shadow;
[shade.camera.left, shade.camera.right, shade.camera.bottom, shade.camera.top] = [-0.5, 0.5, -0.5, 0.5];
shade.camera.updateProjectionMatrix();
</script>
</body>
</html>
"""
