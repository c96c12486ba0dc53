"""Pictures show the bodies: framed, in their colours, where the camera is told to stand, and moving where the run moves."""

import numpy as np
import pytest

from pdipc.output.results import RunError, RunWriter, open_run
from pdipc.pictures import legend
from pdipc.scene.errors import SceneError
from pdipc.scene.looks import Look, Picture
from tests.output import runs

pytest.importorskip("pyvista", reason="needs pyvista (extra: pictures)")
imageio = pytest.importorskip("imageio.v3", reason="needs imageio (extra: pictures)")

from pdipc.pictures import render as rendering  # noqa: E402

SIZE = (160, 100)
BLUE, ORANGE = 2, 0  # the channels that stand out in the first two colours of the palette: the ball, the cloth


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    runs.write(folder, steps=4)
    return folder


@pytest.fixture
def run(folder):
    return open_run(folder)


def share(picture: np.ndarray, channel: int) -> np.ndarray:
    """(height, width) bool: pixels in which one colour channel clearly stands out."""
    values = picture[..., :3].astype(int)
    return values[..., channel] > np.delete(values, channel, axis=-1).min(axis=-1) + 60


def drawn(run, frame: int = 0, **settings) -> np.ndarray:
    """The picture of a frame."""
    with rendering.drawing(run, [frame], Picture(**{"size": SIZE, **settings})) as drawing:
        return drawing.image(frame)


def box(folder, gap: float = 0.5, walls: bool = True, height: float = 0.0, width: float = 1.0):
    """A run of one frame: a small ball between plates of a box, or a strip of cloth, 1 m long, above a floor."""
    from pdipc.scene import generators

    names, kinds, meshes, places = ["ball"], ["solid"], [generators.Sphere(radius=0.2, cells=4).mesh()], [np.zeros(3)]
    for axis in range(3) if walls else ():
        for side in (-1, 1):
            size, place = np.full(3, 2 * gap), np.zeros(3)
            size[axis], place[axis] = 0.05, side * (gap + 0.025)
            names.append(f"{'xyz'[axis]}{side}")
            kinds.append("obstacle")
            meshes.append(generators.Box(size=tuple(size), cells=(1, 1, 1)).mesh())
            places.append(place)
    if not walls:
        names, kinds = ["cloth", "floor"], ["cloth", "obstacle"]
        meshes = [generators.Grid(size=(1.0, width), cells=(2, 2)).mesh(), generators.Plane(size=40.0).mesh()]
        places = [np.array([0.0, height, 0.0]), np.zeros(3)]
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    positions = np.concatenate([mesh.vertices + place for mesh, place in zip(meshes, places, strict=True)])
    of_vertex = np.repeat(np.arange(len(meshes)), np.diff(first))
    topology = {
        "triangles": np.concatenate([mesh.triangles + shift for mesh, shift in zip(meshes, first, strict=False)]),
        "tets": np.zeros((0, 4), dtype=int),
        "body_of_vertex": of_vertex,
        "scripted": np.array(kinds)[of_vertex] == "obstacle",
        "body_names": names,
        "body_kinds": kinds,
    }
    with RunWriter.create(folder, "{}", topology, {"precision": "float64"}) as writer:
        writer.append(0, 0.0, positions, {})
    return open_run(folder)


def test_a_still_shows_all_bodies_in_the_middle(run, tmp_path, capfd):
    rendering.render(run, 0, tmp_path / "deep/picture.png", Picture(size=SIZE))
    picture = imageio.imread(tmp_path / "deep/picture.png")
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    ball, cloth = share(picture, BLUE), share(picture, ORANGE)
    assert ball.mean() > 0.01
    assert cloth.mean() > 0.05
    rows, columns = np.nonzero(ball | cloth)
    assert 0.25 * SIZE[0] < columns.mean() < 0.75 * SIZE[0]
    # the bodies fill the picture although the floor is forty times their size, and none is cut off
    assert np.ptp(columns) > 0.4 * SIZE[0] or np.ptp(rows) > 0.4 * SIZE[1]
    assert min(columns.min(), rows.min()) > 0
    assert columns.max() < SIZE[0] - 1
    assert rows.max() < SIZE[1] - 1
    assert capfd.readouterr() == ("", "")  # neither of displays nor of devices


def test_the_camera_stands_where_it_is_told(run):
    ball = np.array([0.0, 0.3, 0.0])
    settings = {"target": tuple(ball), "background": "transparent", "shadows": False}

    def covered(**camera) -> np.ndarray:
        return drawn(run, **camera, **settings)[..., 3] > 127

    run.scene["bodies"][1]["look"] = {"visible": False}
    far = covered(position=(0.0, 0.3, 4.0))
    rows, columns = np.nonzero(far)
    assert (columns.mean(), rows.mean()) == pytest.approx(((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2), abs=0.5)
    # a sphere of radius r at distance d is seen within an angle whose sine is r / d
    radius = SIZE[1] / 2 * np.tan(np.arcsin(0.25 / 4.0)) / np.tan(np.radians(rendering.ANGLE / 2))
    assert np.ptp(rows) + 1 == pytest.approx(2 * radius, abs=2.0)
    near = covered(position=(0.0, 0.3, 4.0), zoom=1.5)
    assert np.sqrt(near.sum() / far.sum()) == pytest.approx(1.5, rel=0.06)
    assert covered(view=(0.0, 1.0, 0.0)).any()


def test_bodies_have_the_looks_that_they_are_given(run):
    run.scene["bodies"][0]["look"] = {"color": "green"}
    run.scene["bodies"][1]["look"] = {"visible": False}
    picture = drawn(run, background="#102030", ground="none", shadows=False)
    np.testing.assert_array_equal(picture[0, 0], [0x10, 0x20, 0x30])
    assert share(picture, 1).mean() > 0.05
    assert not share(picture, ORANGE).any()
    clear = drawn(run, background="transparent")
    assert clear.shape[2] == 4
    assert clear[0, 0, 3] == 0 and clear[50, 80, 3] == 255


def test_glass_covers_a_transparent_background_in_part(run):
    """Over any colour the picture is what it would be with that colour behind it, also at the edges of bodies."""
    run.scene["bodies"][1]["look"] = {"opacity": 0.4}
    look = {"shadows": False, "ground": "none"}
    clear, grey = drawn(run, background="transparent", **look).astype(float), drawn(run, background="#808080", **look)
    part = clear[..., 3:] / 255.0
    assert {0.0, 0.4, 1.0} <= set(np.unique(part.round(2)))
    over = part * clear[..., :3] + (1.0 - part) * 128.0
    assert np.abs(over - grey).max() < 4.0


def test_obstacles_that_hide_bodies_let_them_be_seen(tmp_path):
    run = box(tmp_path / "run")
    assert not share(drawn(run, obstacles="solid"), BLUE).any()
    shown = {how: share(drawn(run, obstacles=how, shadows=False), BLUE).mean() for how in ("auto", "translucent", "hidden")}
    assert share(drawn(run, edges=True, shadows=False), BLUE).mean() > 0.2 * shown["auto"]  # lines do not disturb the judgement
    run.scene["obstacles"] = [{"name": "x1", "look": {"opacity": 0.2}}]
    assert share(drawn(run, shadows=False), BLUE).mean() > 0.6 * shown["auto"]
    assert min(shown.values()) > 0.005
    assert shown["hidden"] > 2 * shown["auto"]  # without the box, the camera is nearer


def test_shadows_are_softer_the_further_away_what_throws_them(tmp_path):
    """The half shadow of an edge at a distance s along the light is as wide as the lamp looks from there, about 2 LAMP_SIZE s."""
    from pdipc.pictures.shading import LAMP_SIZE

    widths = []
    for height in (0.25, 0.5):
        run = box(tmp_path / f"run{height}", walls=False, height=height)
        camera = {"position": (0.0, 6.0, 1e-3), "target": (0.0, 0.0, 0.0), "size": (400, 400), "zoom": 1.0}
        settings = {**camera, "obstacles": "solid"}
        run.scene["bodies"] = [{"name": "cloth", "look": {"visible": True}}]
        picture = drawn(run, **settings).astype(float).mean(axis=2)
        pixel = 2 * 6.0 * np.tan(np.radians(rendering.ANGLE / 2)) / 400  # m on the floor
        # the shadow lies on the side away from the lamp: along x it ends half a side away from its middle
        shift = -rendering.LAMP * height / rendering.LAMP[1]
        row = round(200 + (shift[2]) / pixel)
        columns = 200 + np.arange(round((0.5 * 6.0 / (6.0 - height) + 0.02) / pixel), round(0.9 / pixel))  # of the floor
        profile = picture[row, columns]
        dark, bright = profile.min(), profile.max()
        assert bright > 1.3 * dark
        inner = columns[np.argmax(profile > dark + 0.1 * (bright - dark))]
        outer = columns[np.argmax(profile > dark + 0.9 * (bright - dark))]
        widths.append((outer - inner) * pixel)
        middle = (0.5 * (inner + outer) - 200) * pixel
        assert middle == pytest.approx(0.5 + shift[0], abs=0.06)
    assert widths[1] == pytest.approx(2 * widths[0], rel=0.35)
    assert 0.5 * LAMP_SIZE * 0.5 < widths[1] < 3 * LAMP_SIZE * 0.5 / rendering.LAMP[1]


def test_what_is_thin_and_far_away_throws_next_to_no_shadow(tmp_path):
    """A strip takes of the lamp, which looks 2 LAMP_SIZE s wide from a distance s, no more than its own width."""
    from pdipc.pictures.shading import LAMP_SIZE

    width, height = 0.006, 0.5
    camera = {"position": (0.0, 6.0, 1e-3), "target": (0.0, 0.0, 0.0), "size": (400, 400), "zoom": 2.0}
    run = box(tmp_path / "run", walls=False, height=height, width=width)
    picture = drawn(run, obstacles="solid", **camera).astype(float).mean(axis=2)
    pixel = 2 * 6.0 * np.tan(np.radians(rendering.ANGLE / 2)) / 400 / 2.0  # m on the floor
    middle = 200 - rendering.LAMP[2] * height / rendering.LAMP[1] / pixel
    across = round(0.15 / pixel)
    rows = picture[round(middle) - across : round(middle) + across, 180:220]
    hidden = 4 / np.pi * width / (2 * LAMP_SIZE * height)  # of a disc by a strip through its middle
    assert 0.2 * hidden < 1.0 - rows.min() / rows.max() < 2 * hidden


def test_pressure_is_shown_on_what_is_pressed(run):
    """A field that is linear on the floor of the ball is linear where it is shown beside it."""
    positions = run.positions(0)
    values = 1.0 + positions @ [1.0, 2.0, 3.0]
    shown = rendering._pressed(run, positions, values, reach=0.02)
    triangle = positions[run.triangles[run.body_of_triangle == 1][5]]
    points = triangle.mean(axis=0) + np.array([[0.0, 0.01, 0.0], [0.0, 0.03, 0.0]])
    np.testing.assert_allclose(shown(points), [1.0 + triangle.mean(axis=0) @ [1.0, 2.0, 3.0], 0.0], rtol=1e-5)
    field = rendering.Field("pressure", "Pa", lambda frame: values * 0.0, 1.0, 0.02)
    with rendering.drawing(run, [0], Picture(size=(300, 100)), field=field) as drawing:
        picture = drawing.image(0)
    assert picture.shape == (100, 300, 3)
    beside = picture[:, -drawing.beside :].reshape(-1, 3)
    assert len(np.unique(beside, axis=0)) > 50  # the bar of colours is beside the bodies


@pytest.mark.parametrize("count", [1, 2, 5])
def test_cut_triangles_cover_the_triangle(count):
    points, triangles = rendering._cut(count)
    corners = (points @ [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])[triangles]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = 0.5 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    np.testing.assert_allclose(areas, 0.5 / count**2, rtol=1e-12)
    assert len(areas) == count**2


@pytest.mark.parametrize("top", [0.07, 1.0, 3.3, 87e3, 9.99])
def test_ticks_are_round_and_few(top):
    ticks = legend.ticks(top)
    assert 4 <= len(ticks) <= 11
    assert ticks[0] == 0.0 and 0.5 * top < ticks[-1] <= top * (1 + 1e-9)


def test_a_film_has_a_frame_for_every_second_step(run, tmp_path):
    rendering.render_animation(run, tmp_path / "run.gif", Picture(size=SIZE, every=2))
    assert len(imageio.imread(tmp_path / "run.gif", index=None)) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["run.gif"]


def test_frames_and_rate_of_a_film(run):
    assert rendering.taken(run, Picture()) == ([0, 2, 4], pytest.approx(50.0))  # a hundred frames a second are too many
    assert rendering.taken(run, Picture(frames=(1, -2), fps=3.0)) == ([1, 2, 3], 3.0)
    with pytest.raises(RunError, match="has no frame 9; it has 5 frames"):
        rendering.taken(run, Picture(frames=(0, 9)))
    with pytest.raises(RunError, match="from frame 3 to frame 1"):
        rendering.taken(run, Picture(frames=(3, 1)))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"size": (8, 100)}, "size"),
        ({"view": (0, 0, 0)}, "direction"),
        ({"view": (0, 0, 1), "position": (0, 0, 1)}, "no effect beside position"),
        ({"background": "mauve"}, "must be a color like"),
        ({"ground": "sand"}, "ground"),
        ({"top": 3.0}, "no effect without"),
        ({"sharp_edge": 200}, "sharp_edge"),
        ({"edges": True, "wireframe": True}, "no effect beside wireframe"),
    ],
)
def test_settings_that_cannot_be_drawn_are_refused(settings, said):
    with pytest.raises(SceneError, match=said):
        Picture(**settings)


def test_colors_have_one_form():
    assert Look(color="#ABC").color == "#aabbcc"
    assert Look(color="orange").color == rendering.PALETTE[1]


def test_what_a_file_cannot_hold_is_refused(run, tmp_path):
    with pytest.raises(ValueError, match=r"needs .png"):
        rendering.render(run, 0, tmp_path / "a.jpg", Picture(background="transparent"))
    with pytest.raises(ValueError, match="no transparent background"):
        rendering.render_animation(run, tmp_path / "a.gif", Picture(background="transparent"))
    with pytest.raises(IndexError, match="has no frame 7"):
        rendering.render(run, 7, tmp_path / "a.png")


def test_shading_turns_with_the_body(run):
    """The normals of a ball point away from its middle, also after it has turned."""
    with rendering.drawing(run, [0], Picture(size=SIZE)) as picture:
        (ball,) = (body for body in picture.bodies if getattr(body, "kind", None) == "solid")
        start, middle = run.positions(0), np.array([0.0, 0.3, 0.0])
        turned = (start - middle) @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]) + middle
        for positions in (start, turned):
            ball.move(positions)
            out = np.asarray(ball.mesh.points) - middle
            out /= np.linalg.norm(out, axis=1, keepdims=True)
            assert np.einsum("ij,ij->i", out, np.asarray(ball.mesh.point_data["Normals"])).min() > 0.9
