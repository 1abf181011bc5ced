"""The robot, the valve and the laboratory: what the rest of the program takes for granted about them."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
    Role,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import WeldJoint
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo, RgbdSensor
from robot_facts import AT_VALVE, HOME, arm

MODELS = Path(__file__).parents[1] / "models"
SIDES = {"left": 1, "right": -1}
TRUNK = ["base_x", "base_y", "base_yaw", "waist", "neck_yaw", "neck_pitch"]
ARMS = [f"{side}_arm_{k}" for side in SIDES for k in range(1, 7)]


class World:
    """A plant with the named models, its diagram and a Context."""

    def __init__(self, *names, step=1 / 512, cameras=()):
        builder = DiagramBuilder()
        self.plant, self.scene = AddMultibodyPlantSceneGraph(builder, step)
        parser = Parser(self.plant)
        parser.package_map().AddPackageXml(str(MODELS / "package.xml"))
        for name in names:
            parser.AddModelsFromUrl(f"package://valve_drake_models/{name}/{name}.sdf")
        if "valve" in names:
            self.plant.WeldFrames(self.plant.world_frame(), self.frame("valve_axis"))
        self.plant.Finalize()
        if cameras:
            self.scene.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
        self.cameras = {name: builder.AddSystem(self._camera(name)) for name in cameras}
        for camera in self.cameras.values():
            builder.Connect(self.scene.get_query_output_port(), camera.query_object_input_port())
        self.diagram = builder.Build()
        self.root = self.diagram.CreateDefaultContext()
        self.context = self.plant.GetMyContextFromRoot(self.root)

    def _camera(self, name, pixels=(160, 120)):
        core = RenderCameraCore("vtk", CameraInfo(*pixels, 1.2), ClippingRange(0.002, 5), RigidTransform())
        frame = self.frame(name)
        return RgbdSensor(
            parent_id=self.plant.GetBodyFrameIdOrThrow(frame.body().index()),
            X_PB=frame.GetFixedPoseInBodyFrame(),
            color_camera=ColorRenderCamera(core, False),
            depth_camera=DepthRenderCamera(core, DepthRange(0.002, 5)),
        )

    def frame(self, name):
        return self.plant.GetFrameByName(name)

    def joint(self, name):
        return self.plant.GetJointByName(name)

    def pose(self, name):
        """X_W<name> as (4, 4)."""
        return self.frame(name).CalcPoseInWorld(self.context).GetAsMatrix4()

    def set(self, name, value):
        q = self.plant.GetPositions(self.context)
        q[self.joint(name).position_start()] = value
        self.plant.SetPositions(self.context, q)

    def set_arms(self, left):
        for side in SIDES:
            for k, q in enumerate(arm(side, left)):
                self.set(f"{side}_arm_{k + 1}", q)

    def touching(self):
        query = self.scene.get_query_output_port().Eval(self.scene.GetMyContextFromRoot(self.root))
        name = query.inspector().GetName
        return [(name(pair.id_A), name(pair.id_B)) for pair in query.ComputePointPairPenetration()]

    def mass(self, *bodies):
        return sum(self.plant.GetBodyByName(body).default_mass() for body in bodies)


@pytest.fixture
def robot():
    return World("robot")


@pytest.fixture
def valve():
    return World("valve")


def vertices(mesh):
    text = (MODELS / "meshes" / mesh).read_text()
    return np.array([[float(c) for c in row.split()] for row in re.findall(r"^v (.*)$", text, re.M)])


# ---------------------------------------------------------------- robot


def test_joints_come_in_the_agreed_order(robot):
    hands = [f"{side}_{name}" for side in SIDES for name in ("wrist_sensor", "finger_1", "finger_2")]
    names = [robot.plant.get_joint(k).name() for k in robot.plant.GetJointIndices()]
    assert names == [*TRUNK, *ARMS, *hands]


def test_actuators_are_the_joints_in_order_and_of_the_fingers_only_the_first(robot):
    actuators = [robot.plant.get_joint_actuator(k) for k in robot.plant.GetJointActuatorIndices()]
    assert [a.joint().name() for a in actuators] == [*TRUNK, *ARMS, "left_finger_1", "right_finger_1"]
    assert [a.name() for a in actuators] == [a.joint().name() for a in actuators]


@pytest.mark.parametrize("side", SIDES)
def test_arm_limits_and_servos(robot, side):
    limits = [2.97, 2.09, 2.62, 3.32, 2.09, 3.14]
    speeds = [2.5, 2.5, 2.5, 4, 4, 4]
    efforts = [150, 150, 100, 50, 40, 30]
    stiffness = [8000, 8000, 6000, 3000, 2000, 1500]
    rotors = [0.15, 0.15, 0.1, 0.05, 0.03, 0.03]
    for k in range(6):
        joint = robot.joint(f"{side}_arm_{k + 1}")
        actuator = robot.plant.GetJointActuatorByName(joint.name())
        assert joint.position_upper_limits() == limits[k] == -joint.position_lower_limits()
        assert joint.velocity_upper_limits() == speeds[k] == -joint.velocity_lower_limits()
        assert actuator.effort_limit() == efforts[k]
        assert actuator.get_controller_gains().p == stiffness[k]
        assert actuator.default_reflected_inertia() == pytest.approx(rotors[k])


def test_trunk_limits_and_servos(robot):
    wanted = {
        "base_x": (np.inf, 2000, 4e4, 4000),
        "base_y": (np.inf, 2000, 4e4, 4000),
        "base_yaw": (np.inf, 1000, 2e4, 2000),
        "waist": (0.6, 200, 5000, 200),
        "neck_yaw": (1.6, 40, 300, 8),
        "neck_pitch": (1.1, 40, 300, 8),
    }
    for name, (upper, effort, p, d) in wanted.items():
        actuator = robot.plant.GetJointActuatorByName(name)
        gains = actuator.get_controller_gains()
        assert (robot.joint(name).position_upper_limits()[0], actuator.effort_limit()) == (upper, effort)
        assert (gains.p, gains.d) == (p, d)
    assert robot.joint("neck_pitch").position_lower_limits() == -0.5


@pytest.mark.parametrize("arms", [HOME, AT_VALVE], ids=["home", "at the valve"])
def test_arm_servos_are_well_damped(robot, arms):
    robot.set_arms(arms)
    M = robot.plant.CalcMassMatrix(robot.context)
    for name in ARMS:
        gains = robot.plant.GetJointActuatorByName(name).get_controller_gains()
        k = robot.joint(name).velocity_start()
        assert 0.6 < gains.d / (2 * np.sqrt(gains.p * M[k, k])) < 1.0, name


def test_frames_at_zero(robot):
    forward, left, up = np.eye(3)
    optical = np.column_stack([-left, -up, forward])
    grip = np.column_stack([left, up, forward])
    wanted = {"B": ((0, 0, 0), np.eye(3)), "H": ((0, 0, 1.05), np.eye(3))}
    for side, s in SIDES.items():
        wanted[f"head_{side}_camera"] = ((0.02, s * 0.06, 1.42), optical)
        wanted[f"{side}_shoulder"] = ((0, s * 0.20, 1.05), np.eye(3))
        wanted[f"{side}_forearm"] = ((0.36, s * 0.20, 1.05), np.eye(3))
        for k in (1, 2, 3):
            wanted[f"{side}_wrist_{k}"] = ((0.70, s * 0.20, 1.05), np.eye(3))
        wanted[f"{side}_ft"] = ((0.80, s * 0.20, 1.05), grip)
        wanted[f"{side}_grip"] = ((0.94, s * 0.20, 1.05), grip)
    for name, (p, R) in wanted.items():
        X = robot.pose(name)
        assert X[:3, 3] == pytest.approx(p, abs=1e-12), name
        assert X[:3, :3] == pytest.approx(R, abs=1e-12), name


@pytest.mark.parametrize("side", SIDES)
def test_wrist_camera_sits_outside_the_hand_and_looks_at_the_grip_point(robot, side):
    X = np.linalg.inv(robot.pose(f"{side}_grip")) @ robot.pose(f"{side}_wrist_camera")
    assert X[:3, 3] == pytest.approx([SIDES[side] * 0.075, 0, -0.13], abs=1e-9)
    assert X[:3, 2] == pytest.approx(-X[:3, 3] / np.linalg.norm(X[:3, 3]), abs=1e-9)
    assert X[:3, 0] == pytest.approx([0, 1, 0], abs=1e-9)


@pytest.mark.parametrize(
    ("joint", "frame", "direction"),
    [
        ("waist", "left_grip", (0, 1, 0)),  # turns left
        ("neck_yaw", "head_left_camera", (0, 1, 0)),
        ("neck_pitch", "head_left_camera", (0, 0, -1)),  # looks down
        ("left_arm_1", "left_grip", (0, 0, -1)),
        ("left_arm_2", "left_grip", (0, 1, 0)),
        ("right_arm_3", "right_grip", (0, 1, 0)),  # same axes on both sides
        ("left_arm_5", "left_grip", (0, 1, 0)),
    ],
)
def test_positive_sense_of_the_joints(robot, joint, frame, direction):
    before = robot.pose(frame)
    robot.set(joint, 0.1)
    camera = frame.endswith("camera")
    moved = robot.pose(frame)[:3, 2] - before[:3, 2] if camera else robot.pose(frame)[:3, 3] - before[:3, 3]
    assert moved @ direction > 0.9 * np.linalg.norm(moved) > 0


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("joint", [4, 6])
def test_wrist_rolls_turn_the_hand_about_the_forearm(robot, side, joint):
    before = robot.pose(f"{side}_grip")
    robot.set(f"{side}_arm_{joint}", 0.3)
    after = robot.pose(f"{side}_grip")
    assert after[:3, 3] == pytest.approx(before[:3, 3], abs=1e-12)
    assert after[:3, 0] @ before[:3, 1] == pytest.approx(np.sin(0.3))


def test_masses(robot):
    links = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
    for side in SIDES:
        assert robot.mass(*[f"{side}_{name}" for name in links]) == pytest.approx(10.1)
        hand = robot.mass(*[f"{side}_{name}" for name in ("hand", "finger_1_link", "finger_2_link")])
        assert hand == pytest.approx(0.86, abs=0.05)
    assert robot.mass("base") == pytest.approx(60)
    assert 100 < robot.plant.CalcTotalMass(robot.context) < 108
    assert robot.plant.GetBodyByName("base").CalcCenterOfMassInBodyFrame(robot.context)[2] < 0.25


@pytest.mark.parametrize("arms", [HOME, AT_VALVE, np.array([0.4, -0.3, -1.2, 0.9, -0.7, 1.1])])
def test_arms_are_mirror_images(robot, arms):
    robot.set_arms(arms)
    X_left, X_right = robot.pose("left_grip"), robot.pose("right_grip")
    across = np.diag([1, -1, 1])  # the plane y = 0; a hand's own mirror image has its x axis turned round
    assert X_right[:3, 3] == pytest.approx(across @ X_left[:3, 3], abs=1e-12)
    assert X_right[:3, :3] == pytest.approx(across @ X_left[:3, :3] @ np.diag([-1, 1, 1]), abs=1e-12)


def test_arms_weigh_alike(robot):
    left, right = ([robot.plant.GetBodyByName(f"{side}_{name}").default_spatial_inertia().CopyToFullMatrix6()
                    for name in ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3", "finger_1_link")]
                   for side in SIDES)  # fmt: skip
    assert np.array_equal(left, right)


@pytest.mark.parametrize("arms", [0 * HOME, HOME], ids=["zero", "home"])
def test_nothing_touches_at_rest(robot, arms):
    robot.set_arms(arms)
    assert robot.touching() == []


def test_hands_still_collide_with_chest_and_with_each_other(robot):
    robot.set_arms(np.array([1.05, 0.65, -2.6, 0.0, 0.0, 0.0]))
    pairs = robot.touching()
    assert any("torso" in name for pair in pairs for name in pair)
    robot.set_arms(np.array([0.0, -0.3, 0.0, 0.0, 0.0, 0.0]))
    assert any(a == b for a, b in robot.touching())


def test_fingers_are_coupled_and_pads_meet_in_the_middle(robot):
    assert robot.plant.num_constraints() == 2
    simulator = Simulator(robot.diagram, robot.root)
    for side in SIDES:
        robot.set(f"{side}_finger_1", 0.030)
        robot.set(f"{side}_finger_2", 0.020)  # violates the coupling: pulled together
    simulator.AdvanceTo(0.05)
    for side in SIDES:
        q = [robot.joint(f"{side}_finger_{k}").get_translation(robot.context) for k in (1, 2)]
        assert q[0] == pytest.approx(q[1], abs=1e-4)
    inspector = robot.scene.model_inspector()
    for k, s in ((1, 1), (2, -1)):
        body = robot.plant.GetBodyByName(f"left_finger_{k}_link")
        pads = [g for g in robot.plant.GetCollisionGeometriesForBody(body) if "pad" in inspector.GetName(g)]
        centres = np.array([inspector.GetPoseInFrame(g).translation() for g in pads])
        radii = {inspector.GetShape(g).radius() for g in pads}
        assert (len(pads), radii) == (6, {0.004})
        assert centres[:, 1] == pytest.approx(np.full(6, s * 0.004))  # tangent to the closing plane
        assert np.ptp(centres, axis=0) + 0.008 == pytest.approx([0.030, 0.008, 0.024])
        for g in pads:
            properties = inspector.GetProximityProperties(g)
            friction = properties.GetProperty("material", "coulomb_friction")
            assert (friction.static_friction(), friction.dynamic_friction()) == (0.8, 0.8)
            assert properties.GetProperty("material", "point_contact_stiffness") == 5e4


def test_wrist_sensors_are_welds_that_feel_the_hand(robot):
    simulator = Simulator(robot.diagram, robot.root)
    for side in SIDES:
        assert isinstance(robot.joint(f"{side}_wrist_sensor"), WeldJoint)
    for name in TRUNK + ARMS:
        robot.joint(name).Lock(robot.context)
    simulator.AdvanceTo(0.5)
    forces = robot.plant.get_reaction_forces_output_port().Eval(robot.context)
    for side in SIDES:
        force = forces[int(robot.joint(f"{side}_wrist_sensor").index())].translational()
        assert force == pytest.approx([0, 0.86 * 9.81, 0], abs=0.02)  # y of the sensor is up at zero


def test_nothing_blocks_the_wrist_cameras_view_of_a_handle():
    world = World("robot", cameras=[f"{side}_wrist_camera" for side in SIDES])
    for side in SIDES:
        for k in (1, 2):
            world.set(f"{side}_finger_{k}", 0.045)
    for side, s in SIDES.items():
        camera = world.cameras[f"{side}_wrist_camera"]
        depth = camera.depth_image_32F_output_port().Eval(camera.GetMyContextFromRoot(world.root)).data[:, :, 0]
        K = CameraInfo(160, 120, 1.2).intrinsic_matrix()
        X = np.linalg.inv(world.pose(f"{side}_wrist_camera")) @ world.pose(f"{side}_grip")
        ahead = np.array([-s * 0.075, 0, 0.13]) / np.hypot(0.075, 0.13)
        for further in (0.0, 0.075, 0.15):
            corners = np.array([[x, y, 0, 1] for x in (-0.020, 0.020) for y in (-0.0125, 0.0125)])
            corners[:, :3] += further * ahead
            points = (corners @ X.T)[:, :3]
            pixels = (points @ K.T)[:, :2] / points[:, 2:]
            (u0, v0), (u1, v1) = np.floor(pixels.min(0)).astype(int), np.ceil(pixels.max(0)).astype(int)
            assert depth[v0 : v1 + 1, u0 : u1 + 1].min() > points[:, 2].max(), (side, further)
        assert np.isfinite(depth).any()  # the camera does see the palm: the test is not blind


# ---------------------------------------------------------------- valve


def test_positive_stem_angle_opens_counter_clockwise_seen_from_the_robot(valve):
    stem = valve.joint("stem")
    assert stem.position_upper_limits() == np.inf == -stem.position_lower_limits()
    assert valve.plant.GetJointActuatorByName("stem").effort_limit() == 5.1
    stem.set_angle(valve.context, np.pi / 2)
    assert valve.pose("handle_1")[:3, 3] == pytest.approx([0, -0.15, -0.09], abs=1e-12)  # right goes up (y is down)


def test_valve_frames_and_mass(valve):
    for name, p in {"handle_1": (0.15, 0, -0.09), "handle_2": (-0.15, 0, -0.09), "marker": (0, 0, -0.131)}.items():
        assert valve.pose(name) == pytest.approx(RigidTransform(p).GetAsMatrix4(), abs=1e-12)
    assert valve.mass("wheel") == pytest.approx(1.6)


def test_handles_are_the_bar_alone_and_leave_room_for_the_hands():
    parts = np.vstack([vertices(path.name) for path in sorted((MODELS / "meshes").glob("wheel_*.obj"))])
    outer = parts[abs(parts[:, 0]) > 0.105]
    assert len(outer) and abs(outer[:, 0]).max() <= 0.18
    assert abs(outer[:, 1]).max() <= 0.0125 and abs(outer[:, 2] + 0.09).max() <= 0.0125 + 1e-9
    assert parts[:, 2].min() == pytest.approx(-0.13)  # the plate behind the marker
    assert vertices("wheel_face.obj")[:, :2].max() <= 0.075


def test_marks_lie_on_the_front_of_the_bar(valve):
    inspector = valve.scene.model_inspector()
    frame = valve.plant.GetBodyFrameIdOrThrow(valve.plant.GetBodyByName("wheel").index())
    marks = [g for g in inspector.GetGeometries(frame, Role.kIllustration) if "mark" in inspector.GetName(g)]
    places = sorted(tuple(inspector.GetPoseInFrame(g).translation()) for g in marks)
    assert places == [(-0.15, 0, -0.103), (0.15, 0, -0.103)]
    for g in marks:
        assert tuple(inspector.GetShape(g).size()) == (0.040, 0.022, 0.001)
        color = inspector.GetIllustrationProperties(g).GetProperty("phong", "diffuse")
        assert (color.r(), color.g(), color.b()) == pytest.approx((0.05, 0.55, 0.15), abs=1e-6)


# ---------------------------------------------------------------- laboratory and meshes


def test_laboratory_is_for_the_eyes_only():
    laboratory = World("laboratory")
    inspector = laboratory.scene.model_inspector()
    assert inspector.NumGeometriesWithRole(Role.kProximity) == 0
    assert inspector.NumGeometriesWithRole(Role.kPerception) > 15
    assert laboratory.plant.num_positions() == 0


def test_red_and_green_things_stand_clear_of_the_valve_and_of_the_way():
    coloured = re.findall(r"laboratory_(\w+)\.obj</uri></mesh></geometry>\s*<material><diffuse>([\d. ]+)",
                          (MODELS / "laboratory" / "laboratory.sdf").read_text())  # fmt: skip
    found = 0
    for name, diffuse in coloured:
        r, g, b, _ = (float(c) for c in diffuse.split())
        if max(r, g) < 2 * min(r, g):
            continue
        found += 1
        points = vertices(f"laboratory_{name}.obj")
        assert np.linalg.norm(points[:, :2], axis=1).min() > 1.2, name
        assert not ((points[:, 0] < 0.5) & (abs(points[:, 1]) < 4.4)).any(), name
    assert found == 6  # plant and exit sign, extinguisher, tool box, hand wheel, crate, warning sign


@pytest.mark.system
def test_meshes_are_what_the_script_makes_and_small(tmp_path):
    spec = importlib.util.spec_from_file_location("make_meshes", MODELS / "make_meshes.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.write(tmp_path)
    kept = {path.name: path.read_bytes() for path in (MODELS / "meshes").iterdir()}
    assert kept == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert sum(map(len, kept.values())) < 1_500_000
    used = {name for sdf in MODELS.glob("*/*.sdf") for name in re.findall(r"meshes/(\w+\.obj)", sdf.read_text())}
    assert used == set(kept)
