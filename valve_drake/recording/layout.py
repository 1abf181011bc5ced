"""The layout for Foxglove and Lichtblick: 3D, images with detections, modes, plots, log. Every log carries it.

Both import this form: a configuration for each panel, and a binary tree of panels. 3D and image panels show
a topic only when they are told to.
"""

from typing import Any

from valve_drake.messages import HEAD, SIDES, WRISTS
from valve_drake.robot.groups import Groups

NAME, MEDIA_TYPE = "layout.json", "application/json"  # of the attachment

VISIBLE_3D = ("/tf", "/scene", "/rectangle_estimator/pose", *(f"/{camera}/calibration" for camera in HEAD))
JOINT = '/{topic}.joints[:]{{name=="{joint}"}}.position'
TRACKED = 3  # joints of each arm that are plotted, from the shoulder on
PLOTS: dict[str, dict[str, str]] = {  # title -> label -> message path
    "Valve angle [rad]": {
        "by the hands": "/hybrid_rotation/turn.angle",
        "reference": "/hybrid_rotation/turn.angle_reference",
        "true": "/truth/valve_angle.values[0]",
    },
    "Wrist forces [N]": {f"{side} {'xyz'[k]}": f"/{side}_wrist/wrench.force[{k}]" for side in SIDES for k in range(3)},
    "Turning [N m, N]": {
        "couple": "/hybrid_rotation/turn.torque",
        "squeeze": "/hybrid_rotation/turn.squeeze",
    },
    "Servo error [m]": {
        f"{side} {'xyz'[k]}": f"/image_servo/servo.{side}_error[{k}]" for side in SIDES for k in range(3)
    },
    "Distance to the marker [m]": {
        "stage 1": "/stereo_positioning/position.p_LV[2]",
        "stage 2": "/rectangle_estimator/estimate.X_LV[11]",
    },
}


def _tracking(groups: Groups) -> dict[str, str]:
    """Label -> message path of the arms' joints, measured and commanded."""
    return {
        f"{side} {k + 1} {topic.removeprefix('joint_')}": JOINT.format(topic=topic, joint=joint)
        for side in SIDES
        for k, joint in enumerate(groups.names(f"{side}_arm")[:TRACKED])
        for topic in ("joint_states", "joint_commands")
    }


def layout(groups: Groups) -> dict[str, Any]:
    """The layout for a robot as a JSON object."""
    plots = PLOTS | {"Joint tracking [rad]": _tracking(groups)}
    world = {
        "cameraState": {"distance": 5.0, "perspective": True, "phi": 65.0, "thetaOffset": 120.0, "target": [0, 0, 0.8]},
        "layers": {"grid": {"layerId": "foxglove.Grid", "visible": True, "size": 10, "divisions": 10}},
        "topics": {topic: {"visible": True} for topic in VISIBLE_3D},
    }
    modes = {"paths": [{"value": "/supervisor/mode.mode", "label": "mode", **_TIMED}], "isSynced": True}
    panels = {
        "3D!world": world,
        "StateTransitions!modes": modes,
        "RosOut!log": {"searchTerms": [], "minLogLevel": 1},
        **{f"Image!{camera}": _image(camera) for camera in (*HEAD, *WRISTS)},
        **{f"Plot!{title}": _plot(title, paths) for title, paths in plots.items()},
    }
    head, wrist = ([f"Image!{camera}" for camera in cameras] for cameras in (HEAD, WRISTS))
    curves = [f"Plot!{title}" for title in plots]
    tree = _split(
        "row",
        _split("column", "3D!world", _even("column", [_even("row", head), _even("row", wrist)]), 50),
        _split(
            "column",
            "StateTransitions!modes",
            _even("row", [_even("column", curves[0::2]), _even("column", [*curves[1::2], "RosOut!log"])]),
            14,
        ),
        45,
    )
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": tree,
    }


_TIMED = {"enabled": True, "timestampMethod": "receiveTime"}


def _image(camera: str) -> dict[str, Any]:
    mode = {"imageTopic": f"/{camera}/image", "annotations": {f"/{camera}/detections": {"visible": True}}}
    if camera in HEAD:  # the wrist cameras are not calibrated
        mode["calibrationTopic"] = f"/{camera}/calibration"
    return {"imageMode": mode, "foxglovePanelTitle": camera}


def _plot(title: str, paths: dict[str, str]) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "paths": [{"value": path, "label": label, **_TIMED} for label, path in paths.items()],
        "showLegend": True,
        "legendDisplay": "floating",
        "isSynced": True,
        "xAxisVal": "timestamp",
    }


def _split(direction: str, first: Any, second: Any, percentage: float) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}


def _even(direction: str, nodes: list[Any]) -> Any:
    """Nodes of equal size side by side."""
    if len(nodes) == 1:
        return nodes[0]
    return _split(direction, nodes[0], _even(direction, nodes[1:]), 100 / len(nodes))
