"""How a run is drawn, as far as a scene says so: `[picture]` for the whole, `look` for a body. Simulations do not read it."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, StrictBool, model_validator

from pdipc.scene.tables import Number, Positive, Real, Table, Vector, Whole

NAMED = {
    "black": "#000000",
    "white": "#ffffff",
    "gray": "#808080",
    "grey": "#808080",
    "red": "#d62728",
    "orange": "#f0803c",
    "yellow": "#e2b33c",
    "green": "#4fae7b",
    "blue": "#3f87c5",
    "purple": "#9a72c0",
    "pink": "#dc5f7c",
    "teal": "#3fb0b5",
    "brown": "#a9825a",
}
LARGEST = 8192  # pixels of a side: what every driver draws
Side = Annotated[Whole, Field(ge=16, le=LARGEST)]


def _hex(color: str) -> str:
    """#rrggbb of a name or of #rgb."""
    given = color.strip().lower()
    digits = given.removeprefix("#")
    if given.startswith("#") and len(digits) == 3:
        digits = "".join(2 * digit for digit in digits)
    if given.startswith("#") and len(digits) == 6 and all(digit in "0123456789abcdef" for digit in digits):
        return f"#{digits}"
    if given in NAMED:
        return NAMED[given]
    raise ValueError(f"must be a color like #3f87c5, or one of: {', '.join(NAMED)}")


def _no_zero(way: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(way):
        raise ValueError("must not be zero: it is a direction")
    return way


Color = Annotated[str, AfterValidator(_hex)]


class Look(Table):
    """How one body, with its copies, or one obstacle is drawn."""

    color: Color | None = Field(default=None, description='"#rrggbb" or a name such as "red"; absent: from the palette.')
    opacity: Annotated[Real, Field(ge=0.0, le=1.0)] | None = Field(
        default=None, description="1 hides what is behind, 0 is not drawn; absent: 1, and as `picture.obstacles` says."
    )
    visible: StrictBool = Field(default=True, description="Whether it is drawn.")
    edges: StrictBool | None = Field(
        default=None, description="Whether its mesh's edges are drawn; absent: as `picture.edges`."
    )


class Picture(Table):
    """How a run is drawn by `pdipc render`, whose options come first, and from where the viewer looks at the start."""

    size: tuple[Side, Side] | None = Field(
        default=None, description="Width and height, pixels; absent: 1280 x 800, of a film 960 x 600."
    )
    view: Annotated[Vector, AfterValidator(_no_zero)] | None = Field(
        default=None,
        description="Direction from what is seen to the camera, which stands as near as all bodies allow. Absent: [0.7, 0.42, 1].",
    )
    position: Vector | None = Field(default=None, description="Where the camera stands, m; in place of `view`.")
    target: Vector | None = Field(default=None, description="What it looks at, m; absent: the middle of the bodies.")
    zoom: Positive = Field(default=1.0, le=1000.0, description="2 shows everything twice as large.")
    frames: tuple[Whole, Whole] | None = Field(
        default=None, description="First and last frame of a film; negative ones count from the end. Absent: all."
    )
    every: Whole = Field(default=1, ge=1, description="A film takes every so many frames.")
    fps: Positive | None = Field(
        default=None, le=240.0, description="Frames that a film shows a second; absent: in the time that it took, at most 50."
    )
    background: Literal["transparent"] | Color = Field(
        default="#f8f9fb", description='A color, or "transparent" for .png, then without ground.'
    )
    ground: Literal["auto", "none"] | Number = Field(
        default="auto",
        description='"auto" draws a large flat obstacle as ground that fades into the background, "none" leaves it out; a number: a '
        "plane at that height, m, that is only drawn.",
    )
    obstacles: Literal["auto", "solid", "translucent", "hidden"] = Field(
        default="auto", description='"auto": translucent where they hide bodies from the camera.'
    )
    color: Literal["body", "pressure"] = Field(
        default="body",
        description="A color for each body, or the pressure of contact; obstacles show it where something presses on them.",
    )
    top: Positive | None = Field(
        default=None, description="Pressure of the last color, Pa; absent: what one in a hundred loaded vertices exceeds."
    )
    shadows: StrictBool = Field(default=True, description="Shadows of a lamp, and shade in corners and folds.")
    sharp_edge: Annotated[Real, Field(ge=0.0, le=180.0)] | None = Field(
        default=None,
        description="Edges with a sharper angle are not shaded smoothly, degrees; 0: flat triangles. Absent: 40 for solids and "
        "obstacles, 180 for cloth.",
    )
    edges: StrictBool = Field(default=False, description="Draws the edges of meshes.")
    wireframe: StrictBool = Field(default=False, description="Draws nothing but edges, without shadows.")

    @model_validator(mode="after")
    def _check(self) -> "Picture":
        if self.position is not None and self.view is not None:
            raise ValueError("view has no effect beside position; give one of the two")
        if self.position is not None and self.position == self.target:
            raise ValueError("position and target must differ")
        if self.top is not None and self.color != "pressure":
            raise ValueError('top has no effect without color = "pressure"')
        if self.edges and self.wireframe:
            raise ValueError("edges has no effect beside wireframe; give one of the two")
        return self


def looks(scene: dict[str, Any], names: list[str]) -> list[Look]:
    """The look of each body of a run by its name there; copies have the look of what they copy. scene: as a dict."""
    given = {placed["name"]: placed.get("look") or {} for placed in (*scene.get("bodies", ()), *scene.get("obstacles", ()))}
    found = [given.get(name, given.get(name.rpartition("[")[0], {})) for name in names]
    return [Look.model_validate(look) for look in found]
