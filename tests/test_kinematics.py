"""kinematics: the closed forms against the robot's model file, each other, and finite differences."""

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from robot_facts import HOME, arm

from valve_drake.frames import apply, compose, inverse, make, planar, rotation, rotation_vector
from valve_drake.kinematics import ARM_LIMITS, GEOMETRY, R_G0, lateral
from valve_drake.messages import SIDES
from valve_drake.stations.scene import parse

BRANCH_EDGE = 0.05  # of the elbow and the wrist: nearer to straight, an angle has no meaning [rad]


class Model:
    """The robot's own file in a plant."""

    def __init__(self):
        self.plant = MultibodyPlant(0.0)
        parse(self.plant, "robot")
        self.plant.Finalize()
        self.context = self.plant.CreateDefaultContext()

    def set(self, **joints: float) -> None:
        q = np.zeros(self.plant.num_positions())
        for name, value in joints.items():
            q[self.plant.GetJointByName(name).position_start()] = value
        self.plant.SetPositions(self.context, q)

    def set_arm(self, side: str, q: np.ndarray, **others: float) -> None:
        self.set(**{f"{side}_arm_{k + 1}": q[k] for k in range(6)}, **others)

    def pose(self, name: str, base: str = "B") -> np.ndarray:
        """X of one frame in another -> (3, 4)."""
        X = self.plant.GetFrameByName(name).CalcPose(self.context, self.plant.GetFrameByName(base))
        return X.GetAsMatrix34()

    def hand(self, side: str) -> tuple[float, np.ndarray]:
        """Mass of everything beyond the wrist sensor, and its centre of mass in the world."""
        mass, moment = 0.0, np.zeros(3)
        for name in (f"{side}_hand", f"{side}_finger_1_link", f"{side}_finger_2_link"):
            body = self.plant.GetBodyByName(name)
            mass += body.default_mass()
            moment += body.default_mass() * (body.EvalPoseInWorld(self.context) @ body.default_com())
        return mass, moment / mass


@pytest.fixture(scope="module")
def model():
    return Model()


def random_arms(seed: int, count: int, share: float = 1.0):
    """Joint angles within `share` of the limits, alternately of the left and the right arm."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        yield SIDES[k % 2], rng.uniform(-1, 1, 6) * ARM_LIMITS * share


def elbow_out(side: str, q: np.ndarray) -> np.ndarray:
    """The same arm with its elbow on the side that the inverse uses, clear of straight elbow and wrist."""
    q = q.copy()
    q[2] = -lateral(side) * np.clip(abs(q[2]), BRANCH_EDGE, None)
    q[4] = np.copysign(max(abs(q[4]), BRANCH_EDGE), q[4])
    return q


# ---------------------------------------------------------------- against the model file


def test_hand_poses_are_the_models(model):
    for side, q in random_arms(1, 40):
        model.set_arm(side, q)
        assert GEOMETRY.arm_forward(q, side) == pytest.approx(model.pose(f"{side}_grip", "H"), abs=1e-12)


def test_the_chest_turns_with_the_waist(model):
    for side, q in random_arms(2, 6):
        model.set_arm(side, q, waist=0.5)
        X_BG = compose(GEOMETRY.X_BH(0.5), GEOMETRY.arm_forward(q, side))
        assert X_BG == pytest.approx(model.pose(f"{side}_grip"), abs=1e-12)


def test_the_left_eye_is_the_models(model):
    rng = np.random.default_rng(3)
    for waist, pitch, yaw in rng.uniform(-1, 1, (20, 3)) * [0.6, 0.5, 1.6]:
        model.set(waist=waist, neck_pitch=pitch, neck_yaw=yaw)
        assert GEOMETRY.X_BL(np.array([waist, pitch, yaw])) == pytest.approx(model.pose("head_left_camera"), abs=1e-12)


def test_the_head_moves_with_the_base():
    torso = np.array([0.2, 0.3, -0.4])
    base = np.array([1.0, -2.0, 0.7])
    assert GEOMETRY.head_pose(base, torso) == pytest.approx(compose(planar(*base), GEOMETRY.X_BL(torso)))


def test_joint_limits_are_the_models(model):
    for side in SIDES:
        joints = [model.plant.GetJointByName(f"{side}_arm_{k}") for k in range(1, 7)]
        assert [j.position_upper_limits()[0] for j in joints] == ARM_LIMITS.tolist()
        assert [j.position_lower_limits()[0] for j in joints] == (-ARM_LIMITS).tolist()


@pytest.mark.parametrize("opening", [0.0, 0.025, 0.085])
@pytest.mark.parametrize("side", SIDES)
def test_the_hands_weight_beyond_the_sensor_is_the_models(model, side, opening):
    fingers = {f"{side}_finger_{k}": opening / 2 for k in (1, 2)}
    model.set_arm(side, arm(side, HOME), **fingers)
    mass, p_WHand = model.hand(side)
    assert GEOMETRY.hand_mass == pytest.approx(mass, abs=1e-6)
    p_SHand = apply(inverse(model.pose(f"{side}_ft")), p_WHand)  # W is B here
    mirrored = np.array(GEOMETRY.p_SHand) * [lateral(side), 1, 1]
    assert p_SHand == pytest.approx(mirrored, abs=5e-5)


@pytest.mark.parametrize("side", SIDES)
def test_the_wrist_sensor_lies_behind_the_grip_point_with_the_same_axes(model, side):
    model.set_arm(side, HOME)
    X_SG = compose(inverse(model.pose(f"{side}_ft")), model.pose(f"{side}_grip"))
    assert X_SG == pytest.approx(make(np.eye(3), np.array([0, 0, GEOMETRY.grip_behind])), abs=1e-12)


def test_the_jacobian_is_the_models(model):
    for side, q in random_arms(4, 10):
        model.set_arm(side, q)
        H, G = (model.plant.GetFrameByName(name) for name in ("H", f"{side}_grip"))
        J = model.plant.CalcJacobianSpatialVelocity(model.context, JacobianWrtVariable.kQDot, G, np.zeros(3), H, H)
        columns = [model.plant.GetJointByName(f"{side}_arm_{k}").velocity_start() for k in range(1, 7)]
        assert GEOMETRY.arm_jacobian(q, side) == pytest.approx(J[:, columns], abs=1e-12)


# ---------------------------------------------------------------- within itself


def test_the_jacobian_is_the_derivative_of_the_pose():
    step = 1e-6
    for side, q in random_arms(5, 20):
        J = GEOMETRY.arm_jacobian(q, side)
        for k, dq in enumerate(step * np.eye(6)):
            X0, X1 = GEOMETRY.arm_forward(q - dq, side), GEOMETRY.arm_forward(q + dq, side)
            w = rotation_vector(X1[:, :3] @ X0[:, :3].T) / (2 * step)
            v = (X1[:, 3] - X0[:, 3]) / (2 * step)
            assert J[:, k] == pytest.approx(np.concatenate([w, v]), abs=1e-8)


def test_the_right_arm_mirrors_the_left():
    across = np.diag([1.0, -1, 1])
    for _, q in random_arms(6, 20):
        left, right = GEOMETRY.arm_forward(q, "left"), GEOMETRY.arm_forward(arm("right", q), "right")
        assert right[:, 3] == pytest.approx(across @ left[:, 3])
        assert right[:, :3] == pytest.approx(across @ left[:, :3] @ np.diag([-1.0, 1, 1]))


def test_at_zero_the_arms_point_forward():
    for side in SIDES:
        X = GEOMETRY.arm_forward(np.zeros(6), side)
        assert X == pytest.approx(make(R_G0, np.array([0.94, 0.2 * lateral(side), 0])))


def test_inverse_of_forward_is_the_same_arm():
    checked = 0
    for side, q in random_arms(7, 300):
        q = elbow_out(side, q)
        if GEOMETRY.upper_arm * np.cos(q[1]) + GEOMETRY.forearm * np.cos(q[1] + q[2]) < 0:
            continue  # folded over the axis of J1: the inverse takes J1 half a turn on instead
        checked += 1
        solution = GEOMETRY.arm_inverse(GEOMETRY.arm_forward(q, side), side, q)
        assert solution == pytest.approx(q, abs=1e-7)
    assert checked > 100


def test_whatever_the_inverse_gives_reaches_the_pose_within_the_limits():
    rng = np.random.default_rng(8)
    reached = 0
    for k in range(400):
        side = SIDES[k % 2]
        X_HG = make(rotation(rng.normal(size=3)) @ R_G0, rng.uniform([0.1, -0.5, -0.6], [0.9, 0.5, 0.4]))
        near = None if k % 3 else rng.uniform(-1, 1, 6)
        q = GEOMETRY.arm_inverse(X_HG, side, near)
        if q is None:
            continue
        reached += 1
        assert np.all(np.abs(q) <= ARM_LIMITS)
        assert lateral(side) * q[2] <= 0  # elbow out
        assert GEOMETRY.arm_forward(q, side) == pytest.approx(X_HG, abs=1e-9)
    assert reached > 80


def test_the_inverse_stays_on_its_branch_along_a_motion():
    """Both wrist branches, J4 through half a turn: small steps of the hand are small steps of the joints."""
    through = 0
    for side in SIDES:
        for wrist in ((0.3, 1.2, -0.4), (0.3, -1.2, -0.4), (3.13, 1.0, 0.0), (3.15, 1.0, 0.0), (-3.15, 1.0, 2.8)):
            q = arm(side, HOME)
            q = np.concatenate([q[:3], wrist])
            X = GEOMETRY.arm_forward(q, side)
            for k in range(40):
                X = make(rotation(np.array([0.001, 0.002, -0.001])) @ X[:, :3], X[:, 3] + [0.0003, 0.0001, -0.0002])
                near = q
                q = GEOMETRY.arm_inverse(X, side, near)
                assert q is not None and np.max(np.abs(q - near)) < 0.02, (side, wrist, k)
            through += (abs(q[3]) - np.pi) * (abs(wrist[0]) - np.pi) < 0
    assert through >= 2


def test_a_straight_wrist_keeps_its_roll():
    q = np.array([0.3, 0.4, -1.2, 0.7, 0.0, 0.5])
    solution = GEOMETRY.arm_inverse(GEOMETRY.arm_forward(q, "left"), "left", q)
    assert solution == pytest.approx(q, abs=1e-7)


@pytest.mark.parametrize("side", SIDES)
def test_out_of_reach_is_none(side):
    X = GEOMETRY.arm_forward(np.zeros(6), side)
    assert GEOMETRY.arm_inverse(make(X[:, :3], X[:, 3] + [0.001, 0, 0]), side) is None  # beyond the straight arm
    assert (
        GEOMETRY.arm_inverse(make(X[:, :3], GEOMETRY.shoulder(side) + [0.245, 0, 0]), side) is None
    )  # in the shoulder
    assert GEOMETRY.arm_inverse(np.full((3, 4), np.nan), side) is None


@pytest.mark.parametrize("joint", range(6))
def test_beyond_a_joint_limit_is_none_and_a_wrist_roll_is_taken_the_other_way_round(joint):
    for side in SIDES:
        q = elbow_out(side, arm(side, HOME))
        q[joint] = np.copysign(ARM_LIMITS[joint] + 0.02, q[joint])
        solution = GEOMETRY.arm_inverse(GEOMETRY.arm_forward(q, side), side, q)
        if joint in (3, 5):
            q[joint] -= np.copysign(2 * np.pi, q[joint])
            assert solution == pytest.approx(q, abs=1e-9)
        else:
            assert solution is None


def test_margin_is_one_at_home_zero_at_each_limit_and_negative_beyond():
    assert GEOMETRY.arm_margin(HOME) == 1.0
    for joint, angle in ((2, np.deg2rad(20)), (2, np.deg2rad(150)), (4, np.deg2rad(12)), (4, np.deg2rad(118))):
        for sign in (1, -1):
            q = HOME.copy()
            q[joint] = sign * angle
            assert GEOMETRY.arm_margin(q) == pytest.approx(0.0 if angle < ARM_LIMITS[joint] else -0.0, abs=1e-9)
    q = HOME.copy()
    q[0] = ARM_LIMITS[0] - np.deg2rad(10)
    assert GEOMETRY.arm_margin(q) == pytest.approx(0.25)
    for joint in (0, 1, 3, 5):
        for past, sign in ((0.0, 0), (-0.1, 1), (0.1, -1)):
            q = HOME.copy()
            q[joint] = ARM_LIMITS[joint] + past
            assert np.sign(round(GEOMETRY.arm_margin(q), 9)) == sign


def test_sides_are_left_and_right_only():
    assert (lateral("left"), lateral("right")) == (1, -1)
    with pytest.raises(KeyError):
        lateral("middle")
