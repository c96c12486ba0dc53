"""A picture of where a scene intersects at its start, with PyVista."""

from pathlib import Path
from typing import Any

import numpy as np

from pdipc.judge.witness import find_intersections
from pdipc.scene.assembly import Assembly

SIZE = (1600, 800)  # pixels: the whole at the left, what intersects at the right
BODIES = ("#3f87c5", "#f0803c", "#4fae7b", "#e2b33c", "#9a72c0")
OBSTACLE, WRONG = "#9aa3ad", "#d1002a"
OPACITY = 0.35  # of what does not intersect
CLOSE = 1.5  # how many times the size of what intersects the right part shows, at least
VIEW = np.array([0.7, 0.42, 1.0]) / np.linalg.norm([0.7, 0.42, 1.0])


def draw_start(assembly: Assembly, path: str | Path) -> int:
    """Draws the start of `assembly` into `path`, with the triangles that intersect in red; returns how many pairs there are.

    Raises ImportError without PyVista (the extra "pictures").
    """
    import pyvista

    x, triangles = assembly.positions, assembly.triangles
    pairs = find_intersections(x, triangles, assembly.obstacle)
    wrong = np.unique(pairs)
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=list(SIZE), shape=(1, 2), border=False)
    seen = [x[triangles].reshape(-1, 3)[:: max(1, 3 * len(triangles) // 30000)], x[triangles[wrong]].reshape(-1, 3)]
    moving = ~assembly.obstacle
    if moving.any():  # a large floor is not framed
        seen[0] = x[moving]
    for column, points in enumerate(seen if len(wrong) else seen[:1] * 2):
        plotter.subplot(0, column)
        plotter.set_background("white")
        for number, body in enumerate(assembly.bodies):
            color = OBSTACLE if body.kinematic else BODIES[number % len(BODIES)]
            mesh = pyvista.PolyData.from_regular_faces(x, body.triangles)
            edges = column == 1 and bool(len(wrong))
            plotter.add_mesh(mesh, color=color, opacity=OPACITY, show_edges=edges, edge_color=color, line_width=0.5)
        if len(wrong):
            mesh = pyvista.PolyData.from_regular_faces(x, triangles[wrong])
            plotter.add_mesh(mesh, color=WRONG, lighting=False, show_edges=True, edge_color="black", line_width=1)
        told = f"{len(pairs)} pairs of triangles intersect" if len(wrong) else "nothing intersects"
        plotter.add_text(told if column == 0 else "where", font_size=10, color="black")
        low, high = points.min(axis=0), points.max(axis=0)
        radius = 0.5 * CLOSE * float(np.linalg.norm(high - low)) or 1.0
        plotter.camera.focal_point = 0.5 * (low + high)
        plotter.camera.position = 0.5 * (low + high) + 3.0 * radius * VIEW
        plotter.camera.up = (0.0, 1.0, 0.0)
        plotter.camera.view_angle = 2.0 * float(np.degrees(np.arctan(1.0 / 3.0)))
        plotter.reset_camera_clipping_range()
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    plotter.screenshot(str(path))
    plotter.close()
    return len(pairs)
