"""Arms: kinematics against other people's, pullbacks against automatic differentiation, gaps against all pairs.

`pip install pin example-robot-data` brings two of the oracles; without them their tests are skipped.
"""

import math
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from conflow.scene.arm_constraints import (
    FAR,
    FAR_FROM_ITSELF,
    ArmAvoidance,
    Bounded,
    JointSpeed,
    NearestPair,
    SelfAvoidance,
    SphereAvoidance,
    Table,
)
from conflow.scene.arms import Arms, Base, Body, Chain
from conflow.scene.constraint import Barrier, Constraint, RobotAvoidance, Sum, Workspace
from conflow.scene.measures import keeps
from conflow.scene.panda import PANDA

FACING = [Base(-0.35), Base(0.35, turn=math.pi)]
PANDAS = Arms([PANDA, PANDA], FACING)

# What another arm takes: this is all of a UR5e, by the manufacturer's parameters.
UR5E = Chain(
    joints=(
        (0, 0, 0.1625),
        (0, math.pi / 2, 0),
        (-0.425, 0, 0),
        (-0.3922, 0, 0.1333),
        (0, math.pi / 2, 0.0997),
        (0, -math.pi / 2, 0.0996),
    ),
    low=[-2 * math.pi] * 6,
    high=[2 * math.pi] * 6,
    speed=[math.pi] * 6,
    bodies=[
        Body(0, [(0, 0, 0.05, 0.08)]),
        Body(1, [(0, 0, 0, 0.07)]),
        Body(2, [(-0.085 * k, 0, 0.13, 0.07) for k in range(6)]),
        Body(3, [(-0.0784 * k, 0, 0.01, 0.06) for k in range(6)]),
        Body(4, [(0, 0, 0, 0.055)]),
        Body(5, [(0, 0, 0, 0.055)]),
        Body(6, [(0, 0, -0.02, 0.05)]),
    ],
)
MIXED = Arms([PANDA, UR5E], [Base(-0.5), Base(0.4, 0.1, 0.05, turn=2.5)])
both = pytest.mark.parametrize("robots", [PANDAS, MIXED], ids=["pandas", "a Panda and a UR5e"])


def configurations(robots: Arms, batch: int = 40, T: int = 6, spread: float = 0.9) -> Tensor:
    """Trajectories (batch, T, D) over most of the joints' ranges: some in violation and some not."""
    generator = torch.Generator().manual_seed(0)
    return spread * (2 * torch.rand(batch, T, robots.D, dtype=torch.float64, generator=generator) - 1)


def classical(theta: float, d: float, a: float, alpha: float) -> np.ndarray:
    """Denavit and Hartenberg's own convention, Rot_z Trans_z Trans_x Rot_x, in which the maker publishes the UR5e."""
    c, s, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])


def test_a_ur5e_is_where_its_maker_says() -> None:
    """Against the product of the classical parameters, at random joints: the tool's frame, in 40 configurations."""
    one = Arms([UR5E], [Base()])
    x = configurations(one, T=1)
    published = [(0.1625, 0, math.pi / 2), (0, -0.425, 0), (0, -0.3922, 0)]
    published += [(0.1333, 0, math.pi / 2), (0.0997, 0, -math.pi / 2), (0.0996, 0, 0)]
    for q, hand in zip(one.joints(x)[:, 0].tolist(), one.hands(x)[:, 0, 0], strict=True):
        T = np.eye(4)
        for theta, (d, a, alpha) in zip(q, published, strict=True):
            T = T @ classical(theta, d, a, alpha)
        np.testing.assert_allclose(hand.numpy(), T[:3, 3], rtol=0, atol=1e-12)


def robot_data() -> Path:
    """The Panda of example-robot-data, where it is installed."""
    for folder in sys.path:
        found = Path(folder, "cmeel.prefix/share/example-robot-data/robots/panda_description")
        if found.is_dir():
            return found
    return pytest.skip("example-robot-data is not installed: expected the Panda's URDF and meshes in it")


def test_the_panda_is_where_pinocchio_says() -> None:
    """All seven joints' frames of the manufacturer's URDF in 50 configurations, and its limits but the looser ones."""
    pin = pytest.importorskip("pinocchio", reason="pin is not installed: expected it as an oracle of kinematics")
    model = pin.buildModelFromUrdf(str(robot_data() / "urdf" / "panda.urdf"))
    data = model.createData()
    one = Arms([PANDA], [Base()])
    x = configurations(one, batch=50, T=1, spread=1.0)
    frames = one.frames(x)[:, :, :, 0]
    for k, q in enumerate(one.joints(x)[:, 0].numpy()):
        pin.forwardKinematics(model, data, np.concatenate([q, [0.04, 0.04]]))
        for link in range(1, 8):
            placed = data.oMi[link]
            np.testing.assert_allclose(frames[link, 3, :, k], placed.translation, rtol=0, atol=1e-14)
            np.testing.assert_allclose(frames[link, :3, :, k].T, placed.rotation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(one.speed, model.velocityLimit[:7])
    np.testing.assert_allclose(PANDA.low, model.lowerPositionLimit[:7])
    np.testing.assert_allclose(PANDA.high, model.upperPositionLimit[:7])


@pytest.mark.parametrize("link", range(8))
def test_the_pandas_spheres_cover_its_links(link: int) -> None:
    """Every vertex of the collision meshes is in a sphere, to half a millimetre."""
    raw = (robot_data() / "meshes" / "collision" / f"link{link}.stl").read_bytes()
    triangle = np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    vertices = np.frombuffer(raw[84:], dtype=triangle)["v"].reshape(-1, 3)
    spheres = np.array([one for body in PANDA.bodies[:9] if body.link == link for one in body.spheres])
    outside = np.linalg.norm(vertices[:, None] - spheres[:, :3], axis=2) - spheres[:, 3]
    assert outside.min(axis=1).max() < 5e-4


def test_the_panda_has_59_spheres_and_the_true_limits() -> None:
    assert sum(len(body.spheres) for body in PANDA.bodies) == 59
    assert (PANDA.low[0], PANDA.high[0]) == (-2.8973, 2.8973)
    limits = torch.ones(1, 1, 14, dtype=torch.float64)
    torch.testing.assert_close(PANDAS.joints(limits)[0, 0, :7], torch.tensor(PANDA.high, dtype=torch.float64))
    torch.testing.assert_close(PANDAS.joints(-limits)[0, 0, 7:], torch.tensor(PANDA.low, dtype=torch.float64))


def test_arms_stand_where_their_bases_are() -> None:
    """Two alike that face each other: what one reaches the other reaches turned by half a turn, in numbers by hand."""
    x = configurations(PANDAS)
    x = torch.cat([x[..., :7], x[..., :7]], dim=2)
    p = PANDAS.points(x)
    torch.testing.assert_close(p[..., 59:, :2], -p[..., :59, :2], rtol=0, atol=1e-12)
    torch.testing.assert_close(p[..., 59:, 2], p[..., :59, 2], rtol=0, atol=1e-12)
    zero = PANDAS.numbers(torch.zeros(1, 1, 14, dtype=torch.float64))
    hand = torch.tensor([0.088 - 0.35, 0.0, 0.333 + 0.316 + 0.384 - 0.107 - 0.1034], dtype=torch.float64)
    torch.testing.assert_close(PANDAS.hands(zero)[0, 0, 0], hand, rtol=0, atol=1e-12)


@both
def test_the_pullback_is_that_of_automatic_differentiation(robots: Arms) -> None:
    x = configurations(robots).requires_grad_()
    p = robots.points(x)
    g = torch.randn(p.shape, dtype=p.dtype, generator=torch.Generator().manual_seed(1))
    (expected,) = torch.autograd.grad(p, x, g)
    torch.testing.assert_close(robots.pullback(x.detach(), g), expected, rtol=0, atol=1e-11)


def test_the_pullback_is_that_of_small_steps() -> None:
    """dC/dx by central differences of step h: wrong by h^2 times third derivatives of some ten metres."""
    x, h = configurations(PANDAS, batch=3), 1e-5
    g = torch.randn(PANDAS.points(x).shape, dtype=x.dtype, generator=torch.Generator().manual_seed(1))
    for j in range(14):
        step = torch.zeros(14, dtype=x.dtype)
        step[j] = h
        slope = ((PANDAS.points(x + step) - PANDAS.points(x - step)) * g).sum(dim=(2, 3)) / (2 * h)
        torch.testing.assert_close(PANDAS.pullback(x, g)[..., j], slope, rtol=0, atol=1e-6)


def exact(constraint: RobotAvoidance) -> RobotAvoidance:
    """The same in double precision, radii too."""
    made = constraint.double()
    made.radius = made.touching
    return made


@both
def test_arms_avoid_each_other_as_any_robots_do(robots: Arms) -> None:
    """The general constraint measures all pairs of bodies; beyond FAR ours says FAR."""
    x = configurations(robots)
    all_pairs, ours = exact(RobotAvoidance(robots)), ArmAvoidance(robots)
    c = all_pairs.clearance(x)
    assert bool((c < 0).any())
    assert bool((c > FAR).any())
    torch.testing.assert_close(ours.clearance(x), c.clamp(max=FAR), rtol=0, atol=1e-14)
    assert torch.equal(ours.violation(x), all_pairs.violation(x))
    square = Barrier("square")
    expected = all_pairs.shaped(square).gradient(x)
    torch.testing.assert_close(ours.shaped(square).gradient(x), expected, rtol=0, atol=1e-12)


SPHERES = [(0.0, 0.1, 0.6, 0.1), (0.2, -0.3, 0.3, 0.15)]
CONSTRAINTS: dict[str, Callable[[Arms], Constraint]] = {
    "arms": ArmAvoidance,
    "self": lambda robots: SelfAvoidance(robots, 0),
    "spheres": lambda robots: SphereAvoidance(robots, SPHERES),
    "table": Table,
    "speed": lambda robots: JointSpeed(robots, 0.5),
    "limits": lambda robots: Workspace(robots, 0.6),
}
every = pytest.mark.parametrize("build", CONSTRAINTS.values(), ids=CONSTRAINTS)


@every
@both
def test_closed_forms_are_those_of_automatic_differentiation(robots: Arms, build: Callable[[Arms], Constraint]) -> None:
    constraint, x = build(robots), configurations(robots)
    assert bool((constraint.clearance(x) < 0).any())
    (c, pullback), (expected, automatic) = constraint.vjp(x), Constraint.vjp(constraint, x)
    assert torch.equal(c, expected)
    g = torch.randn(c.shape, dtype=c.dtype, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(pullback(g), automatic(g), rtol=0, atol=1e-11)


@every
def test_the_swept_clearance_is_never_above_that_of_the_waypoints(build: Callable[[Arms], Constraint]) -> None:
    """And often below: long straight steps in joint space pass through the other arm."""
    constraint, x = build(PANDAS), configurations(PANDAS, batch=20)
    c, swept = constraint.clearance(x), constraint.swept_clearance(x)
    assert swept.shape == (20, 5)
    moving = isinstance(constraint, JointSpeed)  # of which a waypoint has the faster of two steps
    if not moving:
        assert bool((swept <= torch.minimum(c[:, :-1], c[:, 1:])).all())
    assert torch.equal(swept.amin(dim=1), c.amin(dim=1)) == isinstance(constraint, JointSpeed | Workspace)


@every
@both
def test_the_closest_approach_is_the_smallest_swept_clearance(
    robots: Arms, build: Callable[[Arms], Constraint]
) -> None:
    """Found without looking everywhere: of what is known to be no smaller than something else nothing is said."""
    constraint = build(robots)
    waypoints = configurations(robots, batch=150, T=5)
    x = torch.cat([waypoints, waypoints[:, :1] + 0.05 * (waypoints - waypoints[:, :1])])  # far apart, and near
    swept = constraint.swept_clearance(x).amin(dim=1)
    equal = partial(torch.testing.assert_close, rtol=0, atol=1e-12)  # float64 rounding
    equal(constraint.closest(x), swept)
    known = torch.linspace(-0.1, 0.2, len(x), dtype=x.dtype)
    equal(constraint.closest(x, known), torch.minimum(swept, known))
    narrowed, both = constraint.narrowed(0.03), Sum([constraint, Workspace(robots, 0.6)])
    equal(narrowed.closest(x, known), torch.minimum(swept - 0.03, known))
    equal(both.closest(x), both.swept_clearance(x).amin(dim=1))
    assert keeps(constraint, x).equal(swept >= 0)


def test_what_cannot_be_the_closest_is_not_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    constraint, x, looked = ArmAvoidance(PANDAS), configurations(PANDAS, batch=20), list[int]()
    gaps = ArmAvoidance.gaps

    def counted(self: ArmAvoidance, x: Tensor) -> Tensor:
        looked.append(x.shape[0] * x.shape[1])
        return gaps(self, x)

    monkeypatch.setattr(ArmAvoidance, "gaps", counted)
    constraint.closest(x, x.new_full((20,), -10.0))
    assert looked == [20 * 6]  # waypoints alone


@pytest.mark.parametrize("name", ["arms", "self", "spheres", "table"])
@both
def test_no_clearance_changes_faster_than_its_slope(robots: Arms, name: str) -> None:
    constraint, x = CONSTRAINTS[name](robots), configurations(robots, batch=400)
    assert isinstance(constraint, Bounded)
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(x.shape, dtype=x.dtype, generator=generator)
    for size, joints in ((1e-3, 1.0), (0.1, 1.0), (0.1, (torch.rand(x.shape[2], generator=generator) < 0.2).to(x))):
        other = x + size * noise * joints
        change = (other - x).abs() @ (constraint.slope * robots.scale)
        assert bool(((constraint.clearance(other) - constraint.clearance(x)).abs() <= change + 1e-12).all())
    assert bool((constraint.slope >= 0).all())


@every
def test_a_trajectory_that_is_not_finite_violates(build: Callable[[Arms], Constraint]) -> None:
    x = 0 * configurations(PANDAS, batch=3)
    x[1, 2, 3] = math.nan
    assert bool(build(PANDAS).violation(x)[1])
    assert not keeps(build(PANDAS), x)[1]


def test_an_arm_keeps_clear_of_itself_of_spheres_and_of_the_table() -> None:
    """Each against all pairs of its spheres, one by one."""
    x, robots = configurations(PANDAS), PANDAS
    p, radius, link, owner = robots.points(x), robots.radii, robots.link, robots.owner
    gaps = torch.cdist(p, p) - (radius[:, None] + radius)
    separate = (owner[:, None] == owner) & (owner == 1) & (link - link[:, None] >= 3)
    expected = gaps.where(separate, torch.inf).amin(dim=(2, 3)).clamp(max=FAR_FROM_ITSELF)
    torch.testing.assert_close(SelfAvoidance(robots, 1).clearance(x), expected, rtol=0, atol=1e-7)
    spheres = torch.tensor(SPHERES, dtype=torch.float64)
    among = torch.cdist(p, spheres[:, :3].expand(*x.shape[:2], -1, -1)) - (radius[:, None] + spheres[:, 3])
    expected = among.where(link[:, None] > 0, torch.inf).amin(dim=(2, 3)).clamp(max=FAR)
    torch.testing.assert_close(SphereAvoidance(robots, SPHERES).clearance(x), expected, rtol=0, atol=1e-7)
    expected = (p[..., 2] - radius).where(link > 1, torch.inf).amin(dim=2)
    torch.testing.assert_close(Table(robots).clearance(x), expected, rtol=0, atol=1e-12)


def test_a_joint_has_the_speed_of_its_steps() -> None:
    """Joint 7, of limit 2.61 rad/s, turns 0.5 rad in 0.4 s: 1 - 1.25 / 2.61 of it is left."""
    q = torch.zeros(1, 3, 14, dtype=torch.float64)
    q[0, 1:, 6] = 0.5
    left = 1 - 1.25 / 2.61
    c = JointSpeed(PANDAS, 0.4).clearance(PANDAS.numbers(q))
    assert c[0].tolist() == pytest.approx([left, left, 1.0])


def test_a_joint_moves_the_links_beyond_it_and_no_other_arm() -> None:
    g = torch.zeros(1, 1, 14)
    g[..., 7 + 3] = 1.0  # joint 4 of the second arm
    moved = PANDAS.moved(g)[0, 0]
    assert torch.equal(moved, (PANDAS.owner == 1) & (PANDAS.link >= 4))


def test_frames_follow_a_configuration_that_changes_in_place() -> None:
    """They are kept between constraints, but not beyond the tensor's next change."""
    constraint, x = ArmAvoidance(PANDAS), configurations(PANDAS)
    before = constraint.clearance(x).clone()
    assert torch.equal(constraint.clearance(x), before)
    x += 0.1
    assert not torch.equal(constraint.clearance(x), before)
    assert torch.equal(constraint.clearance(x), constraint.clearance(x.clone()))


def test_one_arm_avoids_no_other_and_no_sphere_is_none() -> None:
    with pytest.raises(ValueError, match=r"^one arm: expected two or more that avoid each other$"):
        ArmAvoidance(Arms([PANDA], [Base()]))
    with pytest.raises(ValueError, match=r"^no spheres: expected one or more to stay clear of$"):
        SphereAvoidance(PANDAS, [])
    assert isinstance(ArmAvoidance(PANDAS).narrowed(0.1), Constraint)
    assert isinstance(ArmAvoidance(PANDAS), NearestPair)
