"""Films of pictures, written by ffmpeg: .mp4 (H.264), .gif with the best 256 colours of the whole."""

import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

MP4 = ["-crf", "17", "-preset", "fast", "-movflags", "+faststart"]
WHOLE = ["-qp", "0", "-preset", "ultrafast"]  # without loss
FEW_COLORS = "paletteuse=dither=bayer:bayer_scale=4:diff_mode=rectangle"


@contextmanager
def film(path: Path, size: tuple[int, int], rate: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Yields a function that takes picture after picture, (height, width, 3) uint8; the file is there when all went well.

    size: width and height; an odd side of an .mp4 loses a pixel. rate: pictures a second. Raises ValueError for another suffix.
    """
    import imageio_ffmpeg

    write_frames: Any = imageio_ffmpeg.write_frames  # takes more than its defaults say
    kind = path.suffix.lower()
    if kind not in (".mp4", ".gif"):
        raise ValueError(f'"{path}": a film ends in .mp4 or .gif')
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".film") as folder:
        whole = Path(folder) / ("film.mp4" if kind == ".mp4" else "film.mkv")
        codec, quality, pixels = ("libx264", MP4, "yuv420p") if kind == ".mp4" else ("libx264rgb", WHOLE, "rgb24")
        writer = write_frames(
            str(whole),
            size,
            fps=rate,
            codec=codec,
            quality=None,
            pix_fmt_out=pixels,
            macro_block_size=1,
            output_params=[*quality, *(["-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2"] if kind == ".mp4" else [])],
        )
        writer.send(None)
        try:
            yield lambda picture: writer.send(np.ascontiguousarray(picture))
        finally:
            writer.close()
        if kind == ".gif":
            colors, few = Path(folder) / "colors.png", Path(folder) / "film.gif"
            _ffmpeg(path, "-i", str(whole), "-vf", "palettegen", str(colors))
            _ffmpeg(path, "-i", str(whole), "-i", str(colors), "-filter_complex", FEW_COLORS, str(few))
            whole = few
        whole.replace(path)


def _ffmpeg(path: Path, *arguments: str) -> None:
    """Raises OSError where it fails."""
    import imageio_ffmpeg

    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *arguments], capture_output=True, text=True)
    if done.returncode != 0:
        raise OSError(f"{path} could not be made: {done.stderr.strip()}")
