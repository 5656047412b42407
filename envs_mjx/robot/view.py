"""Pictures of a robot scene by MuJoCo's own renderer: an oracle for depth images, and a rendered view for people.

The renderer needs OpenGL without a display: set MUJOCO_GL=egl or osmesa before mujoco is first imported.
"""

import mujoco
import numpy as np

from envs_mjx.robot import depth, scene, window
from envs_mjx.robot.task import RobotState, RobotTask

_TOP = "top"


class View:
    """A renderer of one task's scenes. Close it when done: it holds an OpenGL context."""

    def __init__(self, env: RobotTask, size: int = depth.SIZE) -> None:
        """Args: size: of the square pictures, in pixels."""
        self._env = env
        camera = (f'<camera name="{_TOP}" projection="orthographic" fovy="{depth.WINDOW}" '
                  'pos="0 0 0.5" xyaxes="0 1 0 -1 0 0"/><light pos="0.5 0 1.5" castshadow="false"/>')
        half = window.PAD_SIDE / 2
        pad = (f'<body name="pad"><geom name="pad" type="box" size="{half} {half} 0.0005" rgba="0.9 0.8 0.2 1"/></body>'
               if env.has_pad else "")
        table = '<geom name="table" type="plane" size="2 2 0.1" rgba="0.8 0.8 0.8 1"/>'
        visual = (f'<visual><global offwidth="{size}" offheight="{size}"/><quality offsamples="0" shadowsize="0"/>'
                  '<map znear="0.001" zfar="5"/></visual><statistic extent="1" center="0.5 0 0"/>')
        xml = env.xml(visual=True).replace("<worldbody>", visual + "<worldbody>" + table + pad + camera)
        self.model = mujoco.MjModel.from_xml_string(xml)  # pyright: ignore[reportAttributeAccessIssue]
        self.data = mujoco.MjData(self.model)  # pyright: ignore[reportAttributeAccessIssue]
        self._renderer = mujoco.Renderer(self.model, size, size)
        self._options = mujoco.MjvOption()  # pyright: ignore[reportAttributeAccessIssue]
        self._options.geomgroup[3] = 0

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def height(self, env_state: RobotState, immovable: bool = True) -> np.ndarray:
        """(size, size) height above the table in metres, around the gripper, without it and without the goal pad.

        Args:
            immovable: False leaves out the object that cannot be moved.
        """
        self._place(env_state)
        self._colour(hidden=("tip", "finger", "pad") + (() if immovable else ("fixed",)))
        self._renderer.enable_depth_rendering()
        self._renderer.update_scene(self.data, _TOP, self._options)
        below = self._renderer.render()
        self._renderer.disable_depth_rendering()
        return 0.5 - below

    def picture(self, env_state: RobotState, azimuth: float = 200.0, elevation: float = -35.0) -> np.ndarray:
        """(size, size, 3) uint8: a view from the side, the movable object in red."""
        self._place(env_state)
        self._colour(hidden=())
        camera = mujoco.MjvCamera()  # pyright: ignore[reportAttributeAccessIssue]
        camera.azimuth, camera.elevation, camera.distance = azimuth, elevation, 0.9
        camera.lookat[:] = (*scene.CENTRE, 0.05)
        self._renderer.update_scene(self.data, camera, self._options)
        return self._renderer.render()

    def _place(self, env_state: RobotState) -> None:
        self.data.qpos[:] = np.asarray(env_state.qpos, np.float64)
        scene.place(self.model, self._env.placed, np.asarray(self._env.placed_poses(env_state)))
        if self._env.has_pad:
            self.model.body_pos[self.model.body("pad").id, :2] = env_state.goal
        self.model.cam_pos[self.model.camera(_TOP).id, :2] = env_state.qpos[:2]
        mujoco.mj_forward(self.model, self.data)  # pyright: ignore[reportAttributeAccessIssue]

    def _colour(self, hidden: tuple[str, ...]) -> None:
        for geom in range(self.model.ngeom):
            name = self.model.geom(geom).name
            body = self.model.body(self.model.geom_bodyid[geom]).name
            if name == "table" or name == "pad":
                colour = self.model.geom_rgba[geom, :3].copy()
            else:
                colour = np.array([0.8, 0.2, 0.2] if body.startswith("loose") else
                                  [0.2, 0.4, 0.8] if body.startswith("fixed") else [0.3, 0.3, 0.3])
            visible = not (name.startswith(hidden) or body.startswith(hidden)) if hidden else True
            self.model.geom_rgba[geom] = *colour, float(visible)
