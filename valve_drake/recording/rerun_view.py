"""A log as Rerun's recording with everything in place: 3D with the robot's body, images, modes, plots, words.

    python -m valve_drake.recording.rerun_view logs/run-7.mcap      # logs/run-7.rrd, opened by `rerun logs/run-7.rrd`

Rerun reads most of a log by itself (docs/logs.md). What it does not: the bodies' looks (foxglove.SceneUpdate), which
are added here as meshes in the log's frames, and which fields to plot, which the blueprint says.
Needs the `rerun` extra.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.TriangleListPrimitive_pb2 import TriangleListPrimitive

from valve_drake import outputs
from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.console import complain, say
from valve_drake.messages import CAMERAS
from valve_drake.recording.layout import PLOTS
from valve_drake.recording.reader import LogReader
from valve_drake.recording.recovery import recover
from valve_drake.recording.robot_frames import ODOMETRY

APPLICATION = "valve_drake"
SCENE = "/scene"
MODE = "/supervisor/mode"


def blueprint(log: LogReader) -> Any:
    """The views of a log's topics, as rerun.blueprint.Blueprint. Topics that the log does not have are left out."""
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    def shown(archetype: Any, slot: str, topic: str, field: str) -> Any:
        """`field` (.name[index].name) of a topic's messages, as what `archetype` draws."""
        source = {"source_component": f"{log.topics[topic].schema}:message", "selector": field}
        mapping = VisualizerComponentMapping(slot, ComponentSourceKind.SourceComponent, **source)
        return archetype.visualizer(mappings=[mapping])

    def plot(title: str, paths: dict[str, str]) -> Any:
        lines: dict[str, list[Any]] = {}
        for label, path in paths.items():
            topic, dot, field = path.partition(".")
            if topic in log.topics and "{" not in field:  # there is no way to ask for a joint by its name
                line = shown(rr.SeriesLines(names=label), "Scalars:scalars", topic, dot + field)
                lines.setdefault(topic, []).append(line)
        return rrb.TimeSeriesView(origin="/", contents=list(lines), name=title, overrides=lines) if lines else None

    cameras = [name for name in CAMERAS if f"/{name}/image" in log.topics]
    images = [rrb.Spatial2DView(origin=f"/{name}/image", name=name) for name in cameras]
    world = rrb.Spatial3DView(
        origin="/",
        contents=["/tf", f"{SCENE}/**", "/head_left/**", "/head_right/**", "/rectangle_estimator/pose"],
        name="World, as the robot believes it",
        spatial_information=rrb.SpatialInformation(target_frame=ODOMETRY),
    )
    modes = []
    if MODE in log.topics:
        state = shown(rr.StateChange(), "StateChange:state", MODE, ".mode")
        modes = [rrb.StateTimelineView(origin="/", contents=[MODE], name="Modes", overrides={MODE: state})]
    plots = [view for title, paths in PLOTS.items() if (view := plot(title, paths))]
    left = rrb.Vertical(world, rrb.Grid(*images, grid_columns=2), row_shares=[1, 1])
    words = rrb.TextLogView(origin="/log", name="Log")
    right = rrb.Vertical(*modes, rrb.Grid(*plots, words, grid_columns=2), row_shares=[1, 6] if modes else None)
    return rrb.Blueprint(rrb.Horizontal(left, right), collapse_panels=True)


def log_bodies(recording: Any, log: LogReader) -> None:
    """The bodies' meshes, each in its frame, for all times. `recording`: a rerun.RecordingStream."""
    import rerun as rr

    scene: Any = next((message for _, _, message in log.messages([SCENE])), None) if SCENE in log.topics else None
    for entity in scene.entities if scene else ():
        parts = [(mesh.pose, _mesh(mesh)) for mesh in entity.triangles] + [(c.pose, _cube(c)) for c in entity.cubes]
        for k, (pose, part) in enumerate(parts):
            p, q = pose.position, pose.orientation
            at = rr.InstancePoses3D(translations=[[p.x, p.y, p.z]], quaternions=[[q.x, q.y, q.z, q.w]])
            recording.log(f"{SCENE}/{entity.frame_id}/{k}", rr.CoordinateFrame(entity.frame_id), at, part, static=True)


def _mesh(mesh: TriangleListPrimitive) -> Any:
    import rerun as rr

    points = [(p.x, p.y, p.z) for p in mesh.points]
    triangles = np.array(mesh.indices).reshape(-1, 3)
    return rr.Mesh3D(vertex_positions=points, triangle_indices=triangles, albedo_factor=_rgba(mesh.color))


def _cube(cube: CubePrimitive) -> Any:
    import rerun as rr

    half = [cube.size.x / 2, cube.size.y / 2, cube.size.z / 2]
    return rr.Boxes3D(half_sizes=[half], colors=[_rgba(cube.color)], fill_mode="solid")


def _rgba(color: Color) -> list[float]:
    return [color.r, color.g, color.b, color.a]


def write(source: Path, out: Path) -> list[str]:
    """Writes what can be read of the log `source` as Rerun's recording `out` -> the log's damage, in lines.

    Raises ConfigError if `source` is no log, the extra is missing or `out` is a file of another kind; OperationFailed
    if Rerun fails or `out` cannot be written.
    """
    out = outputs.check(out, "the Rerun recording", [source], _is_recording)
    try:
        import rerun as rr
    except ImportError:
        raise ConfigError("this needs the rerun-sdk package: pip install 'valve-drake[rerun]'") from None
    log, same = LogReader(source), {"application_id": APPLICATION, "recording_id": source.stem}
    with tempfile.TemporaryDirectory() as folder:
        names = ("messages.rrd", "bodies.rrd", "views.rbl", "all.rrd")
        messages, bodies, views, whole = (Path(folder) / name for name in names)
        if log.damage:  # Rerun would read nothing of it
            recover(source, sound := Path(folder) / "sound.mcap")
            source = sound
        options = [f"--{key.replace('_', '-')}={value}" for key, value in same.items()]
        _rerun("mcap", "convert", source, *options, "--timeline-type=duration", "-o", messages)
        with rr.RecordingStream(**same) as recording:
            recording.save(bodies)
            log_bodies(recording, log)
            recording.flush()
        blueprint(log).save(APPLICATION, views)
        _rerun("rrd", "merge", messages, bodies, views, "-o", whole)
        with outputs.replacing(out) as file, open(whole, "rb") as made:
            shutil.copyfileobj(made, file)
    return log.damage


def _is_recording(path: Path) -> bool:
    """Whether a file is a Rerun recording, which a new one may replace."""
    try:
        with open(path, "rb") as file:
            return file.read(3) == b"RRF"
    except OSError:
        return False


def _rerun(*arguments: str | Path) -> None:
    """Runs Rerun's own program. Raises OperationFailed with the last line that it wrote."""
    done = subprocess.run([sys.executable, "-m", "rerun", *arguments], capture_output=True, text=True)
    if done.returncode != 0:
        words = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise OperationFailed(f"rerun {arguments[0]} {arguments[1]} failed: {words}")


def main(arguments: list[str]) -> int:
    """The program: `arguments` without its name -> exit code, as of the commands."""
    if len(arguments) != 1:
        print("usage: python -m valve_drake.recording.rerun_view LOG", file=sys.stderr)
        return 2
    source = Path(arguments[0])
    out = source.parent / f"{source.stem}.rrd"
    try:
        damage = write(source, out)
    except (ConfigError, OperationFailed) as error:
        complain(error)
        return 2 if isinstance(error, ConfigError) else 1
    for line in damage:
        say(f"damaged: {line}")
    say(f"rerun {out}")
    return 3 if damage else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
