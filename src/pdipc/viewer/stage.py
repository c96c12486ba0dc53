"""The page: bodies, light and camera, and the parts of its panel that runs and live scenes share."""

import contextlib
import io
import socket
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from pdipc.output.skins import skin
from pdipc.pictures import nearest
from pdipc.pictures.creases import closed, split
from pdipc.pictures.render import GLASS, HIDES_ALL, LARGE, OBSTACLE, PALETTE, SHARP_EDGE, VIEW
from pdipc.scene.looks import Look, Picture
from pdipc.viewer.guard import EVERYWHERE, Guard

HOST, PORT = "localhost", 8080
SEEN = 2000  # points of bodies by which is judged what hides them
LISTED = 40  # bodies that can be hidden one by one
UNLOADED = (205, 208, 214)  # colour of what nothing presses, where pressure is shown
LEVELS = (
    (68, 1, 84),
    (65, 68, 135),
    (42, 120, 142),
    (34, 168, 132),
    (122, 209, 81),
    (253, 231, 37),
)  # viridis, of low to high pressure
BESIDE = {
    "front": (0.0, 0.15, 1.0),
    "side": (1.0, 0.15, 0.0),
    "top": (0.0, 1.0, 1e-3),
    "corner": VIEW,
}  # directions to the camera
AWAY = 0.95  # distance of the camera, of the size of what is seen
AXES = (("x", "#d5453f"), ("y", "#3f9b4f"), ("z", "#3b74c9"))
PLOTTED = 600  # steps that plots show


class Stage:
    """The surfaces of all bodies on a web page, one mesh a body, whose vertices are doubled along sharp edges.

    triangles: (m, 3); body_of_vertex: (n,); kinds: "solid", "cloth", "rod" or "obstacle" a body, radii: (bodies,) m, of rods; positions: (n, 3), m. names: of the bodies;
    looks: of each; picture: where the camera stands.
    The page is served at `url` as long as the object lives, to whoever knows that address, which has a token in it (`guard`); if the
    port is taken, the next free one is used. origins: pages elsewhere that may connect too.
    Raises OSError for a host that this machine cannot serve at, ValueError for an origin that is none.
    """

    # Arguments: what is shown, and where it is served.
    def __init__(
        self,
        triangles: np.ndarray,
        body_of_vertex: np.ndarray,
        kinds: list[str],
        radii: np.ndarray,
        positions: np.ndarray,
        host: str,
        port: int,
        origins: Sequence[str] = (),
        names: Sequence[str] = (),
        looks: Sequence[Look] = (),
        picture: Picture | None = None,
    ):
        import viser

        _must_be_here(host)
        guard = Guard(host, origins)
        with guard.on_duty(), contextlib.redirect_stdout(io.StringIO()):  # viser prints its address, without the token
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        shown = "localhost" if host in EVERYWHERE else f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self.server.get_port()}/{guard.token}/"
        self.server.gui.configure_theme(show_logo=False, control_width="medium", brand_color=(47, 111, 171))
        self.server.scene.set_up_direction("+y")
        self.server.on_client_connect(_add_compass)
        self._light()
        self.on_drag: Callable[[int, Any], None] | None = None
        self.picture = picture or Picture()
        self.build(triangles, body_of_vertex, kinds, radii, positions, names, looks)

    def build(
        self,
        triangles: np.ndarray,
        body_of_vertex: np.ndarray,
        kinds: list[str],
        radii: np.ndarray,
        positions: np.ndarray,
        names: Sequence[str] = (),
        looks: Sequence[Look] = (),
    ) -> None:
        """Makes the meshes, in place of earlier ones, and aims the camera at them."""
        for mesh in getattr(self, "meshes", ()):
            mesh.remove()
        self.kinds = kinds
        self.names = list(names) or [f"body {number}" for number in range(len(kinds))]
        looks = list(looks) or [Look() for _ in kinds]
        self.meshes, self.skins, self.places, self.faces = [], [], [], []
        of_triangle = body_of_vertex[triangles[:, 0]]
        for body, (kind, look) in enumerate(zip(kinds, looks, strict=True)):
            drawn = skin(triangles[of_triangle == body], float(radii[body]))
            points, local = drawn.points(positions), drawn.triangles
            shadows: dict[str, Any] = {
                "side": "front"
            }  # the lamp sees the backs of what is closed, which then throws no shadow on itself
            if kind == "cloth":
                shadows = {"side": "double", "receive_shadow": False}
            elif not closed(local):
                shadows = {"side": "double", "cast_shadow": False}
            places = np.arange(len(points))
            if len(local) and kind != "cloth":
                places, local = split(points, local, SHARP_EDGE)
            color = look.color or (OBSTACLE if kind == "obstacle" else PALETTE[body % len(PALETTE)])
            self.skins.append(drawn)
            self.places.append(places)
            self.faces.append(local)
            self.meshes.append(
                self.server.scene.add_mesh_simple(
                    f"/body{body}",
                    points[places].astype(np.float32),
                    local,
                    color=_rgb(color),
                    opacity=None if look.opacity in (None, 1.0) else look.opacity,
                    visible=look.visible and look.opacity != 0.0,
                    **shadows,
                )
            )
        self._looks = looks
        self.colors = [mesh.color for mesh in self.meshes]
        nothing = np.zeros((3, 3), dtype=np.float32), np.arange(3).reshape(1, 3)
        self.levels = [
            self.server.scene.add_mesh_simple(f"/pressure{number}", *nothing, color=color, side="double", visible=False)
            for number, color in enumerate(LEVELS)
        ]
        self.pressed = False
        self.center, self.size = _framed(positions, body_of_vertex, kinds)
        view = np.array(self.picture.view or VIEW)
        at = self._from(view / np.linalg.norm(view)) if self.picture.position is None else np.array(self.picture.position)
        target = self.center if self.picture.target is None else np.array(self.picture.target)
        self.server.initial_camera.look_at, self.server.initial_camera.position = tuple(target), tuple(at)
        self._in_the_way = self._hiding(positions, triangles, body_of_vertex, at)
        self.show_obstacles(self.picture.obstacles)
        if self.on_drag is not None:
            self.listen(self.on_drag)

    def _hiding(self, positions: np.ndarray, triangles: np.ndarray, body_of_vertex: np.ndarray, eye: np.ndarray) -> list[bool]:
        """Which obstacles hide too much of the bodies from where the camera stands at the start."""
        own = [drawn.sources for drawn, kind in zip(self.skins, self.kinds, strict=True) if kind != "obstacle"]
        seen = np.concatenate(own) if own else np.zeros(0, dtype=int)
        points = positions[seen[:: 1 + len(seen) // SEEN]]
        of_triangle = body_of_vertex[triangles[:, 0]]
        return [
            kind == "obstacle"
            and len(points) > 0
            and nearest.hidden(positions, triangles[of_triangle == body], points, eye).mean() > HIDES_ALL
            for body, kind in enumerate(self.kinds)
        ]

    def show_obstacles(self, how: str) -> None:
        """How those are drawn whose look does not say: "auto" is translucent where they hide bodies, "solid", "translucent" or "hidden"."""
        for body, (mesh, look) in enumerate(zip(self.meshes, self._looks, strict=True)):
            if self.kinds[body] == "obstacle" and look.opacity is None:
                glass = how == "translucent" or (how == "auto" and self._in_the_way[body])
                mesh.opacity = GLASS if glass else None
                mesh.cast_shadow = not glass and mesh.side == "front"
                mesh.visible = look.visible and how != "hidden"

    def listen(self, on_drag: Callable[[int, Any], None]) -> None:
        """Calls on_drag(body, event) where a body that is no obstacle is dragged."""
        self.on_drag = on_drag
        for body, mesh in enumerate(self.meshes):
            if self.kinds[body] != "obstacle":
                mesh.on_drag("left")(lambda event, body=body: on_drag(body, event))

    def show(self, positions: np.ndarray, pressure: np.ndarray | None = None, top: float = 1.0) -> None:
        """Moves all bodies to positions (n, 3), m. pressure: (n,) Pa, shown as colours up to `top`; None: a colour a body."""
        with self.server.atomic():
            for mesh, drawn, places in zip(self.meshes, self.skins, self.places, strict=True):
                mesh.vertices = drawn.points(positions)[places].astype(np.float32)
            if pressure is not None or self.pressed:
                self._color(pressure, top)

    def _color(self, pressure: np.ndarray | None, top: float) -> None:
        """Triangles that are pressed are taken from the meshes of the bodies and put into one mesh for each level of pressure."""
        grouped: list[list[np.ndarray]] = [[] for _ in LEVELS]
        for body, (mesh, faces) in enumerate(zip(self.meshes, self.faces, strict=True)):
            left = faces
            if pressure is not None and len(faces):
                mean = pressure[self.skins[body].sources[self.places[body][faces]]].mean(axis=1) / top
                level = np.clip((mean * len(LEVELS)).astype(int), 0, len(LEVELS) - 1)
                loaded = mean > 1e-3
                left = faces[~loaded] if not loaded.all() else faces[:1]
                if mesh.visible:
                    for number, group in enumerate(grouped):
                        group.append(mesh.vertices[faces[loaded & (level == number)]].reshape(-1, 3))
            if len(left) != len(mesh.faces) or not np.array_equal(left, mesh.faces):
                mesh.faces = left
            mesh.color = self.colors[body] if pressure is None or self.kinds[body] == "obstacle" else UNLOADED
        for number, group in enumerate(grouped):
            corners = np.concatenate(group) if group else np.zeros((0, 3), dtype=np.float32)
            self.levels[number].visible = len(corners) > 0
            if len(corners):
                self.levels[number].vertices = corners
                self.levels[number].faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
        self.pressed = pressure is not None

    def close(self) -> None:
        """Ends the page."""
        self.server.stop()

    # --- light and camera ---

    def _light(self) -> None:
        scene = self.server.scene
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_hemisphere("/light/sky", sky_color=(255, 255, 255), ground_color=(150, 155, 165), intensity=1.5)
        scene.add_light_directional("/light/lamp", intensity=2.0, position=(-0.45, 1.0, 0.75), cast_shadow=True)
        scene.add_light_directional("/light/side", intensity=0.5, position=(1.0, 0.4, 0.2))

    def _from(self, direction: Any) -> np.ndarray:
        return self.center + AWAY * self.size * np.array(direction) / np.linalg.norm(direction)

    def look_from(self, preset: str) -> None:
        """Turns the cameras of all that watch: "front", "side", "top" or "corner"."""
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.look_at = tuple(self.center)
                client.camera.position = tuple(self._from(BESIDE[preset]))
                client.camera.up_direction = (0.0, 1.0, 0.0)

    # --- the panel ---

    def add_view_panel(self) -> Any:
        """Cameras, colours, and a list of bodies to hide; returns the choice of colours."""
        gui = self.server.gui
        with gui.add_folder("view"):
            presets = gui.add_button_group("camera", list(BESIDE))
            presets.on_click(lambda _: self.look_from(presets.value))
            color = gui.add_dropdown("color", ("body", "pressure"), initial_value=self.picture.color)
            obstacles = gui.add_dropdown(
                "obstacles", ("auto", "solid", "translucent", "hidden"), initial_value=self.picture.obstacles
            )
            obstacles.on_update(lambda _: self.show_obstacles(obstacles.value))
        self._list = gui.add_folder("bodies", expand_by_default=len(self.names) <= 6)
        self._boxes: list[Any] = []
        self.list_bodies()
        return color

    def list_bodies(self) -> None:
        """A box for each body, which shows or hides it; for the first of very many."""
        for box in self._boxes:
            box.remove()
        with self._list:
            self._boxes = [
                self.server.gui.add_checkbox(name, initial_value=mesh.visible)
                for name, mesh in zip(self.names[:LISTED], self.meshes, strict=False)
            ]
        for box, mesh in zip(self._boxes, self.meshes, strict=False):
            box.on_update(lambda _, box=box, mesh=mesh: setattr(mesh, "visible", box.value))


class Plot:
    """Curves over time on the page. names: of the curves; log: whether their common logarithms are drawn."""

    def __init__(self, gui: Any, title: str, names: Sequence[str], log: bool = False):
        self.log = log
        series = [
            {"label": "time, s"},
            *({"label": name, "stroke": color, "width": 1.5} for name, color in zip(names, PALETTE, strict=False)),
        ]
        empty = tuple(np.zeros(0) for _ in series)
        self.chart = gui.add_uplot(
            empty, tuple(series), title=title, scales={"x": {"time": False}}, axes=({}, {"size": 64}), height=150
        )

    def show(self, times: Iterable[float], values: Iterable[Sequence[float]]) -> None:
        """Shows values (k, number of curves) at times (k,), s."""
        rows = np.array(list(values), dtype=float).reshape(-1, len(self.chart.data) - 1)
        rows = np.log10(rows) if self.log else rows  # the page's own logarithmic axis writes small values as 0
        self.chart.data = (np.array(list(times), dtype=float), *rows.T)


def badge(record: dict[str, Any], said: str = "") -> str:
    """HTML: whether the step of a record has converged; said: words beside it."""
    if "converged" not in record:
        color, words = "#8a929c", "start"
    else:
        color, words = ("#2e8b57", "converged") if record["converged"] else ("#c77700", "not converged")
    style = f"background:{color};color:white;border-radius:8px;padding:1px 8px;font-size:85%"
    return f'<div style="padding:4px 8px"><span style="{style}">{words}</span> <span style="font-size:85%">{said}</span></div>'


def told(at: float, record: dict[str, Any]) -> str:
    """Time and statistics of a step, for people."""
    lines = [f"time {at:.3f} s"]
    if record:
        gap = record.get("smallest_gap")
        lines.append(f"contacts {record.get('barriers', 0)}, smallest gap {'none' if gap is None else f'{1e3 * gap:.3g} mm'}")
        lines.append(f"outer iterations {record.get('outer', 0)}, {sum(record.get('milliseconds', {}).values()):.0f} ms a step")
        lines.append(record.get("message", ""))
    return "\n\n".join(filter(None, lines))


def _add_compass(client: Any) -> None:
    """Draws the axes in the panel of who connects, as they lie in that camera: y is up."""
    drawing = client.gui.add_html("", order=1e9)

    def draw(_: Any = None) -> None:
        drawing.content = compass(client.camera.wxyz)

    client.camera.on_update(draw)


def compass(wxyz: np.ndarray) -> str:
    """SVG of the axes for a camera of that orientation, whose own axes are right, down and away."""
    w, v = wxyz[0], np.asarray(wxyz[1:])
    axes = [
        axis - 2 * w * np.cross(v, axis) + 2 * np.cross(v, np.cross(v, axis)) for axis in np.eye(3)
    ]  # turned back by the quaternion
    lines = []
    for (name, color), to in sorted(zip(AXES, axes, strict=True), key=lambda pair: -pair[1][2]):  # the nearest last
        x, y = 36 + 24 * to[0], 36 + 24 * to[1]
        lines.append(f'<line x1="36" y1="36" x2="{x:.1f}" y2="{y:.1f}" stroke="{color}" stroke-width="3"/>')
        lines.append(
            f'<text x="{36 + 32 * to[0]:.1f}" y="{40 + 32 * to[1]:.1f}" fill="{color}" text-anchor="middle">{name}</text>'
        )
    return f'<svg width="72" height="72" font-size="12" font-family="sans-serif">{"".join(lines)}</svg>'


def _framed(positions: np.ndarray, body_of_vertex: np.ndarray, kinds: list[str]) -> tuple[np.ndarray, float]:
    """Middle (3,) and size, m, of the bodies and of the obstacles that are not much larger."""
    points = [positions[body_of_vertex == body] for body in range(len(kinds))]
    moving = np.concatenate([own for own, kind in zip(points, kinds, strict=True) if kind != "obstacle"] or points)
    limit = LARGE * np.linalg.norm(np.ptp(moving, axis=0))
    around = [own for own in points if len(own) and np.linalg.norm(np.ptp(own, axis=0)) < limit]
    seen = np.concatenate([moving, *around])
    low, high = seen.min(axis=0), seen.max(axis=0)
    return 0.5 * (low + high), float(np.linalg.norm(high - low)) or 1.0


def _must_be_here(host: str) -> None:
    """viser would wait for ever for a server that cannot start."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except OSError as error:
        raise OSError(f'host "{host}" is no address of this machine ({error.strerror}); it must be like localhost') from error


def _rgb(color: str) -> tuple[int, int, int]:
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return red, green, blue
