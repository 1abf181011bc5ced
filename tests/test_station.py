"""stations: the contract, and the simulated station that keeps it."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from robot_facts import GROUPS, ROBOT

from valve_drake import scenario as scenarios
from valve_drake.camera.lens import Lens, OpenCvLens
from valve_drake.diagram import initial_commands, make_station
from valve_drake.frames import apply, compose, inverse, make, planar
from valve_drake.messages import SIDES
from valve_drake.recording import schemas
from valve_drake.stations import camera_rig, contract, simulated
from valve_drake.stations.scene import panel_pose, start_pose
from valve_drake.stations.simulation_config import ErrorConfig, StartConfig, ValveConfig

PERFECT = [
    f"simulation.error.{name}=0"
    for name in ("head_yaw", "head_rotation", "head_mount", "odometry_scale", "odometry_noise", "arm_offset")
] + [f"simulation.error.wrench_{kind}=0" for kind in ("noise_force", "noise_torque", "bias_force", "bias_torque")]
NEAR = [
    "simulation.start.distance=0.9",
    "simulation.start.bearing=0",
    "simulation.start.heading=0",
    "simulation.valve.height=1.0",
    "simulation.valve.yaw=0",
    "simulation.valve.tilt=0",
    "simulation.valve.bar_angle=0",
    "simulation.valve.friction=5.1",
    "simulation.light.red_gain=1",
    "simulation.light.blue_gain=1",
    "simulation.camera.noise=0",
    "simulation.camera.blur=0",
]


class Rig:
    """The simulated station alone, its inputs held by hand."""

    def __init__(self, overrides=(), **commands):
        self.scenario = scenarios.resolve(scenarios.load(None, [*PERFECT, *NEAR, *overrides]))
        self.station = make_station(self.scenario)
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        for name, value in (initial_commands(self.scenario) | commands).items():
            self.station.GetInputPort(name).FixValue(self.context, value)
        self.simulator.Initialize()

    def set(self, name, value):
        self.station.GetInputPort(name).FixValue(self.context, value)

    def read(self, name):
        return self.station.GetOutputPort(name).Eval(self.context)

    def header(self, camera):
        """The capture that a camera would show now, without making its image."""
        system = self.station.GetSubsystemByName(camera)
        inner = system.GetMyContextFromRoot(self.context)
        return inner.get_abstract_state(0).get_value().delivered

    def run(self, time):
        self.simulator.AdvanceTo(time)
        return self


@pytest.fixture(scope="module")
def rig():
    return Rig().run(0.5)


def test_the_simulated_station_exports_exactly_the_contract(rig):
    contract.check_contract(rig.station, GROUPS)
    extra = set(contract.ports_of(rig.station)) - {spec.name for spec in contract.CONTRACT}
    assert extra == {f"truth.{name}" for name in (*simulated.TruthSystem.OUTPUTS, "contacts")}


def test_check_contract_names_what_is_missing_extra_and_different():
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource(np.zeros(4)))
    builder.ExportOutput(source.get_output_port(), "base.odometry")
    other = builder.AddSystem(ConstantVectorSource(np.zeros(4)))
    builder.ExportOutput(other.get_output_port(), "base.mood")
    diagram = builder.Build()
    diagram.set_name("wrong")
    with pytest.raises(TypeError) as caught:
        contract.check_contract(diagram, GROUPS)
    for words in ("missing health", "extra base.mood", "base.odometry is ('out', 4), not ('out', 5)"):
        assert words in str(caught.value)


def test_the_robot_stands_still_at_home(rig):
    for side in SIDES:
        home = initial_commands(rig.scenario)[f"{side}_arm.position_command"]
        np.testing.assert_allclose(rig.read(f"{side}_arm.position_measured"), home, atol=2e-4)
        assert np.abs(rig.read(f"{side}_arm.velocity_measured")).max() < 1e-3
        assert rig.read(f"{side}_gripper.position_measured")[0] == pytest.approx(0.085, abs=1e-4)
    np.testing.assert_allclose(rig.read("base.odometry"), 0, atol=1e-4)


def test_a_wrist_sensor_feels_the_hands_weight_downwards(rig):
    for side in SIDES:
        R_BG = ROBOT.forward(side, rig.read(f"{side}_arm.position_measured"))[:, :3]
        force = R_BG @ rig.read(f"{side}_wrist.wrench")[3:]
        np.testing.assert_allclose(force, [0, 0, -9.81 * ROBOT.hands[side].mass], atol=0.05)


def test_arms_follow_positions_and_report_torque():
    rig = Rig().run(0.1)
    goal = initial_commands(rig.scenario)["left_arm.position_command"] + np.array([-0.1, 0, 0, 0, 0, 0])
    rig.set("left_arm.position_command", goal)
    rig.run(0.8)
    np.testing.assert_allclose(rig.read("left_arm.position_measured"), goal, atol=1e-3)
    assert 3 < abs(rig.read("left_arm.torque_measured")[0]) < 40  # carries the arm


def true_arm(rig, side):
    """Joint angles of an arm in the plant, as no controller knows them."""
    physics = rig.station.GetSubsystemByName("plant")
    inner = physics.plant_context(rig.context)
    return np.array([physics.plant.GetJointByName(name).get_angle(inner) for name in GROUPS.names(f"{side}_arm")])


def test_joints_bear_their_weight_without_a_sag(rig):
    home = initial_commands(rig.scenario)
    for side in SIDES:
        np.testing.assert_allclose(true_arm(rig, side), home[f"{side}_arm.position_command"], atol=1e-6)
    physics = rig.station.GetSubsystemByName("plant")
    context = physics.plant_context(rig.context)  # which feeds gravity forward, too
    port = physics.plant.get_net_actuation_output_port(physics.robot)
    np.testing.assert_allclose(
        port.Eval(context),
        physics.GetOutputPort("now").Eval(physics.GetMyContextFromRoot(rig.context))[physics.parts["actuation"]],
        atol=1e-3,
    )


def test_an_arm_with_a_wrong_zero_goes_to_where_its_encoders_read_the_command():
    error = ErrorConfig(arm_offset=0.004)
    offsets = simulated.arm_offsets(error, 3, ROBOT)
    all_of_them = np.concatenate(list(offsets.values()))
    assert len(set(np.abs(all_of_them))) == 12 and 0.002 < all_of_them.std() < 0.007
    rig = Rig(["simulation.error.arm_offset=0.004", "seed=3"])
    home = initial_commands(rig.scenario)
    for side in SIDES:  # from the first moment: it does not start with a jump
        np.testing.assert_allclose(true_arm(rig, side), home[f"{side}_arm.position_command"] - offsets[side], atol=1e-9)
    goal = home["left_arm.position_command"] + np.array([-0.1, 0, 0, 0, 0, 0])
    rig.set("left_arm.position_command", goal)
    rig.run(0.8)
    read = rig.read("left_arm.position_measured")
    np.testing.assert_allclose(read, goal, atol=1e-3)
    np.testing.assert_allclose(read - true_arm(rig, "left"), offsets["left"], atol=1e-12)


def test_the_base_drives_like_a_differential_drive_and_odometry_agrees_without_errors():
    rig = Rig(["simulation.start.distance=3"], **{"base.twist_command": np.array([0.2, 0.5])}).run(1.0)
    x, y, heading, forward, rate = rig.read("base.odometry")
    assert heading == pytest.approx(0.5, abs=0.02) and rate == pytest.approx(0.5, abs=0.01)
    assert forward == pytest.approx(0.2, abs=0.01)
    assert np.hypot(x, y) == pytest.approx(2 * 0.2 / 0.5 * np.sin(0.25), abs=0.01)  # chord of the arc
    rig.set("base.twist_command", np.zeros(2))
    rig.run(1.5)
    x, y, heading, _, _ = rig.read("base.odometry")
    np.testing.assert_allclose(rig.read("truth.base_pose"), [-3 + x, y, heading], atol=2e-3)


@pytest.mark.system
@pytest.mark.parametrize("scale, seed, drift", [(0.0, 2, 1.0), (0.05, 2, 0.983), (0.1, 2, 0.966), (0.05, 3, 1.009)])
def test_odometry_drifts_by_a_share_of_the_way_that_the_seed_draws(scale, seed, drift):
    settings = [f"simulation.error.odometry_scale={scale}", "simulation.start.distance=3", f"seed={seed}"]
    rig = Rig(settings, **{"base.twist_command": np.array([0.3, 0.0])})
    shares = []
    for until in (1.0, 2.0):
        rig.run(until)
        shares.append(rig.read("base.odometry")[0] / (rig.read("truth.base_pose")[0] + 3))
    assert shares == pytest.approx([drift, drift], abs=2e-3)  # of the way, however long it is


@pytest.mark.parametrize("limit", [30.0, 60.0])
def test_the_gripper_presses_with_its_force_limit(limit):
    shut = {"left_gripper.position_command": np.array([-0.02]), "left_gripper.force_limit": np.array([limit])}
    rig = Rig(**shut).run(1.0)  # the pads meet at 0: commanded beyond it they press
    assert rig.read("left_gripper.position_measured")[0] == pytest.approx(0.0, abs=1e-4)
    assert rig.read("left_gripper.force_measured")[0] == pytest.approx(limit, abs=0.5)


def test_the_valve_does_not_move_by_itself_and_truth_has_its_pose(rig):
    angle, rate = rig.read("truth.valve_angle")
    assert abs(angle) < 1e-6 and abs(rate) < 1e-6
    X_WV = rig.read("truth.marker_pose").reshape(3, 4)
    np.testing.assert_allclose(X_WV, [[0, 0, 1, -0.131], [-1, 0, 0, 0], [0, -1, 0, 1.0]], atol=1e-6)


@pytest.mark.parametrize("camera", ["head_left", "head_right"])
def test_a_rendered_marker_lies_where_the_lens_says_to_a_twentieth_of_a_pixel(camera):
    """Half-pixel conventions of renderer, lens and OpenCV, the camera's mounting and eq. (1), all at once."""
    from valve_drake.camera.lens import load_head
    from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segment
    from valve_drake.perception.line_fitting import LineFittingConfig, fit_quads
    from valve_drake.perception.quadrilateral import meet, side_lines
    from valve_drake.resources import models

    rig = Rig(
        [  # a little optical blur, as any camera has: without it an edge along a pixel row has no sub-pixel place
            "simulation.camera.blur=0.6",
            "simulation.camera.jpeg_quality=100",
            "simulation.start.distance=1.3",
        ],
        **{"torso.position_command": np.array([0.0, 0.32, 0.0])},
    ).run(0.6)
    head = load_head(models() / "calibration" / "head.yaml")
    frame = rig.read(f"{camera}.image")
    side = camera.removeprefix("head_")
    candidates, _ = segment(frame.image, ColorSegmentationConfig())
    quad = fit_quads([frame.image], [candidates[0].corners], LineFittingConfig())[0]
    base = rig.read("truth.base_pose")
    X_WL = compose(planar(*base), ROBOT.X_BL(rig.read("torso.position_measured")))
    X_WC = X_WL if side == "left" else compose(X_WL, head.X_LR)
    X_CV = compose(inverse(X_WC), rig.read("truth.marker_pose").reshape(3, 4))
    lens = getattr(head, side)
    w, h = rig.scenario.valve.marker.size
    corners = apply(X_CV, np.array([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]]) / 2)
    true = corners[:, :2] / corners[:, 2:] * lens.k_x  # without the lens's distortion, in which sides are straight
    fitted = meet(side_lines(lens.normalize(quad.points) * lens.k_x, quad.side)[0])
    fitted = fitted[[int(np.argmin(((fitted - p) ** 2).sum(-1))) for p in true]]
    assert np.linalg.norm((fitted - true).mean(axis=0)) < 0.03  # half a pixel of convention would show at once
    assert np.linalg.norm(fitted - true, axis=1).max() < 0.1


def test_a_head_with_opencv_lenses_renders_what_the_same_head_with_the_papers_lenses_renders():
    """`calibrate stereo` writes OpenCV's lenses: a calibration of one's own may be the simulated robot's, too."""
    images = []
    for lens in (
        Lens(k_u=0.0, k_v=0.0, k_x=1082.3, k_y=1067.8, u_0=324.6, v_0=248.3),
        OpenCvLens(np.array([[1082.3, 0, 324.6], [0, 1067.8, 248.3], [0, 0, 1]]), np.zeros(5)),
    ):
        image = np.zeros((800, 1200, 4), np.uint8)
        image[::7, ::5] = 255
        images.append(camera_rig._Lensed(lens)(image))
    assert images[0].any()
    np.testing.assert_array_equal(*images)


def test_a_camera_that_nobody_reads_is_not_rendered_and_a_late_reader_sees_the_capture(monkeypatch):
    count = []
    real = camera_rig.CameraRig.frame
    monkeypatch.setattr(camera_rig.CameraRig, "frame", lambda *a: (count.append(a[1]), real(*a))[1])
    rig = Rig().run(0.3)
    assert count == []
    frame = rig.read("head_left.image")
    assert frame.time == 0.125 and frame.sequence == 1 and frame.image.shape == (480, 640, 3)
    assert rig.read("head_left.image") is frame and count == ["head_left"]


@pytest.mark.system
def test_same_seed_same_image_other_seed_other_noise():
    noisy = ["simulation.camera.noise=2"]
    a, b, c = (Rig([*noisy, f"seed={s}"]).run(0.07).read("head_left.image") for s in (1, 1, 2))
    assert a.data == b.data != c.data


def test_noise_lightens_as_much_as_it_darkens_and_is_as_strong_as_asked_for():
    clean, noisy = (Rig([f"simulation.camera.noise={n}"]).run(0.07).read("head_left.image").image for n in (0, 3))
    inside = (clean > 20) & (clean < 235)  # nothing is clipped there
    error = (noisy.astype(float) - clean)[inside]
    # JPEG rounds a plain wall, all of it to one side, by up to half a level; half of the noise alone has a mean of 1.2.
    assert inside.mean() > 0.5 and abs(error.mean()) < 0.5
    assert error.std() == pytest.approx(3.0, rel=0.1)


def test_start_pose_puts_the_robot_at_its_distance_bearing_and_heading():
    valve = ValveConfig(height=1.0, yaw=0.4)
    x, y, heading = start_pose(StartConfig(distance=3.0, bearing=0.5, heading=0.2), valve)
    assert np.hypot(x, y) == pytest.approx(3.0)
    normal = -panel_pose(valve)[:2, 2]  # out of the panel
    assert np.arccos(normal @ np.array([x, y]) / 3.0) == pytest.approx(0.5)
    assert heading - np.arctan2(-y, -x) == pytest.approx(0.2)


def test_true_head_is_the_calibration_when_there_are_no_errors():
    from valve_drake.camera.lens import load_head
    from valve_drake.resources import models

    head = load_head(models() / "calibration" / "head.yaml")
    zero = ErrorConfig(**{name: 0.0 for name in vars(ErrorConfig())})
    mounts = simulated.true_head(head, zero, 1, "eye")
    np.testing.assert_array_equal(mounts["head_left"].X_FC, make(np.eye(3), np.zeros(3)))
    np.testing.assert_allclose(mounts["head_right"].X_FC, head.X_LR)


@pytest.mark.parametrize("latency", [0.0, 1 / 64, 1 / 8, 3 / 16])
def test_an_image_is_there_when_its_latency_has_passed_and_not_before(latency):
    rig = Rig([f"simulation.camera.latency={latency}"])
    for k in range(1, 40):
        now = rig.run(k / 128).context.get_time()  # before the updates at `now`
        arrived = int(np.ceil((now - latency) / 0.125)) - 1  # captured every 1/8 s
        header = rig.header("head_left")
        assert header.sequence == max(arrived, -1)
        assert header.time == max(arrived, -1) * 0.125 or header.sequence == -1


# ------------------------------------------------------------ the plant
PLANT = {  # the robot drives into the panel, hands closing: impact, friction, servos at work
    "left_gripper.position_command": np.array([-0.02]),
    "right_gripper.position_command": np.array([-0.02]),
    "base.twist_command": np.array([1.0, 0.0]),
}


def state_of(station, context):
    """All that the plant keeps, as bytes."""
    inner = station.GetSubsystemByName("plant").GetMyContextFromRoot(context)
    values = inner.get_discrete_state()
    assert inner.num_abstract_states() == 1 and inner.num_continuous_states() == 0
    contacts = schemas.encode(inner.get_abstract_state(0).get_value())
    return contacts + b"".join(values.value(k).tobytes() for k in range(values.num_groups()))


def moved(station, context, arm, until):
    """Advances a Context in a Simulator of its own, with the left arm commanded to `arm` -> its state."""
    station.GetInputPort("left_arm.position_command").FixValue(context, arm)
    simulator = Simulator(station, context)
    simulator.Initialize()
    simulator.AdvanceTo(until)
    return state_of(station, context)


@pytest.fixture(scope="module")
def pressing():
    """Shortly after the hands have met the panel."""
    return Rig(**PLANT).run(0.625)


def test_the_plant_is_found_in_the_station_and_answers_in_a_context_of_the_present_state(pressing):
    physics = pressing.station.GetSubsystemByName("plant")
    context = physics.plant_context(pressing.context)
    plant = physics.plant
    assert context.get_time() == 0.625
    base = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("base", physics.robot))
    np.testing.assert_allclose(base.translation()[:2], pressing.read("truth.base_pose")[:2], atol=1e-12)
    contacts = plant.get_contact_results_output_port().Eval(context)
    assert contacts.num_point_pair_contacts() >= 2
    forces = [contacts.point_pair_contact_info(k).contact_force() for k in range(contacts.num_point_pair_contacts())]
    assert np.linalg.norm(np.sum(forces, axis=0)) > 100  # the commands are in the Context, too
    before = state_of(pressing.station, pressing.context)
    plant.SetPositions(context, np.zeros(plant.num_positions()))
    assert state_of(pressing.station, pressing.context) == before


def test_a_clone_of_a_context_advances_to_the_same_bits_whatever_the_other_does(pressing):
    station = pressing.station
    home = initial_commands(pressing.scenario)["left_arm.position_command"]
    clones = [pressing.context.Clone() for _ in range(3)]
    first = moved(station, clones[0], home, 0.75)
    other = moved(station, clones[1], home + 0.05, 0.75)  # leaves the inner diagram somewhere else
    again = moved(station, clones[2], home, 0.75)
    assert first == again != other


def test_two_contexts_advanced_in_turns_do_as_they_do_alone(pressing):
    station = pressing.station
    home = initial_commands(pressing.scenario)["left_arm.position_command"]
    arms = (home, home + 0.05)
    alone = [moved(station, pressing.context.Clone(), arm, 0.75) for arm in arms]
    contexts = [pressing.context.Clone() for _ in arms]
    for tick in range(81, 97):
        turns = [moved(station, context, arm, tick / 128) for context, arm in zip(contexts, arms)]
    assert turns == alone


def test_a_state_that_is_put_back_goes_on_to_the_same_bits(pressing):
    station, context = pressing.station, pressing.context.Clone()
    home = initial_commands(pressing.scenario)["left_arm.position_command"]
    saved = context.Clone()
    first = moved(station, context, home, 0.75)
    context.SetTimeStateAndParametersFrom(saved)
    assert moved(station, context, home, 0.75) == first


def test_a_new_station_goes_on_from_another_ones_context(pressing):
    """Nothing of the plant is in the system itself."""
    home = initial_commands(pressing.scenario)["left_arm.position_command"]
    station = make_station(pressing.scenario)
    context = station.CreateDefaultContext()
    context.SetTimeStateAndParametersFrom(pressing.context)
    for name, value in (initial_commands(pressing.scenario) | PLANT).items():
        station.GetInputPort(name).FixValue(context, value)
    assert moved(station, context, home, 0.75) == moved(pressing.station, pressing.context.Clone(), home, 0.75)
