"""Runs every bundled scene and draws docs/scenes.png: `python docs/draw_scenes.py [-o FILE]`. Takes some minutes."""

import argparse
import tempfile
import tomllib
from importlib import resources
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
from typer.testing import CliRunner

from pdipc.cli import app

matplotlib.use("Agg")

# Where not the last frame from the usual side shows best: options of `pdipc render`.
PICTURES = {
    "cloth_on_sphere": [],
    "box_stack": [],
    "squeeze": ["--frame", "110", "--color", "pressure"],
    "thin_rod": ["--frame", "85"],
    "tori_in_bowl": ["--view", "0.5,1.1,0.8"],
    "twisted_cloth": ["--frame", "175"],
    "wind_flag": ["--frame", "130", "--view", "0.2,0.2,1"],
    "bear_on_stairs": ["--frame", "65"],
}
SIZE = "1200x800"


def command(*arguments: str) -> None:
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    if result.exit_code != 0:
        raise SystemExit(f"pdipc {' '.join(arguments)}: {result.output}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_name("scenes.png"))
    out = parser.parse_args().output
    figure, axes = plt.subplots(2, 4, figsize=(19.2, 7.0), layout="constrained")
    with tempfile.TemporaryDirectory() as folder:
        for (name, options), axis in zip(PICTURES.items(), axes.ravel(), strict=True):
            run, picture = f"{folder}/{name}", f"{folder}/{name}.png"
            command("run", name, "-o", run)
            command("check", run)
            command("render", run, "-o", picture, "--size", SIZE, *options)
            axis.imshow(plt.imread(picture))
            axis.set_xlabel(title(name), fontsize=15)
            axis.set(xticks=[], yticks=[], frame_on=False)
    figure.savefig(out, dpi=100)


def title(name: str) -> str:
    return tomllib.loads((resources.files("pdipc.scenes") / f"{name}.toml").read_text())["title"]


if __name__ == "__main__":
    main()
