"""Pictures and films of a run: framed and drawn off-screen by VTK, lit by `shading`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdipc.output.results import Run, RunError
from pdipc.output.skins import Skin
from pdipc.pictures import legend
from pdipc.pictures.creases import split
from pdipc.scene.looks import Look, Picture, looks

if TYPE_CHECKING:
    from pdipc.pictures.shading import Camera

OVERSAMPLED = 2  # drawn pixels per pixel of a picture, along each side
STILL = (".png", ".jpg")
MOVING = (".gif", ".mp4")
SIZE, FILM_SIZE = (1280, 800), (960, 600)  # pixels
PALETTE = ("#3f87c5", "#f0803c", "#4fae7b", "#e2b33c", "#9a72c0", "#dc5f7c", "#3fb0b5", "#a9825a")
OBSTACLE = "#c4c9d0"
GLASS = 0.16  # opacity of obstacles that would hide bodies
NO_DEPTH = 0.99  # opacity of what is as good as opaque and leaves no depth: translucent things do not
EDGE, GLASS_EDGE = "#2b3440", "#8c96a3"
SHARP_EDGE = 40.0  # degrees: sharper edges of solids and obstacles are not shaded smoothly
LARGE = 2.5  # an obstacle of more than so many times the size of what moves is not framed
REACH = 5.0  # ground is drawn up to so many radii of what moves
VIEW = (0.7, 0.42, 1.0)  # from the middle of the bodies towards the camera
FIELD = "field"
COLORS = "viridis"  # of a field on the bodies
UNLOADED = 1e-3  # of the last colour's value: what an obstacle does not show
ANGLE = 28.0  # degrees: vertical field of view at zoom 1
FASTEST = 50.0  # frames a second that players show
SAMPLED = 30  # frames that the camera is placed by
JUDGED = (320, 200)  # pixels: where is asked what hides what
FINENESS, LARGEST_CUT, MOST_CUT = (
    1 / 60,
    64,
    60_000,
)  # of triangles that show a field: of the radius, pieces a side, pieces in all
HIDES_ONE, HIDES_ALL = 0.5, 0.25  # an obstacle is in the way that hides so much of one body, or of all that is seen of them

LAMP = np.array([-0.45, 1.0, 0.75]) / np.linalg.norm([-0.45, 1.0, 0.75])  # towards it
LAMP_ROWS = 900  # of what the lamp sees, at most
LAMP_STRENGTH = 0.78
EVERYWHERE = (((1.0, 0.5, 0.25), 0.34), ((0.1, 0.3, -1.0), 0.22), ((0.0, -1.0, 0.3), 0.12), ((-0.6, 0.6, 1.0), 0.16))
AMBIENT, DIFFUSE = 0.24, 0.85
SHADE_RADIUS = 0.16  # of the radius of what is seen: how near shades
NOTHING_SEEN = (np.ones((2, 2), dtype=np.float32), np.eye(4))  # by the lamp: nothing is in its way
GROUND_LIT = 0.5  # part of the ground's light that the lamp gives


@dataclass
class Field:
    """A number at each vertex, shown as colours. values(frame): (n,), m; top: what the last colour stands for; reach: m, how near an
    obstacle is on which it is shown, too; unit: of the values.
    """

    title: str
    unit: str
    values: Callable[[int], np.ndarray]
    top: float
    reach: float


def pressure(run: Run, frames: list[int], top: float | None = None, progress: Callable[[int], None] | None = None) -> Field:
    """Contact pressure on the given frames, Pa. top: of the last colour; what one in a hundred loaded vertices exceeds where None."""
    from pdipc.audit import vertex_forces
    from pdipc.output.forces import pressures

    found = {}
    for frame, (normal, _) in zip(frames, vertex_forces(run, frames), strict=True):
        found[frame] = pressures(normal, run.positions(frame), run.triangles)
        if progress is not None:
            progress(len(found))
    loaded = np.concatenate([values[values > 0.0] for values in found.values()])
    highest = top or (float(np.quantile(loaded, 0.99)) if len(loaded) else 1.0)
    return Field("contact pressure", "Pa", found.__getitem__, highest, _contact_reach(run))


def _contact_reach(run: Run) -> float:
    """How far apart surfaces are at most that press on each other, with some room, m: see `pdipc.scene.assembly.Assembly`."""
    contact = run.scene.get("contact") or {}
    moving = run.positions(0)[~run.obstacle]
    activation = contact.get("activation_distance") or 1e-3 * float(np.linalg.norm(np.ptp(moving, axis=0)))
    placed = (contact, *run.scene.get("bodies", ()), *run.scene.get("obstacles", ()))
    separation = max(each.get("minimum_separation") or 0.02 * activation for each in placed)
    return 1.5 * (activation + separation)


def settings_of(run: Run) -> Picture:
    """What the run's scene says about its pictures."""
    return Picture.model_validate(run.scene.get("picture") or {})


def render(run: Run, frame: int, path: str | Path, settings: Picture | None = None, field: Field | None = None) -> None:
    """Draws one frame into `path`, .png or .jpg; y is up.

    settings: the run's own where None. field: what colours the bodies, in place of a colour each; made by `pressure` where None and the
    settings ask for that.
    Raises IndexError where there is no such frame, ValueError for another suffix, or a transparent background where there is none.
    """
    from PIL import Image

    path, settings = Path(path), settings or settings_of(run)
    if path.suffix.lower() not in STILL:
        raise ValueError(f'"{path}": a picture ends in one of: {", ".join(STILL)}')
    if settings.background == "transparent" and path.suffix.lower() != ".png":
        raise ValueError(f'"{path}": a transparent background needs .png')
    run.positions(frame)  # raises where there is none
    frame = range(run.frame_count)[frame]
    with drawing(run, [frame], settings, field=field) as drawn:
        image = Image.fromarray(drawn.image(frame))
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path)


def render_animation(
    run: Run,
    path: str | Path,
    settings: Picture | None = None,
    field: Field | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Draws the frames that the settings name into `path`, .gif or .mp4; see `render`. progress(done, of): called after each.

    Raises RunError where there are no frames, ValueError for another suffix or a transparent background.
    """
    from pdipc.pictures.film import film

    path, settings = Path(path), settings or settings_of(run)
    if settings.background == "transparent":
        raise ValueError(f'"{path}": a film has no transparent background; draw a .png')
    frames, rate = taken(run, settings)
    size = settings.size or FILM_SIZE
    with drawing(run, frames, settings, size, field) as drawn, film(path, size, rate) as write:
        for done, frame in enumerate(frames, 1):
            write(drawn.image(frame))
            if progress is not None:
                progress(done, len(frames))


def taken(run: Run, settings: Picture) -> tuple[list[int], float]:
    """The frames of a film, and how many it shows a second."""
    if run.frame_count == 0:
        raise RunError(f"{run.folder} has no frames")
    first, last = settings.frames or (0, -1)
    for frame in (first, last):
        if not -run.frame_count <= frame < run.frame_count:
            raise RunError(f"{run.folder} has no frame {frame}; it has {run.frame_count} frames")
    first, last = (range(run.frame_count)[frame] for frame in (first, last))
    if last < first:
        raise RunError(f"the film would go from frame {first} to frame {last}; the first must come before the last")
    frames = list(range(first, last + 1, settings.every))
    if settings.fps is not None:
        return frames, settings.fps
    rate = (len(frames) - 1) / float(run.times[frames[-1]] - run.times[first]) if len(frames) > 1 else 1.0
    skip = max(1, round(rate / FASTEST))
    return frames[::skip], rate / skip


@contextmanager
def drawing(
    run: Run, frames: list[int], settings: Picture, size: tuple[int, int] = SIZE, field: Field | None = None
) -> "Iterator[Drawing]":
    """A `Drawing`, whose window is closed in the end. size: width and height, pixels, where the settings name none."""
    if field is None and settings.color == "pressure":
        field = pressure(run, frames, settings.top)
    drawn = Drawing(run, frames, settings, settings.size or size, field)
    try:
        yield drawn
    finally:
        drawn.plotter.close()


class Drawing:
    """The bodies of a run on a stage, under one camera that holds them in all of `frames`."""

    def __init__(self, run: Run, frames: list[int], settings: Picture, size: tuple[int, int], field: Field | None = None):
        import pyvista
        from vtkmodules.vtkCommonCore import vtkLogger

        from pdipc.device.launch import Device

        vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # it warns of displays that it can do without
        self.run, self.settings, self.field = run, settings, field
        self.device = Device("cpu")
        width, height = size
        self.beside = legend.width(width, height) if field is not None else 0
        self.size = (width - self.beside, height)
        self.plotter: Any = pyvista.Plotter(off_screen=True, window_size=list(JUDGED), lighting="none")
        self.window: Any = self.plotter.ren_win
        self.window.SetMultiSamples(0)
        self.plotter.renderer.SetUseOIT(False)  # passes over the whole picture, for what alike grey obstacles do not need
        seen = self._framed(frames)
        low, high = seen.min(axis=0), seen.max(axis=0)
        self.center, self.radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)) or 1.0
        self._lights = self._make_lights()
        self.bodies: list[_Body] = []
        self.grounds: list[_Ground] = []
        self._add_bodies(run.positions(frames[0]))
        self._look(seen)
        if settings.obstacles == "auto":
            self._clear_the_way(frames)
        self.plotter.window_size = [OVERSAMPLED * side for side in self.size]

    def image(self, frame: int) -> np.ndarray:
        """(height, width, 3) uint8: the picture of a frame; with a fourth channel, of opacity, where the background is transparent."""
        from pdipc.pictures import shading

        self._move(frame)
        everywhere, depth = self._shot(lamp=False)
        lamp, _ = self._shot(lamp=True)
        shaded = self.settings.shadows and not self.settings.wireframe
        seen, to_lamp = self._seen_by_lamp() if shaded else NOTHING_SEEN
        radius = SHADE_RADIUS * self.radius / self.settings.zoom if shaded else 0.0
        composed = shading.compose(
            self.device, everywhere, lamp, depth, self._camera(), seen, to_lamp, LAMP, radius, OVERSAMPLED
        )
        picture = composed[::-1]
        if self.settings.background == "transparent":
            picture = _over_nothing(picture, everywhere[::-1], self._shot(lamp=False, behind="white")[0][::-1])
        if self.field is None:
            return np.ascontiguousarray(picture)
        bar = legend.draw(self.field.title, self.field.unit, self.field.top, COLORS, (self.beside, self.size[1]))
        if picture.shape[2] == 3:
            covered = bar[..., 3:] / 255.0
            bar = (covered * bar[..., :3] + (1.0 - covered) * _rgb(self.settings.background) + 0.5).astype(np.uint8)
        return np.concatenate([picture, bar], axis=1)

    # --- what stands on the stage ---

    def _add_bodies(self, start: np.ndarray) -> None:
        run, settings = self.run, self.settings
        for body, (kind, look) in enumerate(zip(run.body_kinds, looks(run.scene, run.body_names), strict=True)):
            skin = run.skins[body]
            vertices, triangles = skin.sources, skin.triangles
            obstacle = kind == "obstacle"
            if not len(triangles) or not look.visible or look.opacity == 0.0 or (obstacle and settings.obstacles == "hidden"):
                continue
            if obstacle and _Ground.suits(start[vertices], self.center, self.radius):
                if settings.ground == "auto" and settings.background != "transparent":
                    self.grounds.append(_Ground(self, look, vertices))
                continue
            opacity = look.opacity or (GLASS if obstacle and settings.obstacles == "translucent" else 1.0)
            color = look.color or (OBSTACLE if obstacle else PALETTE[body % len(PALETTE)])
            self.bodies.append(_Body(self, body, start, skin, kind, color, opacity, look))
        if not isinstance(settings.ground, str):
            self.grounds.append(_Ground(self, Look(), None, settings.ground))

    def _make_lights(self) -> tuple[list[Any], Any]:
        """Those that come from everywhere, and the lamp."""
        import pyvista

        def light(way: Any, strength: float) -> Any:
            place = self.center + 50.0 * self.radius * np.array(way)
            made = pyvista.Light(position=place, focal_point=self.center, intensity=strength, light_type="scene light")
            self.plotter.add_light(made)
            return made

        return [light(*each) for each in EVERYWHERE], light(LAMP, LAMP_STRENGTH)

    def _framed(self, frames: list[int]) -> np.ndarray:
        """(k, 3): points of the bodies, and of the obstacles that are not much larger, over some of the frames."""
        kinds, of_vertex = self.run.body_kinds, self.run.topology["body_of_vertex"]
        sampled = [self.run.positions(frames[i]) for i in _sampled(len(frames), SAMPLED)]
        points = [np.concatenate([positions[of_vertex == body] for positions in sampled]) for body in range(len(kinds))]
        drawn = [look.visible for look in looks(self.run.scene, self.run.body_names)]
        moving = [own for own, kind, shown in zip(points, kinds, drawn, strict=True) if kind != "obstacle" and shown]
        moving = moving or [own for own, shown in zip(points, drawn, strict=True) if shown] or points
        size = LARGE * np.linalg.norm(np.ptp(np.concatenate(moving), axis=0))
        wanted = [
            shown and (kind != "obstacle" or self.settings.obstacles != "hidden")
            for kind, shown in zip(kinds, drawn, strict=True)
        ]
        around = [
            own for own, shown in zip(points, wanted, strict=True) if shown and np.linalg.norm(np.ptp(own, axis=0)) < size
        ]
        return np.concatenate(moving + around)

    def _look(self, seen: np.ndarray) -> None:
        """The camera where the settings say, or as near as all points seen (k, 3) allow."""
        settings, camera = self.settings, self.plotter.camera
        target = np.array(settings.target) if settings.target is not None else self.center
        position = None if settings.position is None else np.array(settings.position)
        if position is not None:
            view = (position - target) / np.linalg.norm(position - target)
        else:
            view = np.array(settings.view or VIEW)
            view /= np.linalg.norm(view)
        right = np.cross([0.0, 1.0, 0.0], view)
        right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-9 else np.array([1.0, 0.0, 0.0])
        up = np.cross(view, right)
        if position is None:
            slope, away = np.tan(np.radians(ANGLE / 2)) * 0.9, seen - target
            aspect = self.size[0] / self.size[1]
            needed = np.maximum(np.abs(away @ up) / slope, np.abs(away @ right) / (slope * aspect)) + away @ view
            position = target + needed.max() * view
        camera.focal_point, camera.position, camera.up = target, position, up
        camera.view_angle = 2.0 * np.degrees(np.arctan(np.tan(np.radians(ANGLE / 2)) / settings.zoom))

    def _clear_the_way(self, frames: list[int]) -> None:
        """Makes translucent what hides too much of the bodies in the first, the middle or the last frame."""
        obstacles = [b for b in self.bodies if b.kind == "obstacle" and b.look.opacity is None]
        bodies = [b for b in self.bodies if b.kind != "obstacle"]
        if not obstacles or not bodies:
            return
        numbers = np.arange(1, len(bodies) + 1)
        hiding: dict[int, bool] = {}
        for i in _sampled(len(frames), 3):
            self._move(frames[i])
            with self._only(bodies, numbers):
                image, depth = self._shot(lamp=None)
            number = image.astype(np.int64) @ [1, 256, 65536]
            number[number > len(bodies)] = 0  # a pixel whose colour is of no body
            of_each = np.bincount(number[depth < 1.0], minlength=len(bodies) + 1)
            for obstacle in obstacles:
                with self._only([obstacle], None):
                    _, before = self._shot(lamp=None)
                hidden = np.bincount(number[(before < depth) & (depth < 1.0)], minlength=len(bodies) + 1)
                much = hidden.sum() > HIDES_ALL * of_each.sum() or (hidden > HIDES_ONE * np.maximum(of_each, 20)).any()
                hiding[obstacle.number] = hiding.get(obstacle.number, False) or bool(much)
        for obstacle in obstacles:
            if hiding[obstacle.number]:
                obstacle.become_glass()

    @contextmanager
    def _only(self, shown: "list[_Body]", numbers: np.ndarray | None) -> Iterator[None]:
        """Draws nothing but some bodies, in flat colours that are numbers, if given."""
        for body in (*self.bodies, *self.grounds):
            body.show(body in shown, alone=True)
        if numbers is not None:
            for body, number in zip(shown, numbers, strict=True):
                body.flat([number % 256, number // 256 % 256, number // 65536])
        yield
        for body in (*self.bodies, *self.grounds):
            body.show(True)
        if numbers is not None:
            for body in shown:
                body.flat(None)

    # --- drawing ---

    def _move(self, frame: int) -> None:
        positions = self.run.positions(frame)
        values = self.field.values(frame) if self.field else None
        for body in (*self.bodies, *self.grounds):
            body.move(positions)
        if values is not None:
            pressed = _pressed(self.run, positions, values, self.field.reach)  # pyright: ignore[reportOptionalMemberAccess]
            for body in self.bodies:
                body.color_by(values, pressed)
        camera = self.plotter.camera
        points = np.concatenate([np.asarray(body.mesh.points) for body in (*self.bodies, *self.grounds)])
        away = (points - np.array(camera.position)) @ np.array(camera.direction)
        far = max(1.01 * float(away.max()), 1e-3 * self.radius)
        camera.clipping_range = (max(0.99 * float(away.min()), 1e-3 * far), far)

    def _shot(self, lamp: bool | None, behind: str = "black") -> tuple[np.ndarray, np.ndarray]:
        """(h, w, 3) uint8 and (h, w) float32: what the camera sees in the lamp's light alone, or in all other; None: flat numbers.
        behind: the colour where nothing is, in place of a transparent background.
        """
        everywhere, lamp_light = self._lights
        for light in everywhere:
            light.on = not lamp
        lamp_light.on = bool(lamp)
        if lamp is not None:
            for body in (*self.bodies, *self.grounds):
                body.light(lamp)
        background = self.settings.background
        dark = lamp or lamp is None or background == "transparent"
        self.plotter.set_background(behind if dark else background)
        return self._render()

    def _render(self, part: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """(h, w, 3) uint8 and (h, w) float32: colours and depths of what is seen; of the lower left `part` of the window alone."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonCore import vtkFloatArray, vtkUnsignedCharArray

        window = self.window
        window.Render()
        width, height = (int(part * side) for side in window.GetSize())
        colors, depths = vtkUnsignedCharArray(), vtkFloatArray()
        window.GetPixelData(0, 0, width - 1, height - 1, 0, colors, 0)
        window.GetZbufferData(0, 0, width - 1, height - 1, depths)
        return vtk_to_numpy(colors).reshape(height, width, 3), vtk_to_numpy(depths).reshape(height, width)

    def _camera(self) -> "Camera":
        from pdipc.pictures.shading import Camera

        camera = self.plotter.camera
        away, up = np.array(camera.direction), np.array(camera.up)
        frame = np.eye(4)
        frame[:3] = np.stack([np.cross(away, up), up, away, camera.position], axis=1)
        slope = np.tan(np.radians(camera.view_angle / 2))
        near, far = camera.clipping_range
        return Camera(frame, near, far, (slope * self.size[0] / self.size[1], slope))

    def _seen_by_lamp(self) -> tuple[np.ndarray, np.ndarray]:
        """(k, l) float32: how far the lamp's light gets, in [0, 1]; (4, 4): places to x, y, depth in [0, 1] of that."""
        import pyvista

        throwing = [body for body in self.bodies if body.throws_shadow]
        if not throwing:
            return NOTHING_SEEN
        points = np.concatenate([np.asarray(body.mesh.points) for body in throwing]) - self.center
        radius = min(float(np.linalg.norm(points, axis=1).max()), 2.5 * self.radius) * 1.01
        depth = points @ LAMP
        reach = max(float(depth.max()), radius) * 1.01
        aspect = self.size[0] / self.size[1]
        own, renderer = self.plotter.camera, self.plotter.renderer
        lamp = pyvista.Camera()
        lamp.parallel_projection = True
        lamp.focal_point, lamp.position, lamp.up = self.center, self.center + reach * LAMP, (0.0, 1.0, 0.0)
        lamp.parallel_scale = radius / min(1.0, aspect)
        lamp.clipping_range = (0.0, reach + max(float(-depth.min()), radius) * 1.01)
        part = min(1.0, LAMP_ROWS / (OVERSAMPLED * self.size[1]))
        try:
            renderer.SetActiveCamera(lamp)
            renderer.SetViewport(0.0, 0.0, part, part)
            with self._only(throwing, None):
                _, seen = self._render(part)
        finally:
            renderer.SetViewport(0.0, 0.0, 1.0, 1.0)
            renderer.SetActiveCamera(own)
        halves = np.diag([0.5, 0.5, 0.5, 1.0])
        halves[:3, 3] = 0.5
        return seen, halves @ _projection(lamp, self.size)


class _Body:
    """The mesh of one body: the points of its skin, doubled along sharp edges; vertices: those of the run that they belong to."""

    def __init__(
        self,
        drawing: Drawing,
        number: int,
        positions: np.ndarray,
        skin: Skin,
        kind: str,
        color: str,
        opacity: float,
        look: Look,
    ):
        import pyvista

        settings, plotter = drawing.settings, drawing.plotter
        self.number, self.kind, self.look, self.color, self.plotter = number, kind, look, color, plotter
        self.skin = skin
        self.weights: np.ndarray | None = None  # of the corners of a triangle, for points that are not vertices of the run
        sharp = settings.sharp_edge if settings.sharp_edge is not None else 180.0 if kind == "cloth" else SHARP_EDGE
        self.smooth = sharp > 0.0
        points, triangles = skin.points(positions), skin.triangles
        self.places = np.arange(len(points))  # of the skin's points, which are doubled along sharp edges
        if 0.0 < sharp < 180.0:
            self.places, triangles = split(points, triangles, sharp)
        self.vertices = skin.sources[self.places]
        self.mesh = pyvista.PolyData.from_regular_faces(points[self.places], triangles)
        self.mesh["point"] = self.places
        self.outline: Any = None
        self.uncut = self.mesh
        self.field = drawing.field is not None
        if self.field and kind == "obstacle":
            self._refine(drawing)
        look_up: dict = {"color": color}
        if self.field:
            self.mesh[FIELD] = np.zeros(self.mesh.n_points)
            top = drawing.field.top  # pyright: ignore[reportOptionalMemberAccess]
            look_up = {"scalars": FIELD, "clim": (0.0, top), "cmap": COLORS, "show_scalar_bar": False}
            if kind == "obstacle":  # where nothing presses it keeps its colour
                look_up.update(clim=(UNLOADED * top, top), below_color=color)
        self.wireframe = settings.wireframe
        self.edges = (settings.edges if look.edges is None else look.edges) and not self.wireframe
        self.actor: Any = plotter.add_mesh(
            self.mesh,
            **look_up,
            style="wireframe" if self.wireframe else "surface",
            show_edges=self.edges,
            edge_color=EDGE,
            line_width=OVERSAMPLED,
            smooth_shading=self.smooth,
            specular=0.0 if kind == "obstacle" else 0.12,
            specular_power=25,
            reset_camera=False,
        )
        self.opacity = 1.0
        if opacity < 1.0:
            self.become_glass(opacity)

    @property
    def throws_shadow(self) -> bool:
        return self.opacity > 0.5

    def become_glass(self, opacity: float = GLASS) -> None:
        """Translucent from the front, with its sharp edges drawn."""
        self.opacity = opacity
        self.actor.prop.opacity = opacity
        if self.kind == "obstacle":
            self.actor.prop.culling = "back"
            edges = self.uncut.clean(tolerance=0.0).extract_feature_edges(SHARP_EDGE, manifold_edges=False)
            if edges.n_points:
                self.outline = edges
                self.lines = self.plotter.add_mesh(
                    edges, color=GLASS_EDGE, line_width=1.2 * OVERSAMPLED, lighting=False, opacity=NO_DEPTH, reset_camera=False
                )

    def light(self, lamp: bool) -> None:
        """Translucent bodies are lit from everywhere alone: what is behind them is not to shade them."""
        glass = self.opacity < 1.0
        if self.outline is not None:
            self.lines.visibility = not lamp
        self.actor.prop.ambient = 0.0 if lamp else 0.55 if glass else AMBIENT
        self.actor.prop.diffuse = 0.0 if lamp and glass else DIFFUSE

    def show(self, shown: bool, alone: bool = False) -> None:
        """Whether it is drawn; alone: without lines."""
        self.actor.visibility = shown
        if self.outline is not None:
            self.lines.visibility = shown and not alone

    def flat(self, color: list[int] | None) -> None:
        """A colour as it is, whatever the light, and no lines; None: as before."""
        prop = self.actor.prop
        prop.show_edges = self.edges and color is None
        prop.style = "wireframe" if self.wireframe and color is None else "surface"
        self.actor.mapper.scalar_visibility = self.field and color is None
        prop.lighting = color is None
        prop.color = self.color if color is None else color
        prop.opacity = self.opacity if color is None else 1.0

    def move(self, positions: np.ndarray) -> None:
        """To where its vertices are."""
        if self.weights is None:
            self.mesh.points = self.skin.points(positions)[self.places]
        else:
            self.mesh.points = np.einsum("ki,kij->kj", self.weights, positions[self.vertices])
        if self.outline is not None:
            self.outline.points = self.skin.points(positions)[np.asarray(self.outline["point"])]
        if self.smooth:
            for data in (self.mesh.point_data, self.mesh.cell_data):
                data.pop("Normals", None)  # VTK keeps those that are there
            self.mesh.compute_normals(
                cell_normals=False, inplace=True, split_vertices=False, consistent_normals=False, auto_orient_normals=False
            )

    def color_by(self, values: np.ndarray, pressed: Callable[[np.ndarray], np.ndarray]) -> None:
        """Colours by the field: its own values (n,) on bodies; on obstacles those of what presses there."""
        if self.kind == "obstacle":
            self.mesh[FIELD] = pressed(np.asarray(self.mesh.points))
        else:
            self.mesh[FIELD] = values[self.vertices]

    def _refine(self, drawing: Drawing) -> None:
        """Cuts large triangles, so that what presses somewhere on them can be seen there."""
        import pyvista

        corners = self.mesh.regular_faces
        edges = np.asarray(self.mesh.points)[corners]
        longest = np.linalg.norm(edges - np.roll(edges, 1, axis=1), axis=2).max(axis=1)
        size = drawing.radius * max(FINENESS, np.sqrt((longest**2).sum() / MOST_CUT) / drawing.radius)
        pieces = np.clip(np.ceil(longest / size), 1, LARGEST_CUT).astype(int)
        if pieces.max() == 1:
            return
        weights, vertices, triangles, held = [], [], [], 0
        for count in np.unique(pieces):
            own = corners[pieces == count]
            inner, cut = _cut(count)
            weights.append(np.tile(inner, (len(own), 1)))
            vertices.append(np.repeat(self.vertices[own], len(inner), axis=0))
            triangles.append((held + len(inner) * np.arange(len(own))[:, None, None] + cut).reshape(-1, 3))
            held += len(inner) * len(own)
        self.weights, self.vertices = np.concatenate(weights), np.concatenate(vertices)
        self.smooth = False  # large triangles are flat pieces
        points = np.einsum("ki,kij->kj", self.weights, drawing.run.positions(0)[self.vertices])
        self.mesh = pyvista.PolyData.from_regular_faces(points, np.concatenate(triangles))


class _Ground:
    """A large plane, drawn as a disc that fades into the background: that of an obstacle, or at a height."""

    kind = "ground"

    def __init__(self, drawing: Drawing, look: Look, vertices: np.ndarray | None, height: float = 0.0):
        import pyvista

        self.drawing, self.vertices, self.height = drawing, vertices, height
        disc = pyvista.Disc(inner=0.0, outer=1.0, r_res=48, c_res=96).triangulate()
        self.flat_points = np.asarray(disc.points)[:, :2].copy()
        faded = np.clip((np.linalg.norm(self.flat_points, axis=1, keepdims=True) - 0.3) / 0.65, 0.0, 1.0)
        faded = faded * faded * (3.0 - 2.0 * faded)
        far = _rgb(drawing.settings.background)
        near = _rgb(look.color) if look.color else 0.92 * far + (40.0 if far.mean() < 128.0 else 0.0)
        parts = ((1.0 - GROUND_LIT) * (1.0 - faded) * near + faded * far, GROUND_LIT * (1.0 - faded) * near)
        self.colors = [(part + 0.5).astype(np.uint8) for part in parts]
        self.mesh: Any = disc
        self.mesh["color"] = self.colors[0]
        self.actor: Any = drawing.plotter.add_mesh(self.mesh, scalars="color", rgb=True, lighting=False, reset_camera=False)
        self.actor.prop.culling = "back"  # seen from below it would hide everything

    @staticmethod
    def suits(points: np.ndarray, center: np.ndarray, radius: float) -> bool:
        """Whether the points (k, 3) span a flat rectangle that reaches well around what moves."""
        _, extents, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
        along = (points - center) @ axes.T
        reach = np.minimum(along.max(axis=0), -along.min(axis=0))[:2].min()
        return len(points) >= 4 and bool(extents[2] < 1e-6 * extents[0]) and reach > 0.9 * radius

    def show(self, shown: bool, alone: bool = False) -> None:
        """Whether it is drawn."""
        self.actor.visibility = shown

    def light(self, lamp: bool) -> None:
        """What it shows of the one light or the other."""
        self.mesh["color"] = self.colors[int(lamp)]

    def move(self, positions: np.ndarray) -> None:
        """To where the obstacle is."""
        center, radius = self.drawing.center, self.drawing.radius
        if self.vertices is None:
            axes, height, reach = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), self.height - center[1], REACH * radius
            up = np.array([0.0, 1.0, 0.0])
        else:
            points = positions[self.vertices]
            axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
            along = (points - center) @ axes.T
            reach = min(np.minimum(along.max(axis=0), -along.min(axis=0))[:2].min(), REACH * radius)
            up = axes[2] * (-np.sign(along[:, 2].mean()) or 1.0)
            height = float(((points - center) @ up).mean())
            axes = np.stack([axes[0], np.cross(up, axes[0])])
        self.mesh.points = center + reach * self.flat_points @ axes + height * up


def _cut(count: int) -> tuple[np.ndarray, np.ndarray]:
    """A triangle in count^2 alike: shares (k, 3) of the corners in the points, and triangles (count^2, 3)."""
    number = {(i, j): k for k, (i, j) in enumerate((i, j) for i in range(count + 1) for j in range(count + 1 - i))}
    points = np.array([(count - i - j, i, j) for i, j in number]) / count
    up = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in number if i + j < count]
    down = [(number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for i, j in number if i + j < count - 1]
    return points, np.array(up + down)


def _pressed(run: Run, positions: np.ndarray, values: np.ndarray, reach: float) -> Callable[[np.ndarray], np.ndarray]:
    """Takes points (k, 3) to the field's values (k,) at the nearest points of bodies, 0 where none is within `reach`, m."""
    from pdipc.pictures import nearest

    bodies = ~run.obstacle[run.triangles[:, 0]]
    return lambda points: nearest.values(positions, run.triangles[bodies], values, points, reach)


def _sampled(count: int, most: int) -> np.ndarray:
    """At most so many of 0 to count - 1, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, most).round().astype(int))


def _over_nothing(picture: np.ndarray, on_black: np.ndarray, on_white: np.ndarray) -> np.ndarray:
    """(h, w, 4) uint8: a picture (h, w, 3) that was drawn over black, with how much it covers as its fourth channel; glass covers in part.

    on_black, on_white: the same unlit by the lamp, over black and over white, OVERSAMPLED times as fine: where both are alike nothing
    shows through.
    """
    through = np.subtract(on_white, on_black, dtype=np.int16, casting="unsafe").clip(0).mean(axis=2)
    h, w = picture.shape[:2]
    covered = 255.0 - through.reshape(h, OVERSAMPLED, w, OVERSAMPLED).mean(axis=(1, 3))
    whole = (
        picture * (255.0 / np.maximum(covered, 0.5))[..., None]
    )  # files hold colours as they would be if nothing showed through
    return np.concatenate([whole.clip(0, 255), covered[..., None]], axis=2).round().astype(np.uint8)


def _projection(camera: Any, size: tuple[int, int]) -> np.ndarray:
    """(4, 4): places to x, y, depth in [-1, 1]."""
    matrix = camera.GetCompositeProjectionTransformMatrix(size[0] / size[1], -1.0, 1.0)
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])


def _rgb(color: str) -> np.ndarray:
    """(3,) 0 to 255."""
    return np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)], dtype=float)
