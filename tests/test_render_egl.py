"""render_egl: agrees with Drake's VTK renderer, and edges lie where they should."""

import gc
import math
import re

import cv2
import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Capsule,
    ClippingRange,
    ColorRenderCamera,
    Cylinder,
    Ellipsoid,
    GeometryInstance,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    Rgba,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.sensors import CameraInfo
from robot_facts import ROBOT

from valve_drake import named_files, resources, scenario
from valve_drake.camera.lens import Lens, load_head
from valve_drake.checks import ConfigError
from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segment
from valve_drake.perception.line_fitting import LineFittingConfig, fit_quads
from valve_drake.perception.quadrilateral import meet, side_lines
from valve_drake.stations import render_egl
from valve_drake.stations.camera_rig import CameraRig, _Lensed
from valve_drake.stations.render_egl import RenderEngineEgl, add_renderer, read_obj
from valve_drake.stations.simulated import make_mounts

LAMP = LightParameter(type="directional", direction=[0.3, 0.4, 0.9], frame="camera", intensity=1.0)
CLEAR = (0.2, 0.4, 0.6)
INFO = CameraInfo(320, 240, 300.0, 290.0, 161.3, 118.2)


def rig(renderer: str) -> CameraRig:
    keys = {"renderer": renderer, "supersample": 2, "noise": 0.0}
    sc = scenario.resolve(scenario.load(None, ["seed=5", *(f"simulation.camera.{k}={v}" for k, v in keys.items())]))
    head = load_head(named_files.find(sc, "head_calibration"))
    mounts, simulation = make_mounts(head, sc.simulation, 5, ROBOT.description.cameras), sc.simulation
    return CameraRig(mounts, simulation.valve, sc.valve, simulation.light, simulation.camera, 5)


@pytest.fixture(scope="module")
def rigs():
    return rig("egl"), rig("vtk")


PLACES = {  # camera, base_x [m], neck_pitch [rad]
    "from afar": ("head_left", -3.0, 0.05),
    "before the valve": ("head_right", -1.4, 0.25),
    "at the valve": ("head_left", -0.8, 0.35),
    "the wrist": ("left_wrist", -0.9, 0.0),
}


def positions(rig: CameraRig, base_x: float, neck_pitch: float) -> np.ndarray:
    q = np.zeros(rig.plant.num_positions())
    arm = np.array([1.05, 0.65, -1.9, 0.0, 1.25, 0.0])
    values = {"base_x": base_x, "neck_pitch": neck_pitch}
    for side, mirror in (("left", np.ones(6)), ("right", np.array([1, -1, -1, -1, -1, -1]))):
        values |= {f"{side}_arm_{k + 1}": angle for k, angle in enumerate(arm * mirror)}
    for name, value in values.items():
        q[rig.plant.GetJointByName(name).position_start()] = value
    return q


@pytest.mark.parametrize("place", PLACES)
def test_images_differ_from_vtks_by_less_than_a_grey_level(rigs, place):
    camera, base_x, pitch = PLACES[place]
    ours, vtks = (r.optical(camera, positions(r, base_x, pitch)).astype(int) for r in rigs)
    assert vtks.std() > 20  # there is something in the picture
    difference = np.abs(ours - vtks)
    assert difference.mean() < 1.0
    assert (difference.max(axis=-1) > 24).mean() < 0.02  # edges alone, never a surface


@pytest.mark.parametrize("place", [place for place in PLACES if place != "the wrist"])
def test_the_markers_sides_lie_where_vtk_draws_them(rigs, place):
    camera, base_x, pitch = PLACES[place]
    corners = []
    for r in rigs:
        image = r.ideal(camera, positions(r, base_x, pitch))
        candidates, _ = segment(image, ColorSegmentationConfig())
        quad = fit_quads([image], [candidates[0].corners], LineFittingConfig())[0]
        corners.append(meet(side_lines(quad.points, quad.side)[0]))
    lines = [np.roll(c, -1, axis=0) - c for c in corners]
    normals = np.stack([lines[1][:, 1], -lines[1][:, 0]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    middles = [(c + np.roll(c, -1, axis=0)) / 2 for c in corners]
    assert np.abs(((middles[0] - middles[1]) * normals).sum(axis=1)).max() < 0.1


# ---------------------------------------------------------------- the engine by itself


def draw(shapes, engine="egl", info=INFO, X_WC=None, settings=None, then=None, channels=3, fine_within=None):
    """An image (H, W, 3) of [(shape, X_WG, rgba), ...] from X_WC; fine_within: of the shapes of these numbers [m]."""
    scene = SceneGraph()
    source = scene.RegisterSource("test")
    ids = []
    for k, (shape, X, rgba) in enumerate(shapes):
        instance = GeometryInstance(X, shape, f"shape {k}")
        properties = PerceptionProperties()
        if rgba is not None:
            properties.AddProperty("phong", "diffuse", Rgba(*rgba))
        if k in (fine_within or {}):
            properties.AddProperty("valve_drake", "fine_within", fine_within[k])
        instance.set_perception_properties(properties)
        ids.append(scene.RegisterAnchoredGeometry(source, instance))
    if engine == "egl":
        settings = {"lights": [LAMP], "default_clear_color": CLEAR, "supersample": 1} | (settings or {})
        add_renderer(scene, "renderer", RenderEngineEgl(**settings))
    else:
        params = RenderEngineVtkParams(lights=[LAMP], default_clear_color=np.array(CLEAR))
        scene.AddRenderer("renderer", MakeRenderEngineVtk(params))
    if then is not None:
        then(scene, source, ids)
    context = scene.CreateDefaultContext()
    query = scene.get_query_output_port().Eval(context)
    core = RenderCameraCore("renderer", info, ClippingRange(0.02, 25.0), RigidTransform())
    image = query.RenderColorImage(ColorRenderCamera(core, False), scene.world_frame_id(), X_WC or RigidTransform())
    return image.data[..., :channels].copy()


def at(x, y, z, *rpy):
    return RigidTransform(RollPitchYaw(*(rpy or (0, 0, 0))), [x, y, z])


SHAPES = {
    "box": Box(0.3, 0.2, 0.4),
    "cylinder": Cylinder(0.15, 0.4),
    "sphere": Sphere(0.2),
    "capsule": Capsule(0.1, 0.3),
    "ellipsoid": Ellipsoid(0.1, 0.25, 0.18),
    "mesh": Mesh(str(resources.models() / "meshes" / "wheel_face.obj"), 1.5),
    "mesh of three scales": Mesh(str(resources.models() / "meshes" / "wrist_2_shell.obj"), [2.0, 3.0, 4.0]),
}


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_looks_as_vtk_draws_it(name):
    scene = [(SHAPES[name], at(0.05, -0.03, 1.0, 0.4, 0.7, 0.2), (0.8, 0.5, 0.3, 1.0))]
    ours, vtks = draw(scene).astype(int), draw(scene, "vtk").astype(int)
    background = np.rint(255 * np.array(CLEAR))
    covered = [(np.abs(image - background).max(axis=-1) > 2).sum() for image in (ours, vtks)]
    assert covered[0] == pytest.approx(covered[1], rel=0.04) and covered[0] > 1000  # VTK's has a rim of touched pixels
    difference = np.abs(ours - vtks).max(axis=-1)
    assert (difference > 12).mean() < 0.01  # the outline, that VTK smooths
    assert difference.mean() < 1.0


def test_a_mirrored_mesh_is_seen_from_outside():
    mesh = Mesh(str(resources.models() / "meshes" / "wrist_2_shell.obj"), [-3.0, 3.0, 3.0])  # VTK draws it black
    scene = [(mesh, at(0.05, -0.03, 1.0, 0.4, 0.7, 0.2), (0.8, 0.5, 0.3, 1.0))]
    assert (draw(scene) == draw(scene, settings={"cull": False})).all()
    assert draw(scene)[118, 161].max() > 100


@pytest.mark.parametrize("angle", [0.037, 0.61, 1.1, -0.53])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_planes_edge_lies_where_it_should(angle, axis):
    """Pixels are all or nothing: over many rows of a slanted edge the errors must cancel to 0.005 px."""
    plane = Box(4.0, 4.0, 0.01)
    roll = at(0, 0, 0, 0, 0, angle)
    X = roll @ at(2.0, 0.013, 1.0) if axis == 0 else roll @ at(0.013, 2.0, 1.0)  # its edge through the optical axis
    ours = draw([(plane, X, (1.0, 1.0, 1.0, 1.0))], settings={"default_clear_color": (0, 0, 0)})
    inside = ours[..., 0] > 0
    # The edge of the near face, z = 0.995, is the line n . (x, y) = 0 in the image plane, n the face's inward normal.
    n = np.array([np.cos(angle), np.sin(angle)]) if axis == 0 else np.array([-np.sin(angle), np.cos(angle)])
    v, u = np.mgrid[0.5 : INFO.height(), 0.5 : INFO.width()]
    x, y = (u - INFO.center_x()) / INFO.focal_x(), (v - INFO.center_y()) / INFO.focal_y()
    gradient = np.hypot(n[0] / INFO.focal_x(), n[1] / INFO.focal_y())
    distance = (n[0] * x + n[1] * y) / gradient  # of a pixel's centre from the edge, positive inside [px]
    band = np.abs(distance) < 4
    length = band.sum() / 8  # of the edge in the image [px]
    shift = (inside[band].sum() - (distance[band] > 0).sum()) / length
    assert length > 200
    assert abs(shift) < 0.005


@pytest.mark.parametrize("place", [0.0, 0.2, 0.35, 0.5, 0.7])
@pytest.mark.parametrize("level", [True, False])
def test_a_level_or_upright_edge_lies_where_it_should_in_a_cameras_image(place, level):
    """For an edge along a row of samples: without the turned render it would be located to 0.15 px only."""
    lens = Lens(k_u=0.0, k_v=0.0, k_x=600.0, k_y=590.0, u_0=160.2, v_0=118.9, width=320, height=240)
    lensed = _Lensed(lens)
    # A plane 1 m ahead whose edge is seen at pixel 118.9 + place, or 160.2 + place.
    edge = place / (lens.k_y if level else lens.k_x)
    X_CP = at(0, edge - 2.0, 1.005) if level else at(edge - 2.0, 0, 1.005)
    X_CR = RigidTransform(RotationMatrix(lensed.X_CR[:, :3]), lensed.X_CR[:, 3])
    plane = [(Box(4.0, 4.0, 0.01), X_CP, (1.0, 1.0, 1.0, 1.0))]
    settings = {"default_clear_color": (0, 0, 0), "supersample": 2}
    levels = lensed(draw(plane, info=lensed.info, X_WC=X_CR, settings=settings, channels=4))[..., 0] / 200.0
    rows = levels if level else levels.T
    rows = rows[:, 20:-20] / rows[:20, 20:-20].mean()
    seen = rows.sum(axis=0).mean() - 0.5 - (lens.v_0 if level else lens.u_0)
    assert seen == pytest.approx(place, abs=0.005)


def test_what_is_needed_of_a_picture_is_drawn_as_in_the_whole_and_the_rest_left_empty():
    scene = [
        (SHAPES["mesh"], at(0.05, -0.03, 0.6, 0.4, 0.7, 0.2), (0.8, 0.5, 0.3, 1.0)),
        (Box(9, 9, 0.1), at(0, 0, 3.0, 0.2, 0.1, 0), (0.5, 0.5, 0.9, 1.0)),  # reaches beyond the picture on all sides
        (Sphere(0.2), at(0.2, 0, -1.0), (1.0, 0, 0, 1.0)),  # behind the camera
    ]
    corners = np.array([[60.0, 10], [300, 60], [280, 220], [30, 160]])  # a quadrilateral, in either order
    v, u = np.mgrid[0.5:240, 0.5:320]
    distance = np.full(u.shape, np.inf)  # inward, from the nearest side
    for a, b in zip(corners, np.roll(corners, -1, axis=0)):
        n = np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
        distance = np.minimum(distance, n[0] * (u - a[0]) + n[1] * (v - a[1]))
    whole = draw(scene)
    background = np.rint(255 * np.array(CLEAR))
    assert (np.abs(whole - background).max(axis=-1) > 2).all()
    for order in (corners, corners[::-1]):
        part = draw(scene, settings={"needed": lambda info, order=order: order})
        assert (part[distance > 1] == whole[distance > 1]).mean() > 0.999  # a clipped side may fall to another sample
        assert (np.abs(part[distance < -1] - background) <= 1).all()


def test_a_mesh_without_materials_takes_the_property_and_one_with_them_its_own(tmp_path):
    (tmp_path / "two.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl other\nKa 1 1 1\n")
    square = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nv 3 -1 0\nv 3 1 0\n"
    (tmp_path / "two.obj").write_text(f"mtllib two.mtl\n{square}usemtl red\nf 1 4 3 2\nusemtl other\nf 2 -4 -1 -2\n")
    *surface, corners = read_obj(str(tmp_path / "two.obj"), 0.0)
    points, normals, colors = (part[corners] for part in surface)
    assert points.shape == normals.shape == colors.shape == (12, 3)
    assert (normals[:, 2] < 0).all()  # flat ones, by the order of the corners
    assert (colors[:6] == [1, 0, 0]).all() and np.isnan(colors[6:]).all()
    image = draw([(Mesh(str(tmp_path / "two.obj"), 0.2), at(0, 0, 1), (0.0, 0.0, 1.0, 1.0))])
    assert image[118, 130, 0] > 100 and image[118, 130, 2] == 0
    assert image[118, 260, 2] > 100 and image[118, 260, 0] == 0


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    "text",
    [
        TRIANGLE + "f 1 2 3 # the only one\n",
        "# tabs and blanks\n" + TRIANGLE.replace(" ", "\t") + "  f\t1  2 3\n",
        TRIANGLE + "f 1 2 \\\n3\n",
        TRIANGLE + "f -3 -2 -1\nv 5 5 5\n",  # counts back from what was read until then
        "v 9 9 9\n" + TRIANGLE + "vn 0 0 1\nf -3//-1 -2//-1 -1//-1\nvn 1 0 0\n",
    ],
)
def test_a_mesh_is_the_same_however_it_is_written(tmp_path, text):
    (tmp_path / "a.obj").write_text(text)
    points, normals, _, corners = read_obj(str(tmp_path / "a.obj"), 0.0)
    assert points[corners].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]] and (normals[corners] == [0, 0, 1]).all()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (TRIANGLE + "f 1 2 9\n", "a face has corner 9, there are 3"),
        (TRIANGLE + "f 0 1 2\n", "a face has corner 0"),
        (TRIANGLE + "f -4 -2 -1\n", "a face has corner 0"),
        (TRIANGLE + "vn 0 0 1\nf 1//1 2//1 3//2\n", "a face has corner 2, there are 1"),
        (TRIANGLE + "f a b c\n", "invalid literal"),
        ("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "a line `v` has no three finite numbers"),
        (TRIANGLE.replace("1", "nan") + "f 1 2 3\n", "a line `v` has no three finite numbers"),
        ("mtllib a.mtl\n" + TRIANGLE + "f 1 2 3\n", "could not convert string to float: 'r'"),
    ],
)
def test_a_damaged_mesh_is_one_line_that_names_the_file(tmp_path, text, says):
    (tmp_path / "a.mtl").write_text("newmtl m\nKd r g b\n")
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(ConfigError, match=f"^mesh .*a.obj cannot be read: .*{re.escape(says)}") as error:
        draw([(Mesh(str(tmp_path / "a.obj"), 1.0), at(0, 0, 1), (0.0, 0.0, 1.0, 1.0))])
    assert "\n" not in str(error.value)


def test_corners_that_triangles_share_are_held_once_and_a_mirrored_mesh_is_seen_from_outside(tmp_path):
    path = tmp_path / "square.obj"
    path.write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvn 0 0 -1\nf 1//1 4//1 3//1 2//1\n")
    points, normals, _, corners = read_obj(str(path), 0.0)
    assert points.shape == normals.shape == (4, 3) and (normals == [0, 0, -1]).all()
    assert points[corners].tolist() == [[-1, -1, 0], [-1, 1, 0], [1, 1, 0], [-1, -1, 0], [1, 1, 0], [1, -1, 0]]
    white = (1.0, 1.0, 1.0, 1.0)
    plain = draw([(Mesh(str(path), 0.2), at(0, 0, 1), white)])
    mirrored = draw([(Mesh(str(path), np.array([-0.2, 0.2, 0.2])), at(0, 0, 1), white)])
    assert plain[120, 160, 0] > 100 and (mirrored == plain).all()


def test_what_is_invisible_or_removed_is_not_drawn():
    shapes = [
        (Sphere(0.2), at(0, 0, 1), (1.0, 0, 0, 1.0)),
        (Box(0.2, 0.2, 0.2), at(0, 0, 0.5), (0, 1.0, 0, 0.0)),  # invisible
    ]
    empty = draw([])
    ball = draw(shapes)
    assert (ball != empty).any() and (draw(shapes[:1]) == ball).all()

    def remove(scene, source, ids):
        scene.RemoveGeometry(source, ids[0])

    assert (draw(shapes, then=remove) == empty).all()


def test_a_moving_geometry_is_drawn_where_each_context_has_it():
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
    from pydrake.multibody.tree import SpatialInertia
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    plant, scene = AddMultibodyPlantSceneGraph(builder, 1.0)
    body = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.RegisterVisualGeometry(body, RigidTransform(), Sphere(0.1), "ball", [1.0, 0, 0, 1.0])
    plant.Finalize()
    add_renderer(scene, "renderer", RenderEngineEgl(lights=[LAMP]))
    diagram = builder.Build()
    core = RenderCameraCore("renderer", INFO, ClippingRange(0.02, 25.0), RigidTransform())

    def center(context):
        query = scene.get_query_output_port().Eval(scene.GetMyContextFromRoot(context))
        image = query.RenderColorImage(ColorRenderCamera(core, False), scene.world_frame_id(), RigidTransform()).data
        return np.argwhere(image[..., 2] == 0).mean(axis=0)[::-1]

    contexts = [diagram.CreateDefaultContext() for _ in range(2)]
    for context, x in zip(contexts, (-0.2, 0.3)):
        plant.SetFreeBodyPose(plant.GetMyContextFromRoot(context), body, RigidTransform([x, 0.05, 1.0]))
    for _ in range(2):  # by turns: they share one OpenGL context
        for context, x in zip(contexts, (-0.2, 0.3)):
            expected = [INFO.center_x() + INFO.focal_x() * x, INFO.center_y() + INFO.focal_y() * 0.05]
            assert center(context) == pytest.approx(expected, abs=1.5)  # a ball's image is no circle


def test_a_lamp_in_the_world_stays_there_and_a_point_lights_what_faces_it():
    wall = [(Box(4, 4, 0.1), at(0, 0, 2), (1.0, 1.0, 1.0, 1.0))]
    oblique = at(0, 0, 0, 0, 0.3, 0)
    levels = {}
    for frame in ("world", "camera"):
        lamp = LightParameter(type="directional", direction=[0, 0, 1], frame=frame, intensity=0.8)
        levels[frame] = draw(wall, X_WC=oblique, settings={"lights": [lamp]})[118, 161, 0]
    assert levels["world"] == pytest.approx(0.8 * 255, abs=1)
    assert levels["camera"] == pytest.approx(0.8 * 255 * np.cos(0.3), abs=1)
    point = LightParameter(type="point", position=[0, 0, 1.0], frame="world", intensity=1.0)
    fine = [(Sphere(0.3), at(0, 0, 2.0), (1.0, 1.0, 1.0, 1.0))]
    lit = draw(fine, settings={"lights": [point], "default_clear_color": (0, 0, 0)})[..., 0]
    assert lit[118, 161] > 250 and lit[118, 161 + 40] < 200


def test_supersampling_is_the_mean_of_the_points():
    scene = [(SHAPES["cylinder"], at(0, 0, 1.0, 0.4, 0.3, 0.1), (0.8, 0.5, 0.3, 1.0))]
    fine = CameraInfo(2 * 320, 2 * 240, 600.0, 580.0, 2 * 161.3, 2 * 118.2)
    points = draw(scene, info=fine).reshape(240, 2, 320, 2, 3).mean(axis=(1, 3))
    assert np.abs(draw(scene, settings={"supersample": 2}) - points).max() <= 0.5
    with pytest.raises(ValueError, match="1, 2, 3 or 4, got 2.5"):
        RenderEngineEgl(supersample=2.5)


def test_what_is_fine_has_all_its_points_and_the_rest_one():
    slanted = (0, 0, 0.3)
    scene = [  # two plates before a wall, one in each half of the picture
        (Box(0.2, 0.2, 0.01), at(-0.3, 0.1, 1.0, *slanted), (0.9, 0.1, 0.1, 1.0)),
        (Box(0.2, 0.2, 0.01), at(0.5, -0.1, 2.0, *slanted), (0.1, 0.9, 0.1, 1.0)),
        (Box(9.0, 9.0, 0.01), at(0, 0, 3.0), (0.5, 0.5, 0.9, 1.0)),
    ]

    def mixed(image):  # pixels that are partly wall and partly plate
        return ((image != image[0, 0]).any(axis=-1) & (image != image[150, 80]).any(axis=-1))[:, :160]

    fours = draw(scene, settings={"supersample": 2})
    assert mixed(fours).sum() > 100
    for plate in (0.99, 1.01):  # just farther off than that, and just nearer
        part = draw(scene, settings={"supersample": 2}, fine_within={0: plate, 1: 1.9, 2: 0.0})
        assert (part[:, :160] == fours[:, :160]).all() == (plate > 1.0)
        assert (part[:, 160:] != fours[:, 160:]).any()
        assert np.abs(part.astype(int) - fours).mean() < 0.3
    always = draw(scene, settings={"supersample": 2}, fine_within={2: 0.0})
    assert (always == fours).all()
    ones = draw(scene, settings={"supersample": 1})
    assert (draw(scene, settings={"supersample": 1}, fine_within={2: 0.0}) == ones).all()


def test_a_picture_full_of_edges_is_fine_throughout():
    stripes = [(Box(0.02, 2, 0.01), at(x, 0, 1.0, 0, 0, 0.3), (0.9, 0.9, 0.9, 1.0)) for x in np.arange(-0.8, 0.8, 0.05)]
    coarse = dict.fromkeys(range(len(stripes)), 0.0)
    fours = draw(stripes, settings={"supersample": 2})
    assert (draw(stripes, settings={"supersample": 2}, fine_within=coarse) == fours).all()
    few = draw(stripes[::9], settings={"supersample": 2}, fine_within=coarse)
    assert (few != draw(stripes[::9], settings={"supersample": 2})).any()


@pytest.mark.parametrize(
    "body, distance, fine", [("marker", 1.8, True), ("handle_1", 0.3, True), ("handle_1", 1.0, False)]
)
def test_what_is_measured_is_drawn_as_in_a_picture_that_is_fine_throughout(rigs, monkeypatch, body, distance, fine):
    ours, q = rigs[0], positions(rigs[0], -3.0, 0.0)
    ours.pose(q)
    frame = ours.plant.GetFrameByName(body, ours.scene.valve)
    X = ours.plant.CalcRelativeTransform(ours._plant_context, ours.plant.world_frame(), frame)
    X_WC = (X @ at(0, 0, -distance, 0, 0, 0.2)).GetAsMatrix34()  # seen from straight ahead, turned
    images = []
    for busy in (math.inf, -1.0):  # no picture has too many edges for one point, or every one
        monkeypatch.setattr(render_egl, "_BUSY", busy)
        images.append(ours.view(X_WC, q, 640, 480, 0.8))
    part, whole = images
    assert (part != whole).any()
    channel = 0 if body == "marker" else 1
    mark = (whole[..., channel] > 60) & (whole[..., channel] > 2.0 * whole[..., 1 - channel])
    middle = np.zeros_like(mark)
    middle[140:330, 200:440] = True  # elsewhere are other things of that colour
    mark &= middle
    assert mark.sum() > 100
    around = cv2.dilate(mark.astype(np.uint8), np.ones((7, 7))) > 0
    assert (part == whole)[around].all() == fine


@pytest.mark.parametrize(
    "lights, words",
    [
        ([LAMP] * 5, "at most 4, got 5"),
        ([LightParameter(type="spot")], "directional or point"),
        ([LightParameter(type="directional", frame="diffuse")], "in world or camera"),
    ],
)
def test_lights_that_it_cannot_make_are_refused(lights, words):
    with pytest.raises(ValueError, match=words):
        RenderEngineEgl(lights=lights)


def test_the_same_scene_gives_the_same_bits():
    scene = [(SHAPES["mesh"], at(0, 0, 0.5, 0.4, 0.3, 0.1), (0.8, 0.5, 0.3, 1.0))]
    assert (draw(scene) == draw(scene)).all()


def test_a_vtk_renderer_that_is_deleted_takes_nothing_with_it():
    """VTK ends EGL's display for the whole process."""
    scene = [(Sphere(0.2), at(0, 0, 1), (1.0, 0, 0, 1.0))]
    first = draw(scene)
    draw(scene, "vtk")
    gc.collect()
    assert (draw(scene) == first).all()
