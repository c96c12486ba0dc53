"""Figures that are snapshots of the scenes of Table 1: the runs, side by side as the paper composes them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pdipc.reproduce import _common
from pdipc.reproduce.table1 import ROWS
from pdipc.scene.load import load_scene

PANEL = (800, 640)  # pixels
WIDE = (2400, 1350)
GAP = 8  # pixels of white between panels


def figure(
    out_dir: str | Path,
    name: str,
    rows: Sequence[str],
    parts: Sequence[float],
    claim: str,
    small: bool,
    device: str | None,
    large: float | None = None,
) -> Path:
    """Runs rows of Table 1 and draws each as a line of snapshots, at these parts of its course; large: one more on top, three panels
    wide. Writes `name`.png, .csv and .txt to `out_dir`, returns the PNG. claim: what the paper's caption says.
    """
    import matplotlib.image

    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    lines, table, told = [], [], []
    for row in rows:
        scene = load_scene(ROWS[row].bundled) if small else ROWS[row].full()
        done = _common.simulated(scene, out / row, ROWS[row].title, device)
        crossing = _common.intersections(done)
        frames = [round(part * (done.frame_count - 1)) for part in parts]
        if large is not None:
            (image,) = _common.pictures(done, [round(large * (done.frame_count - 1))], WIDE)
            lines.append(image)
        lines.append(_beside(_common.pictures(done, frames, PANEL)))
        unconverged = sum(not record["converged"] for record in done.stats)
        for record, found in zip(done.stats, crossing[1:], strict=True):
            milliseconds = sum(record["milliseconds"].values())
            table.append(
                (row, record["step"], record["outer"], record["barriers"], record["converged"], found, f"{milliseconds:.1f}")
            )
        told.append(
            f"{ROWS[row].title}: {sum(crossing)} intersections in {done.frame_count} frames, {unconverged} of {len(done.stats)} steps "
            f"unconverged, at most {max(record['barriers'] for record in done.stats)} barriers"
        )
    header = ("row", "step", "outer", "barriers", "converged", "intersections", "milliseconds")
    _common.write_table(out / f"{name}.csv", header, table)
    matplotlib.image.imsave(out / f"{name}.png", _stacked(lines))
    what = "the bundled scene, small" if small else "a scene of the paper's size"
    return _common.conclude(out / f"{name}.png", f"Paper, {claim} Here ({what}): {'; '.join(told)}.")


def _beside(images: Sequence[np.ndarray]) -> np.ndarray:
    white = np.full((images[0].shape[0], GAP, images[0].shape[2]), 255, dtype=np.uint8)
    return np.concatenate([part for image in images for part in (white, image)][1:], axis=1)


def _stacked(lines: Sequence[np.ndarray]) -> np.ndarray:
    """Lines of pictures, one below the other; narrower ones stand in the middle."""
    width, deep = max(line.shape[1] for line in lines), lines[0].shape[2]
    parts = []
    for line in lines:
        left = (width - line.shape[1]) // 2
        right = width - line.shape[1] - left
        parts.append(np.pad(line, ((0, GAP), (left, right), (0, 0)), constant_values=255))
    return np.concatenate(parts)[:-GAP, :, :deep]
