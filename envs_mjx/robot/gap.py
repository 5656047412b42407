"""How different the other world is from the one of training."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Gap:
    """What is drawn anew for each episode is symmetric about the value of training."""

    mass: float
    """The movable object's mass is multiplied by a factor from [1 / (1 + mass), 1 + mass], log-uniform."""
    friction: float
    """The same for the friction of the fingers and for that of the table, or of the drawer's slide."""
    latency: float
    """Seconds: images are that old when they are shown, and the gripper's pose is that of then."""
    camera_shift: float
    """Metres: standard deviation, per axis, of where the calibration has each camera."""
    camera_turn: float
    """Radians: the same for the turn about each axis."""
    disparity: float
    """Pixels: the step in which stereo cameras measure the disparity; 0 exactly."""
    edge_holes: int
    """Pixels to both sides of an edge in which most are not measured."""
    perlin: float
    """Metres: amplitude of the smooth noise in each camera's image."""


GAPS = {
    "none": Gap(0, 0, 0, 0, 0, 0, 0, 0),
    "mild": Gap(mass=0.25, friction=0.15, latency=0.04, camera_shift=0.001, camera_turn=0.002, disparity=0.05,
                edge_holes=2, perlin=0.002),
    "hard": Gap(mass=1.0, friction=0.4, latency=0.12, camera_shift=0.003, camera_turn=0.006, disparity=0.2,
                edge_holes=4, perlin=0.005),
}
"""At 1 m, disparity steps of 0.05 and 0.2 pixels are 1.0 and 4.1 mm; a turn of 0.006 moves points by 6 mm."""
