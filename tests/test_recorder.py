"""The recorder: rows of a table, from ports to topics; and the program's own table and layout."""

import json
import re

import numpy as np
import pytest
from helpers import SourceBlock
from log_samples import same
from pydrake.geometry import Box, Cylinder, Mesh, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from robot_facts import GROUPS, ROBOT, robot_state

from valve_drake import frames, profiling, resources
from valve_drake import messages as ms
from valve_drake.camera.lens import load_head
from valve_drake.checks import ConfigError
from valve_drake.ports import TICK
from valve_drake.recording import foxglove
from valve_drake.recording.layout import PLOTS, VISIBLE_3D, layout
from valve_drake.recording.reader import LogReader
from valve_drake.recording.recorder_system import ONCE, RecorderSystem, Signal
from valve_drake.recording.robot_frames import RobotFrames
from valve_drake.recording.scene import parts_of, scene
from valve_drake.recording.schemas import Vector, Wrench, parsed
from valve_drake.recording.signals import JOINED, as_it_is, joints, measured, output, signals, status_line, vector
from valve_drake.recording.writer import LogWriter

K = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])


class Memory:
    """A sink that keeps what it gets."""

    def __init__(self):
        self.written: list[tuple[str, object, float]] = []
        self.flushes: list[int] = []

    def write(self, topic, message, time):
        self.written.append((topic, parsed(message), time))

    def flush(self):
        self.flushes.append(len(self.written))

    def of(self, topic):
        return [(message, t) for name, message, t in self.written if name == topic]


def always(message):
    return lambda t: message


def diagram(sink, rows, values, leave_out=(), period=TICK) -> Diagram:
    """The recorder with a source at every port but those left out; values: port -> message or vector of time."""
    builder = DiagramBuilder()
    recorder = builder.AddSystem(RecorderSystem(sink, rows))
    for port, kind in {port: kind for row in rows for port, kind in row.inputs.items()}.items():
        if port in leave_out:
            continue
        if isinstance(kind, int):
            source = ConstantVectorSource(values.get(port, np.arange(1.0, kind + 1)))
        else:
            source = SourceBlock(port, kind, values.get(port, always(kind())), period=period)
        builder.Connect(builder.AddSystem(source).get_output_port(), recorder.GetInputPort(port))
    return builder.Build()


def run(sink, rows, values, until=0.25, **kwargs):
    Simulator(diagram(sink, rows, values, **kwargs)).AdvanceTo(until)
    return sink


def robot_frames(state: ms.RobotState, *belief: ms.Message):
    return [("odometry", "base", np.eye(3, 4)), ("base", "chest", np.column_stack([np.eye(3), [0, 0, 1.05]]))]


def camera_frame(camera: str, sequence: int, period: float) -> ms.CameraFrame:
    return ms.CameraFrame(camera, sequence * period, sequence, data=f"{camera} {sequence}".encode())


def pair(t: float) -> ms.SegmentationPair:
    k = int(t * 8)
    candidates = (
        ms.MarkerCandidate(np.array([[10.0, 20], [30, 20], [30, 40], [10, 40]]), np.array([20.0, 30]), 400, 0.9),
        ms.MarkerCandidate(rejected="no rectangle"),
    )
    seen = [
        ms.Segmentation(camera_frame(camera, k, 1 / 8), candidates, np.array([[5.0, 6, 50]]))
        for camera in ("head_left", "head_right")
    ]
    return ms.SegmentationPair(k / 8, k, *seen)


def marks(t: float) -> ms.HandleMarks:
    k = int(t * 16)
    sides = [
        ms.HandleMark(k / 16, k, k > 1, camera_frame(f"{side}_wrist", k, 1 / 16), reason="" if k > 1 else "border")
        for side in ms.SIDES
    ]
    return ms.HandleMarks(k / 16, *sides)


def mode(t: float) -> ms.ModeState:
    return ms.ModeState(t, "search" if t < 0.1 else "reach", activation=0 if t < 0.1 else 1, since=0.1, reason="seen")


RUN = {
    "robot_state.robot_state": lambda t: robot_state(time=t),
    "color_segmentation.segmentation": pair,
    "line_fitting.edges": lambda t: ms.MarkerEdges(t, int(t * 8) // 2 * 2, *[ms.QuadEdges(True)] * 2),
    "handle_marker.marks": marks,
    "rectangle_estimator.estimate": lambda t: ms.RectangleEstimate(t, found=t > 0.1),
    "supervisor.mode": mode,
    "health": lambda t: ms.Health(t, faults=("lidar",) if t > 0.1 else ()),
    "image_servo.status": lambda t: ms.Status(t, state="failed" if t > 0.1 else "running", detail="lost it"),
}


def table():
    looks = scene([("base", Box(1, 2, 3), np.eye(3, 4), (1, 0, 0, 1))])
    return signals(GROUPS, robot_frames, looks, {"head_left": ((640, 480), K), "head_right": ((640, 480), K)})


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> LogReader:
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    with LogWriter(path) as writer:
        run(writer, table(), RUN, until=1.25)
    return LogReader(path)


# ---- the mechanism


def test_a_message_is_written_when_it_is_another_object():
    same_one = ms.Status(detail="a")
    rows = [output("a", "status", ms.Status), output("b", "status", ms.Status)]
    sink = run(Memory(), rows, {"a.status": lambda t: same_one, "b.status": lambda t: ms.Status(time=t)}, until=1.0)
    assert len(sink.of("/a/status")) == 2  # the port's first value, and this one
    assert len(sink.of("/b/status")) == 129


def test_a_publish_sees_what_was_before_the_tick():
    sink = run(Memory(), [output("a", "status", ms.Status)], {"a.status": lambda t: ms.Status(time=t, detail="x")})
    times = [(message.time, t) for message, t in sink.of("/a/status")[1:]]
    assert times == [(k * TICK, (k + 1) * TICK) for k in range(32)]


def test_a_followed_blocks_ports_are_read_after_its_updates_and_after_a_jump_in_time():
    recorder = RecorderSystem(sink := Memory(), [output("a", "status", ms.Status)])
    recorder.listen(lambda port: lambda time: ms.Status(time=time))
    recorder.follow("a.status", block := SourceBlock("a", ms.Status, always(ms.Status())))
    for tick, updates in ((0, 0), (1, 0), (2, 1), (3, 1), (5, 1), (6, 1)):
        block.updates = updates
        recorder.record(tick * TICK, tick * TICK)
    assert [t / TICK for _, t in sink.of("/a/status")] == [0, 2, 5]


def test_vectors_are_written_at_their_period():
    sink = run(Memory(), [vector("/a", "a", ("x", "y"), period=1 / 16)], {"a": [3.0, 4.0]})
    assert [t for _, t in sink.of("/a")] == [0, 1 / 16, 2 / 16, 3 / 16, 4 / 16]
    message = sink.of("/a")[1][0]
    assert same(message, Vector(1 / 16, ("x", "y"), np.array([3.0, 4.0])))


def test_rows_without_inputs_are_written_once_or_again():
    rows = [
        Signal("/once", {}, lambda time: ms.Status(time), period=ONCE),
        Signal("/again", {}, lambda time: ms.Status(time), period=0.125),
    ]
    sink = run(Memory(), rows, {})
    assert [t for _, t in sink.of("/once")] == [0]
    assert [t for _, t in sink.of("/again")] == [0, 0.125, 0.25]


def test_a_key_decides_what_is_news_and_urgent_rows_flush():
    row = Signal("/a", {"a": ms.Status}, as_it_is, key=lambda status: int(status.time * 8), urgent=True)
    sink = run(Memory(), [row], {"a": lambda t: ms.Status(time=t)})
    assert [message.time for message, _ in sink.of("/a")] == [0, 0.125]
    assert sink.flushes == [1, 2]


def test_rows_may_share_ports_and_topics_and_encode_to_nothing():
    rows = [
        Signal("/t", {"a": ms.Status}, lambda t, a: None),
        status_line("a"),
        Signal("/t", {"a.status": ms.Status, "a": ms.Status}, lambda t, one, other: one),
    ]
    sink = run(Memory(), rows, {"a.status": lambda t: ms.Status(t, detail="d")}, until=TICK)
    assert [topic for topic, _, _ in sink.written] == ["/log", "/t", "/t"]


def test_a_row_with_an_unconnected_port_is_left_out():
    rows = [vector("/truth/a", "truth.a", "x"), output("b", "status", ms.Status)]
    sink = run(Memory(), rows, {}, leave_out=["truth.a"])
    assert {topic for topic, _, _ in sink.written} == {"/b/status"}


def test_a_wrong_message_on_a_port_is_refused_by_name():
    builder = DiagramBuilder()
    recorder = builder.AddSystem(RecorderSystem(Memory(), [output("a", "status", ms.Status)]))
    builder.Connect(
        builder.AddSystem(SourceBlock("s", ms.Health, lambda t: ms.Health())).get_output_port(),
        recorder.GetInputPort("a.status"),
    )
    with pytest.raises(TypeError, match="a.status.*want Status, got Health"):
        Simulator(builder.Build()).Initialize()


@pytest.mark.parametrize("period", [0.01, 0.0, 1 / 256, -1.0])
def test_a_period_off_the_ticks_is_refused(period):
    with pytest.raises(ValueError, match="/a: the period must be a multiple"):
        RecorderSystem(Memory(), [vector("/a", "a", "x", period=period)])


def test_a_port_of_two_kinds_is_refused():
    with pytest.raises(ValueError, match="port a"):
        RecorderSystem(Memory(), [vector("/a", "a", "x"), vector("/b", "a", "xy")])


def test_ports_have_the_rows_names_and_types():
    recorder = RecorderSystem(Memory(), [vector("/a", "a", "xyz"), output("b", "status", ms.Status)])
    assert [recorder.get_input_port(k).get_name() for k in range(2)] == ["a", "b.status"]
    assert recorder.GetInputPort("a").size() == 3
    assert recorder.num_output_ports() == 0


def test_joints_gather_vectors_by_name(monkeypatch):
    ports = {"q": ("a.position", "b.position"), "v": ("b.velocity",), "tau": ("a.effort", "c.effort")}
    monkeypatch.setitem(JOINED, "some", lambda groups: ports)
    row = joints("/j", "some", GROUPS)
    assert dict(row.inputs) == {"some": 5}
    states = parsed(row.encode(1.5, np.array([1.0, 2, 3, 4, 5])))
    assert states.timestamp.seconds == 1 and states.timestamp.nanos == 500_000_000
    found = [(s.name, s.position, s.velocity, s.effort) for s in states.joints]
    assert found == [("a", 1, 0, 4), ("b", 2, 3, 0), ("c", 0, 0, 5)]


# ---- the program's table


def test_images_are_the_consumers_and_written_once_each(log):
    for camera, rate in (("head_left", 8), ("head_right", 8), ("left_wrist", 16), ("right_wrist", 16)):
        images = [message for _, _, message in log.messages([f"/{camera}/image"])]
        assert [bytes(image.data).decode() for image in images] == [f"{camera} {k}" for k in range(len(images))]
        assert len(images) == int(1.25 * rate)
        assert (images[1].timestamp.nanos, images[1].frame_id, images[1].format) == (10**9 // rate, camera, "jpeg")


def test_detections_carry_reasons_and_half_a_pixel(log):
    _, _, drawing = next(log.messages(["/head_left/detections"]))
    assert [text.text for text in drawing.texts] == ["score 0.90", "no rectangle"]
    assert (drawing.points[0].points[0].x, drawing.points[0].points[0].y) == (10.5, 20.5)
    assert (drawing.circles[0].position.x, drawing.circles[0].position.y) == (5.5, 6.5)
    _, _, drawing = next(log.messages(["/left_wrist/detections"]))
    assert [text.text for text in drawing.texts] == ["border"]


def test_fitted_edges_are_drawn_on_their_own_image_only(log):
    fitted = foxglove.FITTED.SerializeToString()
    drawn = {}
    for _, _, drawing in log.messages(["/head_right/detections"]):
        k = drawing.timestamp.seconds * 8 + drawing.timestamp.nanos // 125_000_000
        drawn[k] = drawn.get(k, False) or any(p.outline_color.SerializeToString() == fitted for p in drawing.points)
    assert drawn == {k: k % 2 == 0 for k in range(10)}


def test_stations_vectors_come_back_to_the_bit(log):
    _, _, message = next(log.messages(["/left_wrist/wrench"]))
    assert same(message, Wrench(0.0, np.array([1.0, 2, 3]), np.array([4.0, 5, 6])))
    states = {joint.name: joint for joint in next(log.messages(["/joint_states"]))[2].joints}
    for k, name in enumerate(name for names in measured(GROUPS).values() for name in names):
        joint, quantity = name.split(".")
        assert getattr(states[joint], quantity) == k + 1
    assert log.topics["/joint_states"].count == log.topics["/joint_commands"].count == 161


def test_changes_of_mode_are_events_and_lines(log):
    modes = [{pair.key: pair.value for pair in event.metadata} for _, _, event in log.messages(["/events"])]
    assert [facts["mode"] for facts in modes] == ["idle", "search", "reach"]
    assert modes[-1] == {"mode": "reach", "activation": "1", "attempt": "0", "verdict": "", "reason": "seen"}
    lines = [(message.name, message.message) for _, _, message in log.messages(["/log"])]
    assert ("supervisor", "reach: seen") in lines
    assert ("image_servo", "failed: lost it") in lines
    assert ("station", "lidar") in lines


def test_frames_poses_and_calibrations(log):
    _, _, tree = next(log.messages(["/tf"]))
    chest = tree.transforms[1]
    assert (chest.parent_frame_id, chest.child_frame_id) == ("base", "chest")
    assert (chest.translation.z, chest.rotation.w) == (1.05, 1.0)
    assert log.topics["/tf"].count == 41
    _, _, camera = next(log.messages(["/head_left/calibration"]))
    assert list(camera.K) == K.ravel().tolist() and camera.frame_id == "head_left"
    assert log.topics["/head_left/calibration"].count == 2
    _, t, found = next(log.messages(["/rectangle_estimator/pose"]))
    assert t > 0.1 and found.pose.orientation.w == 1.0


def test_the_wheel_turns_with_the_marker_and_the_panel_stays():
    depth = 0.131  # of the panel's surface behind the marker [m]
    belief = RobotFrames(ROBOT, load_head(resources.models() / "calibration" / "head.yaml"))
    X_BA = frames.make(frames.rot_y(0.2), np.array([0.6, 0.1, 1.2]))
    found = {}
    for angle in (0.0, 0.7):
        plan, turn = ms.GraspPlan(found=True, X_BA=X_BA), ms.TurnState(angle=angle)
        tree = belief(robot_state(), ms.RectangleEstimate(), plan, turn)
        found[angle] = {child: (parent, X) for parent, child, X in tree}
    (odometry, start), (_, end) = (found[angle]["marker"] for angle in (0.0, 0.7))
    np.testing.assert_allclose(start[:, :3].T @ end[:, :3], frames.rot_z(-0.7), atol=1e-12)
    for angle in found:
        parent, X = found[angle]["valve::wheel"]
        assert parent == "marker" and X[:, 3] == pytest.approx([0, 0, depth])
        parent, X = found[angle]["valve::panel"]
        assert parent == odometry
        np.testing.assert_allclose(X[:, :3], start[:, :3], atol=1e-12)
        np.testing.assert_allclose(X[:, 3] - start[:, 3], depth * start[:, 2], atol=1e-12)


def test_truth_may_be_cut_without_a_trace_on_other_topics(log, tmp_path):
    cut = [port for row in table() for port in row.inputs if port.startswith("truth.")]
    with LogWriter(tmp_path / "cut.mcap") as writer:
        run(writer, table(), RUN, until=1.25, leave_out=cut)
    other = LogReader(tmp_path / "cut.mcap")
    rest = [topic for topic in log.topics if not topic.startswith("/truth/")]
    assert len(cut) > 0 and list(other.topics) == rest
    assert list(other.records()) == list(log.records(rest))


def test_same_run_same_log(log, tmp_path):
    with LogWriter(tmp_path / "again.mcap") as writer:
        run(writer, table(), RUN, until=1.25)
    assert (tmp_path / "again.mcap").read_bytes() == log.path.read_bytes()


def test_publishing_is_accounted_for_and_cheap(tmp_path):
    spent = []
    for k in range(4):
        with LogWriter(tmp_path / f"{k}.mcap") as writer, profiling.measure() as profile:
            run(writer, table(), RUN, until=0.5)
        spent.append(profile.seconds[profiling.LOGGING, ""] / 64)
    assert 0 < min(spent) < 2e-3  # a tick; 0.3e-3 to 0.5e-3 s on an idle machine


# ---- pictures


def test_quaternions_turn_as_the_matrices_do():
    rng = np.random.default_rng(2)
    q = rng.normal(size=(200, 4))
    q[:8] = np.vstack([np.eye(4), -np.eye(4)])
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    x, y, z, w = q.T
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    assert np.abs(np.abs((foxglove.quaternions(R) * q).sum(axis=1)) - 1).max() < 1e-14


def test_scene_draws_drakes_shapes_in_their_frames(tmp_path):
    obj = tmp_path / "pyramid.obj"
    obj.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    builder = DiagramBuilder()
    plant, graph = AddMultibodyPlantSceneGraph(builder, 0.01)
    color = np.array([0.1, 0.2, 0.3, 1.0])
    body = plant.world_body()
    at = RigidTransform([1.0, 2.0, 3.0])
    for name, shape in (("b", Box(1, 2, 3)), ("c", Cylinder(0.5, 2)), ("s", Sphere(2)), ("m", Mesh(str(obj), 2.0))):
        plant.RegisterVisualGeometry(body, at, shape, name, color)
    plant.Finalize()
    update = scene(parts_of(graph.model_inspector()))
    (entity,) = update.entities
    assert entity.frame_id == "world" and entity.frame_locked
    cube, cylinder, sphere, mesh = entity.cubes[0], entity.cylinders[0], entity.spheres[0], entity.triangles[0]
    assert (cube.size.x, cube.size.y, cube.size.z) == (1, 2, 3)
    assert (cube.pose.position.z, cube.color.b) == (3.0, 0.3)
    assert (cylinder.size.x, cylinder.size.z, cylinder.top_scale) == (1, 2, 1)
    assert sphere.size.y == 4
    assert len(mesh.points) == 4 and len(mesh.indices) == 12
    assert max(p.z for p in mesh.points) == 2.0


def test_scene_names_a_mesh_that_cannot_be_read_in_one_line(tmp_path):
    obj = tmp_path / "damaged.obj"
    obj.write_text("")
    part = ("world", Mesh(str(obj), 1.0), np.eye(3, 4), (1.0, 0.0, 0.0, 1.0))
    with pytest.raises(ConfigError, match="^mesh .*damaged.obj cannot be read: ") as error:
        scene([part])
    assert "\n" not in str(error.value)


# ---- layout


def test_every_topic_and_field_of_the_layout_is_in_a_fresh_log(log):
    text = json.dumps(layout(GROUPS))
    topics = set(re.findall(r'"(/[a-z_]+(?:/[a-z_]+)*)"', text))
    paths = [path for plot in PLOTS.values() for path in plot.values()] + ["/supervisor/mode.mode"]
    for path in paths:
        topic, *fields = re.sub(r"\[[^]]*\]|\{[^}]*\}", "", path).split(".")
        topics.add(topic)
        log.series(topic, [".".join(fields)])
    assert topics >= set(VISIBLE_3D)
    assert {topic for topic in topics if log.topics.get(topic) is None or log.topics[topic].count == 0} == set()


def test_every_panel_has_its_place():
    def leaves(node):
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    found = layout(GROUPS)
    assert sorted(leaves(found["layout"])) == sorted(found["configById"])
