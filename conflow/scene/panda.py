"""The Franka Panda with its hand, fingers open: joints, limits, and the spheres that stand for its bodies.

Joints and limits are those of the manufacturer's data sheet and of franka_description (Franka Emika GmbH, Apache-2.0),
https://github.com/frankaemika/franka_ros. Joint 1 turns +-2.8973; several packages ship looser limits.

The 59 spheres are this project's own. Each link's collision mesh in franka_description is covered whole: its surface
was divided among so many balls by Lloyd's algorithm, each the smallest around its share; centres are rounded to a
millimetre, and radii up to the next that covers. What sticks out of the meshes is at most a ball's radius.
"""

from math import cos, pi, sin

from conflow.scene.arms import Body, Chain, Sphere

LINK_0 = (
    (-0.078, -0.001, 0.015, 0.091),
    (-0.008, -0.009, 0.079, 0.093),
    (-0.006, 0, 0.004, 0.097),
)
LINK_1 = (
    (-0.002, -0.073, -0.009, 0.071),
    (-0.001, 0, -0.151, 0.071),
    (0, -0.052, -0.094, 0.072),
    (0, -0.026, -0.001, 0.07),
    (0.001, -0.004, -0.067, 0.073),
)
LINK_2 = (
    (-0.005, -0.011, 0.019, 0.072),
    (-0.004, -0.097, 0.05, 0.07),
    (0, -0.156, 0, 0.069),
    (0.004, -0.088, 0.007, 0.069),
    (0.008, -0.011, 0.07, 0.073),
)
LINK_3 = (
    (0.002, 0.001, -0.079, 0.074),
    (0.03, 0.034, -0.043, 0.073),
    (0.051, 0.007, -0.039, 0.073),
    (0.079, 0.042, -0.001, 0.073),
)
LINK_4 = (
    (-0.08, 0.022, -0.001, 0.065),
    (-0.078, 0.097, 0.006, 0.07),
    (-0.03, 0.045, 0.025, 0.073),
    (-0.004, 0.001, 0.042, 0.073),
)
FOREARM = (
    (-0.026, 0.019, -0.229, 0.057),
    (-0.006, -0.032, -0.227, 0.055),
    (0.047, 0, -0.21, 0.064),
    (0.017, 0.047, -0.208, 0.059),
    (-0.013, 0, -0.154, 0.062),
    (-0.002, 0.051, -0.151, 0.061),
)
ELBOW = (
    (0.043, 0.018, -0.093, 0.062),
    (-0.001, 0.08, -0.084, 0.063),
    (-0.031, 0.031, -0.073, 0.065),
    (-0.009, 0.09, -0.003, 0.063),
    (0.021, 0.066, -0.001, 0.063),
    (0.006, 0.027, 0.001, 0.06),
)
LINK_6 = (
    (0.003, 0.005, 0.008, 0.061),
    (0.049, -0.024, 0.007, 0.06),
    (0.07, 0.039, 0.007, 0.063),
    (0.104, -0.013, -0.003, 0.062),
)
LINK_7 = (
    (-0.017, 0.017, 0.078, 0.044),
    (-0.008, -0.024, 0.072, 0.044),
    (0.03, 0, 0.081, 0.043),
    (0.04, 0.045, 0.078, 0.045),
)
PALM_RIGHT = (
    (-0.001, -0.083, 0.042, 0.031),
    (-0.001, -0.077, 0.001, 0.033),
    (0.005, -0.058, 0.044, 0.033),
    (-0.022, -0.043, 0.009, 0.032),
    (0.013, -0.034, -0.005, 0.035),
    (-0.003, -0.024, 0.051, 0.033),
    (-0.025, -0.004, 0.029, 0.032),
)
PALM_LEFT = (
    (0.023, -0.002, 0.031, 0.037),
    (-0.006, 0.013, -0.005, 0.036),
    (0, 0.026, 0.048, 0.039),
    (0.014, 0.038, 0.009, 0.035),
    (-0.024, 0.067, 0.012, 0.039),
    (-0.001, 0.075, 0.044, 0.036),
    (0.009, 0.08, 0.007, 0.029),
)
FINGER = ((0, 0.013, 0.0135, 0.022), (0, 0.013, 0.0405, 0.022))
"""Of the left one, from where it is closed; the right one is the same, turned."""

FLANGE, FINGERTIPS = 0.107, 0.1034
"""From link 7's frame to the hand's, and from there to between the fingertips, along z."""
KNUCKLE, OPEN = 0.0584, 0.04
"""Where fingers begin, and how far each is from the middle."""


def _on_link_7(x: float, y: float, z: float, radius: float) -> Sphere:
    """A sphere of the hand, which is turned by -45 degrees on the flange."""
    c, s = cos(-pi / 4), sin(-pi / 4)
    return c * x - s * y, s * x + c * y, z + FLANGE, radius


def _fingers() -> list[Sphere]:
    return [_on_link_7(side * x, side * (y + OPEN), z + KNUCKLE, r) for side in (1, -1) for x, y, z, r in FINGER]


PANDA = Chain(
    joints=(
        (0.0, 0.0, 0.333),
        (0.0, -pi / 2, 0.0),
        (0.0, pi / 2, 0.316),
        (0.0825, pi / 2, 0.0),
        (-0.0825, -pi / 2, 0.384),
        (0.0, pi / 2, 0.0),
        (0.088, pi / 2, 0.0),
    ),
    low=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    high=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    speed=(2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    bodies=(
        Body(0, LINK_0),
        Body(1, LINK_1),
        Body(2, LINK_2),
        Body(3, LINK_3),
        Body(4, LINK_4),
        Body(5, FOREARM),
        Body(5, ELBOW),
        Body(6, LINK_6),
        Body(7, LINK_7),
        Body(7, [_on_link_7(*sphere) for sphere in PALM_RIGHT]),
        Body(7, [_on_link_7(*sphere) for sphere in PALM_LEFT]),
        Body(7, _fingers()),
    ),
    hand=(0.0, 0.0, FLANGE + FINGERTIPS),
)
