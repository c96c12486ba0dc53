"""Figure 9: the patches of a mesh, and the hierarchy of their boxes."""

from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from pdipc.collision import surface
from pdipc.collision.patches import PatchCulling
from pdipc.collision.sieve import everything
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.reproduce import _common
from pdipc.scene import meshes

SIZE = (560, 640)  # pixels of each of the four pictures
VIEW = (0.7, 0.3, -1.0)  # the Armadillo faces -z


def patches_of(vertices: np.ndarray, triangles: np.ndarray, device: Device) -> tuple[PatchCulling, np.ndarray]:
    """The culling of one body in its rest shape, with the boxes fitted; and the patch of each triangle, in the surface's order."""
    n = len(vertices)
    place = surface.build(device, triangles, vertices, np.zeros(n), np.zeros(n, dtype=bool))
    number = real("float64")
    culling = PatchCulling(device, number, place, wp.zeros(1, dtype=wp.int32, device=device.warp))
    x = wp.array(vertices, dtype=number.vec3, device=device.warp)
    reach = wp.zeros(n, dtype=number.scalar, device=device.warp)
    culling.find(x, x, reach, everything(number))
    while culling.grow():
        culling.find(x, x, reach, everything(number))
    starts = culling.starts[2]
    return culling, np.repeat(np.arange(len(starts) - 1), np.diff(starts))


def boxes(culling: PatchCulling, level: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners (k, 3), m, of the boxes that are not empty on a level of the tree; 0 is the root."""
    nodes = slice(1 << level, 2 << level)
    low, high = culling.tree.nodes.begin_low.numpy()[nodes], culling.tree.nodes.begin_high.numpy()[nodes]
    there = (low <= high).all(axis=1)
    return low[there].astype(float), high[there].astype(float)


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig9.csv, fig9.txt and fig9.png to `out_dir`; returns the PNG.

    The Armadillo of 4000 triangles of the optional data; small, or without it: a generated body.
    """
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    path = None if small else _common.data("meshes/tet/armadillo_9k.npz")
    if path:
        mesh = meshes.read(path)
    else:
        body = _common.creature(_common.BIPED, 0.06 if small else 0.025)
        mesh = meshes.Mesh.of_tets(body["vertices"], body["tets"])
    x = mesh.vertices / np.ptp(mesh.vertices, axis=0).max()
    place = Device(device)
    culling, patch = patches_of(x, mesh.triangles, place)
    sizes = np.bincount(patch, minlength=culling.count)
    levels = culling.tree.leaves.bit_length()
    rows = []
    for level in range(levels):
        low, high = boxes(culling, level)
        rows.append((level, len(low), float(np.prod(high - low, axis=1).sum()), float((high - low).max(axis=1).mean())))
    _common.write_table(out / "fig9.csv", ("level", "boxes", "total_volume", "mean_longest_side"), rows)
    _draw(x, culling, patch, out / "fig9.png")
    found = culling.statistics()
    between = found["patches"] * (found["patches"] - 1) // 2
    sentence = (
        "Paper, Fig. 9: voxels group a model's triangles into patches, and a hierarchy of their boxes lists the patches that "
        f"overlap. Here: {len(patch)} triangles in {found['patches']} patches of at most {sizes.max()} triangles "
        f"(mean {sizes.mean():.1f}), {levels} levels of boxes; at rest {found['overlapping']} of {between} pairs of patches overlap "
        f"({found['overlapping'] / between:.2%})."
    )
    return _common.conclude(out / "fig9.png", sentence)


def _draw(x: np.ndarray, culling: PatchCulling, patch: np.ndarray, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    deepest = culling.tree.leaves.bit_length() - 1
    chosen = [None, *sorted({max(1, deepest - 6), max(2, deepest - 3), deepest})]
    figure, axes = plt.subplots(1, len(chosen), figsize=(12, 3.9), layout="constrained")
    with _common.progress("drawing", len(chosen)) as advance:
        for number, (axis, level) in enumerate(zip(axes, chosen, strict=True)):
            axis.imshow(_picture(x, culling, patch, level))
            axis.axis("off")
            if level is None:
                axis.set_title(f"{culling.count} patches", fontsize=10)
            else:
                what = "one a patch" if level == deepest else f"level {level} of {deepest}"
                axis.set_title(f"{len(boxes(culling, level)[0])} boxes, {what}", fontsize=10)
            advance(number + 1, "")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _picture(x: np.ndarray, culling: PatchCulling, patch: np.ndarray, level: int | None) -> np.ndarray:
    """The mesh with its patches in colours (level None), or pale within the boxes of a level."""
    import pyvista

    plotter: Any = pyvista.Plotter(off_screen=True, window_size=list(SIZE), lighting="three lights")
    plotter.set_background("white")
    mesh = pyvista.PolyData.from_regular_faces(x, culling.surface.members[2])
    colors = _colors(culling.count)
    if level is None:
        mesh["color"] = colors[patch]
        plotter.add_mesh(mesh, scalars="color", rgb=True, ambient=0.25, specular=0.1)
    else:
        plotter.add_mesh(mesh, color="#b4b9c2", smooth_shading=True)
        low, high = boxes(culling, level)
        grid = [pyvista.Box(np.column_stack(corners).ravel()) for corners in zip(low, high, strict=True)]
        own = _colors(len(grid))
        for box, color in zip(grid, own, strict=True):
            box["color"] = np.tile(color, (box.n_points, 1))
        lines = pyvista.merge(grid, merge_points=False)
        plotter.add_mesh(lines, style="wireframe", scalars="color", rgb=True, lighting=False, line_width=2.0)
    plotter.view_vector(VIEW, (0.0, 1.0, 0.0))
    low, high = x.min(axis=0), x.max(axis=0)
    plotter.reset_camera(bounds=np.column_stack([low, high]).ravel())  # the same for all pictures
    plotter.camera.zoom(1.1)
    plotter.enable_anti_aliasing("ssaa")
    image = np.array(plotter.screenshot(return_img=True))
    plotter.close()
    return image


def _colors(count: int) -> np.ndarray:
    """(count, 3) uint8: hues a golden ratio apart, so that neighbours along the curve differ."""
    from matplotlib.colors import hsv_to_rgb

    k = np.arange(count)
    hsv = np.column_stack([k * 0.6180339887 % 1.0, 0.4 + 0.25 * (k % 3) / 2, 0.95 - 0.25 * (k % 4) / 3])
    return (255 * hsv_to_rgb(hsv)).astype(np.uint8)
