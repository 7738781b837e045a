"""Forward kinematics and its derivatives, against 4x4 products and central differences."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from oracle import central_differences, dh_joint, frame, random_robot, rotation, tool_pose, translation
from scipy.spatial.transform import Rotation
from simulated import planar_robot
from sparing import diagonal
from tolerances import rounding

from fg_calib.robot import CONVENTIONS, LANES, SPAN, Axis, build_chain, forward, pose
from fg_calib.robot.model import Effect, Element, Joint, RobotBuilder, Term


def twists(d_T, T):
    """Rotation and translation, in the base frame, of each derivative of a pose T, shape (6, n)."""
    turning = np.einsum("ijk,lj->ilk", d_T[:3, :3], T[:3, :3])  # [w]x
    return np.stack([turning[2, 1], turning[0, 2], turning[1, 0], *d_T[:3, 3]])


def test_a_planar_arm_reaches_where_one_can_draw_it():
    poses = pose(planar_robot(), [[0.0, 0.0], [np.pi / 2, 0.0], [np.pi / 2, -np.pi / 2]])
    assert poses.position == pytest.approx(np.array([[3, 0, 0], [0, 3, 0], [1, 2, 0]]), abs=rounding(1.0))
    assert poses.rotation[2] == pytest.approx(np.eye(3), abs=rounding(1.0))


@pytest.mark.parametrize("convention", list(CONVENTIONS))
def test_a_convention_is_the_product_its_table_says(convention):
    rng = np.random.default_rng(3)
    robot = random_robot(convention, 4, rng)
    q = rng.uniform(-3, 3, 4)
    value = dict(zip([p.name for p in robot.parameters], robot.nominal, strict=True))
    T = frame(**{k: value[f"base.{k}"] for k in ("x", "y", "z", "roll", "pitch", "yaw")})
    for i, joint in enumerate(robot.joints):
        T = T @ dh_joint(convention, {k: value[f"{k}{i + 1}"] for k in CONVENTIONS[convention]}, q[i], joint.prismatic)
    T = T @ frame(**{k: value[f"tool.{k}"] for k in ("x", "y", "z", "roll", "pitch", "yaw")})
    assert tool_pose(robot, q) == pytest.approx(T, abs=rounding(1.0))


@pytest.mark.parametrize("prismatic", [False, True])
def test_a_urdf_joint_moves_about_its_own_axis(prismatic):
    rng = np.random.default_rng(4)
    any_axis = rng.normal(size=3)
    any_axis /= np.linalg.norm(any_axis)
    for axis in (any_axis, np.array([0.0, 0.0, -1.0]), np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0])):
        builder = RobotBuilder("one", "urdf")
        origin = {"x": 0.1, "y": -0.2, "z": 0.3, "roll": 0.4, "pitch": -0.5, "yaw": 0.6}
        builder.add_urdf_joint(Joint("j", prismatic), origin, axis)
        motion = np.eye(4)
        if prismatic:
            motion[:3, 3] = 0.7 * axis
        else:
            motion[:3, :3] = Rotation.from_rotvec(0.7 * axis).as_matrix()
        assert tool_pose(builder.build(), np.array([0.7])) == pytest.approx(frame(**origin) @ motion, abs=rounding(1.0))


@pytest.mark.parametrize(("convention", "n"), diagonal([*CONVENTIONS, "urdf", "poe"], [1, 2, 3, 6, 7, 12], every=3))
def test_poses_and_derivatives_equal_4x4_products_and_central_differences(convention, n):
    rng = np.random.default_rng(100 + n)
    robot = random_robot(convention, n, rng)
    q = rng.uniform(-6, 6, n)
    n_parameters = len(robot.parameters)

    def moved(x):
        return tool_pose(robot, x[n_parameters:], x[:n_parameters])

    x = np.concatenate([robot.nominal, q])
    d_T = central_differences(moved, x)  # (4, 4, n_parameters + n)
    poses = pose(robot, q[None])
    assert poses.rotation[0] == pytest.approx(moved(x)[:3, :3], abs=rounding(1.0))  # rounding of some 100 products
    assert poses.position[0] == pytest.approx(moved(x)[:3, 3], abs=rounding(10.0))
    assert poses.jacobian.shape == (1, 6, n_parameters + n)
    expected = twists(d_T, moved(x))
    # step^2 times third derivatives, arms up to 12 m
    assert poses.jacobian[0, :3] == pytest.approx(expected[:3], abs=1e-8)
    assert poses.jacobian[0, 3:] == pytest.approx(expected[3:], abs=1e-7)


def test_tangent_columns_are_small_motions_of_tool_base_and_measurement_frame_in_themselves():
    rng = np.random.default_rng(5)
    robot = random_robot("mdh", 3, rng)
    q = rng.uniform(-3, 3, (1, 3))
    world_T_base = np.array([0.3, -2.0, 1.0, 2.5, 0.4, -1.0])  # x y z yaw pitch roll
    chain = build_chain(robot, tool_tangent=0, frame_tangent=6, base_tangent=12, frame=True)
    chain = chain.at(np.concatenate([robot.nominal, world_T_base]))
    values = dict(zip([p.name for p in robot.parameters], robot.nominal, strict=True))
    base = frame(*(values[f"base.{k}"] for k in ("x", "y", "z", "roll", "pitch", "yaw")))
    poses = forward(chain, robot.trig(q))
    X = frame(*world_T_base[:3], *world_T_base[:2:-1])

    def small(xi):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(xi[:3]).as_matrix()
        T[:3, 3] = xi[3:]
        return T

    arm = np.linalg.inv(base) @ tool_pose(robot, q[0])
    d_T = central_differences(lambda x: X @ small(x[6:12]) @ base @ small(x[12:]) @ arm @ small(x[:6]), np.zeros(18))
    assert poses.position[0] == pytest.approx((X @ tool_pose(robot, q[0]))[:3, 3], abs=rounding(1.0))
    assert poses.jacobian[0] == pytest.approx(twists(d_T, X @ tool_pose(robot, q[0])), abs=1e-8)


@pytest.mark.parametrize("n", [1, LANES - 1, LANES, LANES + 1, SPAN + 3, 3 * SPAN])
def test_every_row_is_walked_whatever_the_number_of_rows(n):
    rng = np.random.default_rng(n)
    robot = random_robot("dh", 3, rng)
    q = rng.uniform(-3, 3, (n, 3))
    position = forward(build_chain(robot), robot.trig(q)).position
    for i in {0, n // 2, n - 1}:
        assert position[i] == pytest.approx(tool_pose(robot, q[i])[:3, 3], abs=rounding(1.0))


def test_elements_of_the_chain_may_run_against_a_joint():
    rng = np.random.default_rng(7)
    robot = random_robot("mdh", 3, rng)
    flipped = replace(robot, elements=tuple(replace(e, sign=-1) for e in reversed(robot.elements)))
    q = rng.uniform(-3, 3, (1, 3))
    poses = pose(flipped, q)
    T = np.linalg.inv(tool_pose(robot, q[0]))
    assert poses.position[0] == pytest.approx(T[:3, 3], abs=rounding(1.0))
    d_T = central_differences(lambda x: tool_pose(flipped.with_values(x), q[0])[:3, 3], flipped.nominal)
    assert poses.jacobian[0, 3:, : len(d_T[0])] == pytest.approx(d_T, abs=1e-8)


def test_the_oracle_itself_turns_the_right_way():
    assert (rotation(2, np.pi / 2) @ translation(0, 1.0))[:3, 3] == pytest.approx([0, 1, 0])


def test_a_parameter_and_a_joint_of_several_elements_have_the_sum_of_their_derivatives():
    """Also where one of the elements runs against the others, and whatever was walked before."""
    rng = np.random.default_rng(8)
    robot = random_robot("mdh", 3, rng)
    elements = list(robot.elements)
    length, angle = (next(i for i, e in enumerate(elements) if robot.parameters[e.parameter].kind == k) for k in "xa")
    turning = next(i for i, e in enumerate(elements) if e.joint is not None and e.axis >= 3)
    again = [replace(elements[length], axis=2, sign=-1), replace(elements[angle], axis=0, constant=0.4)]
    again += [replace(elements[turning], axis=4, sign=-1), Element(4, parameter=elements[turning].parameter)]
    robot = replace(robot, elements=(*elements[:12], *again, *elements[12:]))
    n, q = len(robot.parameters), rng.uniform(-3, 3, (LANES + 2, 3))
    poses = pose(robot, q)
    for i in (0, LANES + 1):  # a second batch writes over the first one's twists

        def moved(x):
            return tool_pose(robot, x[n:], x[:n])

        x = np.concatenate([robot.nominal, q[i]])
        expected = twists(central_differences(moved, x), moved(x))
        assert poses.jacobian[i, :3] == pytest.approx(expected[:3], abs=1e-8)
        assert poses.jacobian[i, 3:] == pytest.approx(expected[3:], abs=1e-7)  # step^2 times third derivatives


# --- values that are sums of coefficients times functions of readings ------------------------------------------------


FUNCTIONS = {"reading": (lambda q: q, np.ones_like), "sin 2": (lambda q: np.sin(2 * q), lambda q: 2 * np.cos(2 * q))}


@dataclass(frozen=True)
class Coefficients(Effect):
    """Two further elements behind each, of all axes: a function's name, joint, axis and name of each."""

    items: tuple = ()

    def terms(self, robot):
        return [Term(name, 1.0, 1, i // 2, axis, -1 if i % 5 == 0 else 1, j)
                for i, (_, j, axis, name) in enumerate(self.items)]  # fmt: skip

    def values(self, robot, readings, context, at):
        return np.stack(
            [np.stack([f(readings[:, j]) for f in FUNCTIONS[f]], axis=1) for f, j, *_ in self.items], axis=1
        )


def with_coefficients(robot, rng):
    """A robot with such elements, coefficients away from zero, some of them shared."""
    items, functions = [], list(FUNCTIONS)
    for i in range(2 * len(robot.elements)):
        axis, name = Axis(int(rng.integers(6))), items[-1][3] if i % 8 == 7 else ""
        name = name or f"c{i}.{'x' if axis < 3 else 'roll'}"
        items.append((functions[i % 2], int(rng.integers(robot.n_joints)), axis, name))
    n, robot = len(robot.parameters), robot.with_effects(Coefficients(tuple(items)))
    return robot.with_values([*robot.nominal[:n], *rng.uniform(0.1, 0.5, len(robot.parameters) - n)])


def pose_with_coefficients(robot, values, q):
    """base_T_tool as a product of 4x4 matrices."""
    T, items = np.eye(4), robot.effects[0].items
    for e in robot.elements:
        free = 0.0 if e.parameter is None else values[e.parameter]
        if e.basis is not None:
            function, joint, *_ = items[e.basis.term]
            free = free * FUNCTIONS[function][0](q[joint])
        value = e.constant + e.sign * (free + (0.0 if e.joint is None else q[e.joint]))
        T = T @ (translation(e.axis, value) if e.axis < 3 else rotation(e.axis - 3, value))
    return T


@pytest.mark.parametrize("convention", [*CONVENTIONS, "urdf", "poe"])
def test_coefficients_times_functions_of_readings(convention):
    rng = np.random.default_rng(7)
    robot = with_coefficients(random_robot(convention, 4, rng), rng)
    n, q = len(robot.parameters), rng.uniform(-3, 3, (40, 4))
    chain = build_chain(robot, {i: i for i in range(n)}).with_joint_columns()
    poses = forward(chain, robot.trig(q))
    for i in (0, LANES - 1, 39):
        T = pose_with_coefficients(robot, robot.nominal, q[i])
        assert poses.rotation[i] == pytest.approx(T[:3, :3], abs=rounding(1.0))
        assert poses.position[i] == pytest.approx(T[:3, 3], abs=rounding(10.0))

        def formula(x, i=i, T=T):
            there = pose_with_coefficients(robot, x[:n], x[n:])
            turn = Rotation.from_matrix(there[:3, :3] @ T[:3, :3].T).as_rotvec()
            return np.concatenate([turn, there[:3, 3]])

        expected = central_differences(formula, np.concatenate([robot.nominal, q[i]]))
        # Steps of 1e-6 leave third derivatives times 1e-12 and rounding over 1e-6; columns are sums over elements.
        assert poses.jacobian[i] == pytest.approx(expected, abs=1e-7 * max(1.0, np.abs(expected).max()))


def test_coefficients_that_are_fixed_at_zero_do_nothing():
    rng = np.random.default_rng(8)
    robot = random_robot("mdh-hayati", 4, rng)
    more = with_coefficients(robot, rng)
    off = more.with_values([*robot.nominal, *np.zeros(len(more.parameters) - len(robot.parameters))])
    q = rng.uniform(-3, 3, (3, 4))
    assert len(build_chain(off).axis) == len(build_chain(robot).axis)
    assert np.array_equal(forward(build_chain(off), off.trig(q)).position, pose(robot, q).position)
