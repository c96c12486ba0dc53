"""The command line: exit codes, messages on the right stream, and what its commands write."""

import contextlib
import csv
import json
import os
import re
import signal
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pdipc.cli import app, metres
from pdipc.output.results import RunWriter, open_run
from pdipc.scene.load import bundled_scenes
from tests.output import runs

runner = CliRunner()


@pytest.fixture
def folder(tmp_path):
    runs.write(tmp_path / "run", steps=3)
    return tmp_path / "run"


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(runs.scene()))
    return path


@pytest.fixture
def fake(monkeypatch):
    """Puts a simulation in place of the true one that writes what `runs` makes, and records how it was called."""
    calls = types.SimpleNamespace(interrupt_after=None, interrupt_with=signal.SIGINT, given={})

    def run_scene(scene, out_dir, *, steps, device, resume, overwrite, certify, forces, progress):
        calls.given = {"scene": scene, "steps": steps, "device": device, "resume": resume, "certify": certify}
        if resume:
            writer = RunWriter.resume(out_dir)
            done, arrays = writer.latest_checkpoint()
            state = arrays["positions"]
        else:
            writer, state = runs.begin(out_dir, overwrite=overwrite, as_json=scene.model_dump_json())
            done = 0
        total = scene.simulation.steps if steps is None else steps
        with writer:
            for step in range(done + 1, total + 1):
                state = runs.advance(writer, state, range(step, step + 1))
                if step == calls.interrupt_after:
                    os.kill(os.getpid(), calls.interrupt_with)
                result = types.SimpleNamespace(outer=3, barriers=7, smallest_gap=float("inf"))
                progress(types.SimpleNamespace(step=step, steps=total, result=result))

    monkeypatch.setitem(sys.modules, "pdipc.simulation", types.SimpleNamespace(run_scene=run_scene))
    return calls


def test_help_and_version_need_no_heavy_import():
    code = (
        "import sys; from typer.testing import CliRunner; from pdipc.cli import app; r = CliRunner().invoke(app, ['--help']); "
        "heavy = {'warp', 'numpy', 'scipy', 'pydantic', 'pyvista'} & set(sys.modules); "
        "sys.exit(r.exit_code or str(heavy or '') or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert runner.invoke(app, ["--version"]).output.startswith("pdipc 0.")


def test_bundled_scenes_are_listed():
    plain = runner.invoke(app, ["scenes", "--plain"]).output.split()
    assert "cloth_on_sphere" in plain
    told = runner.invoke(app, ["scenes"]).output.splitlines()
    assert [line.split()[0] for line in told] == plain
    assert all(len(line.split()) > 2 for line in told)


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["run", "nothing"], 2, "no such file"),
        (["run"], 2, "SCENE"),
        (["run", "squeeze", "--steps", "-1"], 2, "steps"),
        (["run", "squeeze", "--solver", "magic"], 2, "--solver"),
        (["run", "squeeze", "--resume", "--overwrite"], 2, "exclude each other"),
        (["run", "squeeze", "-o", "nowhere", "--resume"], 2, "does not exist"),
        (["check", "nowhere"], 2, "nowhere does not exist"),
        (["render", "nowhere", "-o", "a.png", "--size", "big"], 2, "--size"),
        (["render", "nowhere", "-o", "a.png", "--size", "9000x100"], 2, "--size"),
        (["render", "nowhere", "-o", "a.png", "--view", "up"], 2, "--view"),
        (["render", "nowhere", "-o", "a.bmp"], 2, "--output"),
        (["export", "nowhere", "--format", "stl"], 2, "--format"),
        (["reproduce", "fig99"], 2, "fig99"),
        (["frobnicate"], 2, "frobnicate"),
    ],
)
def test_errors_are_one_message_on_stderr(arguments, code, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = runner.invoke(app, arguments)
    assert result.exit_code == code
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""


def test_run_passes_options_and_reports(fake, scene, tmp_path):
    out = tmp_path / "out"
    options = ["--steps", "4", "--solver", "chebyshev", "--precision", "float64", "--budget-ms", "20", "--certify"]
    result = runner.invoke(app, ["run", str(scene), "-o", str(out), *options])
    assert result.exit_code == 0, result.stderr
    assert "4 steps, 0.04 s simulated" in result.stdout
    assert "smallest gap 1 mm" in result.stdout
    sim = fake.given["scene"].simulation
    assert (sim.linear_solver, sim.precision, sim.budget_ms, sim.steps) == ("chebyshev", "float64", 20.0, 8)
    assert fake.given["certify"] is True
    assert open_run(out).frame_count == 5

    again = runner.invoke(app, ["run", str(scene), "-o", str(out)])
    assert (again.exit_code, "--overwrite" in again.stderr) == (2, True)
    assert runner.invoke(app, ["run", str(scene), "-o", str(out), "--overwrite", "--steps", "1"]).exit_code == 0
    assert open_run(out).frame_count == 2


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_runs_go_on_where_they_stopped(fake, scene, tmp_path, number, code):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert runner.invoke(app, ["run", str(scene), "-o", str(whole)]).exit_code == 0
    fake.interrupt_after, fake.interrupt_with = 3, number
    result = runner.invoke(app, ["run", str(scene), "-o", str(cut)])
    assert result.exit_code == code
    assert "stopped after step 3 of 8" in result.stderr
    assert f"pdipc run {scene} -o {cut} --resume" in result.stderr
    fake.interrupt_after = None
    assert runner.invoke(app, ["run", str(scene), "-o", str(cut), "--resume"]).exit_code == 0
    again = runner.invoke(app, ["run", str(scene), "-o", str(cut), "--resume", "--steps", "5"])
    assert (again.exit_code, "has 8 steps already; nothing was added" in again.stdout) == (0, True)
    for i in range(9):
        np.testing.assert_array_equal(open_run(cut).positions(i), open_run(whole).positions(i))


@pytest.mark.parametrize("turned_into", [KeyboardInterrupt, TypeError])
def test_an_interrupt_before_the_first_step_says_so(scene, tmp_path, monkeypatch, turned_into):
    def run_scene(*args, **options):
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            raise turned_into("in the middle of an import") from None

    monkeypatch.setitem(sys.modules, "pdipc.simulation", types.SimpleNamespace(run_scene=run_scene))
    result = runner.invoke(app, ["run", str(scene), "-o", str(tmp_path / "out")])
    assert result.exit_code == 130
    assert "interrupted before a step was taken" in result.stderr


def test_an_interrupt_that_a_library_loses_ends_the_run_after_a_step(fake, scene, tmp_path, monkeypatch):
    steps = sys.modules["pdipc.simulation"].run_scene

    def run_scene(*args, **options):
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        steps(*args, **options)

    monkeypatch.setattr(sys.modules["pdipc.simulation"], "run_scene", run_scene)
    result = runner.invoke(app, ["run", str(scene), "-o", str(tmp_path / "out")])
    assert (result.exit_code, "stopped after step 1 of 8" in result.stderr) == (130, True)


def test_check_finds_what_intersects(folder):
    result = runner.invoke(app, ["check", str(folder)])
    assert (result.exit_code, "4 frames" in result.stdout, "no intersection" in result.stdout) == (0, True, True)
    bad = open_run(folder).positions(3)
    bad[open_run(folder).topology["body_of_vertex"] == 1, 1] = 0.3  # the cloth cuts the ball in half
    np.save(folder / "frames/000003.npy", bad)
    result = runner.invoke(app, ["check", str(folder)])
    assert result.exit_code == 1
    assert "frame 3, t = 0.03 s" in result.stdout
    assert 'of "ball" and triangle' in result.stdout
    assert '"cloth"' in result.stdout
    assert "1 of 4 frames intersect" in result.stderr


def test_a_reader_that_has_seen_enough_is_no_error():
    command = [sys.executable, "-m", "pdipc", "scenes", "--plain"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""


def test_certify_prints_the_verdict(folder):
    pytest.importorskip("ipctk", reason="needs ipctk (extra: witness)")
    result = runner.invoke(app, ["certify", str(folder)])
    assert result.exit_code == 0, result.stderr
    told = dict(line.split(maxsplit=1) for line in result.stdout.splitlines())
    assert (told["segments"], told["hits"]) == ("3", "0")


def test_names_of_all_kinds_are_printed_in_terminals_that_know_few(tmp_path):
    """As that of a job or of a container may be."""
    body = '[[bodies]]\nname = "Stoff \\u00e4 \\U0001f600"\nkind = "cloth"\nmesh = { shape = "grid" }\nscale = -1\n'
    (tmp_path / "a.toml").write_text(body)
    environment = {**os.environ, "PYTHONIOENCODING": "latin-1", "PYTHONUTF8": "0"}
    command = [sys.executable, "-m", "pdipc", "check-scene", str(tmp_path / "a.toml")]
    result = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert result.returncode == 2, result.stderr
    assert b"Stoff \xe4 \\U0001f600" in result.stdout


def test_check_scene_lists_everything(scene):
    assert runner.invoke(app, ["check-scene", str(scene)]).exit_code == 0
    data = runs.scene()
    data["bodies"][0]["translation"] = [0.0, 0.6, 0.0]  # the ball in the cloth
    data["obstacles"][0]["translation"] = [0.0, 0.5, 0.0]  # the floor in the ball
    scene.write_text(json.dumps(data))
    result = runner.invoke(app, ["check-scene", str(scene)])
    assert result.exit_code == 1
    assert len([line for line in result.stdout.splitlines() if line.startswith("- ")]) == 2


def test_info_describes_runs_and_scenes(folder, scene):
    told = runner.invoke(app, ["info", str(folder)])
    assert told.exit_code == 0, told.stderr
    assert "4 frames, 0.03 s; 3 of 8 steps done" in told.stdout
    assert "cloth" in runner.invoke(app, ["info", str(scene)]).stdout
    assert "pin of cloth: 25 vertices, held exactly\n" in runner.invoke(app, ["info", "twisted_cloth"]).stdout


def test_info_tells_how_pins_hold(tmp_path):
    rail = 'bodies = [{ name = "c", kind = "cloth", mesh = { shape = "grid" }, pins = [\n'
    rail += '{ select = { all = true }, axes = "zy", stiffness = 5.0, start = 1.5 },\n'
    rail += '{ select = { vertices = [1] }, follow = "o", end = 2 } ] }]\n'
    rail += 'obstacles = [{ name = "o", mesh = { shape = "plane" }, translation = [0, -1, 0] }]\n'
    (tmp_path / "s.toml").write_text(rail)
    told = runner.invoke(app, ["info", str(tmp_path / "s.toml")])
    assert told.exit_code == 0, told.stderr
    assert "vertices, held by 5 N/m along yz, from 1.5 s on\n" in told.stdout
    assert "pin of c: 1 vertices, held exactly, moving with o, until 2 s\n" in told.stdout


def test_info_tells_convergence_time_and_machine(folder):
    lines = [json.loads(line) for line in (folder / "stats.jsonl").read_text().splitlines()]
    for line, converged, residual in zip(lines[1:], (True, False, True), (1e-6, 3e-3, 2e-6), strict=True):
        line |= {"converged": converged, "residual": residual, "barriers": 12, "milliseconds": {"ccd": 1.5, "solver": 2.5}}
    (folder / "stats.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    told = runner.invoke(app, ["info", str(folder)]).stdout
    assert "66.67 % of the steps converged (1 did not), worst residual 3 mm" in told
    assert "0.012 s of work, median 4 ms a step" in told
    assert "smallest gap 1 mm, at most 12 contacts" in told
    assert "made on cpu, float32, Linux" in told or sys.platform != "linux"
    assert f"python {sys.version.split()[0]}" in told


def test_export_writes_beside_the_run(folder):
    result = runner.invoke(app, ["export", str(folder), "--format", "obj"])
    assert result.exit_code == 0, result.stderr
    assert len(list((folder.parent / "run_obj").glob("*.obj"))) == 4


def test_export_of_some_bodies_and_frames(folder, tmp_path):
    out = tmp_path / "some"
    options = ["--bodies", "floor", "--bodies", "cloth", "--every", "2", "-o", str(out)]
    result = runner.invoke(app, ["export", str(folder), "--format", "obj", *options])
    assert result.exit_code == 0, result.stderr
    assert len(list(out.glob("*.obj"))) == 2
    names = [line[2:] for line in (out / "frame_000001.obj").read_text().splitlines() if line.startswith("o ")]
    assert names == ["cloth", "floor"]
    wrong = runner.invoke(app, ["export", str(folder), "--format", "obj", "--bodies", "sail"])
    assert (wrong.exit_code, 'has no body "sail"; it has: ball, cloth, floor' in wrong.stderr) == (2, True)


@pytest.mark.parametrize(
    "arguments",
    [
        ["export", "--format", "obj", "-o", "in/it"],
        ["export", "--format", "usd", "-o", "run.usdc"],
        ["render", "-o", "picture.png"],
        ["audit", "-o", "plot.png"],
        ["audit", "--csv", "table.csv"],
        ["audit", "--forces", "forces.npz"],
    ],
)
def test_nothing_is_written_into_a_run_folder(folder, arguments):
    before = sorted(folder.rglob("*"))
    *options, name = arguments[1:]
    result = runner.invoke(app, [arguments[0], str(folder), *options, str(folder / name)])
    assert (result.exit_code, "holds nothing but its run" in " ".join(result.stderr.split())) == (2, True), result.stderr
    assert sorted(folder.rglob("*")) == before


def test_audit_writes_tables_and_forces_with_names(tmp_path):
    folder = tmp_path / "run"
    runs.write(folder, steps=3, precision="float64")
    result = runner.invoke(
        app, ["audit", str(folder), "--csv", str(tmp_path / "a.csv"), "--forces", str(tmp_path / "f.npz"), "--every", "2"]
    )
    assert result.exit_code == 0, result.stderr
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["0", "2"]
    assert float(rows[0]["total [J]"]) == pytest.approx(sum(float(rows[0][f"{n} [J]"]) for n in ENERGIES), rel=1e-12)
    assert {f"normal y on {name} [N]" for name in ("ball", "cloth", "floor")} < set(rows[0])
    assert all(rows[-1][f"torque x on {name} [N m]"] == "nan" for name in ("ball", "cloth", "floor"))  # nothing was recorded
    printed = result.stdout.splitlines()[2].split()
    assert printed[1:6] == [f"{float(rows[0][f'{n} [J]']):.4g}" for n in (*ENERGIES, "total")]
    with np.load(tmp_path / "f.npz") as forces:
        assert forces["body_names"].tolist() == ["ball", "cloth", "floor"]
        assert forces["normal"].shape == (2, len(forces["body_of_vertex"]), 3)


ENERGIES = ("kinetic", "elastic", "barrier", "gravity")


def test_a_new_scene_runs_as_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = runner.invoke(app, ["new", "mine.toml"])
    assert made.exit_code == 0, made.stderr
    assert runner.invoke(app, ["check-scene", "mine.toml"]).exit_code == 0
    uncommented = re.sub(
        r"(?m)^# ((\[\[|\w+ = ).*)$", r"\1", Path("mine.toml").read_text()
    )  # what it proposes is right as well
    assert uncommented != Path("mine.toml").read_text()
    Path("all.toml").write_text(uncommented)
    assert runner.invoke(app, ["check-scene", "all.toml"]).stdout == "all.toml: can be simulated\n"
    again = runner.invoke(app, ["new", "mine.toml"])
    assert (again.exit_code, "exists already" in again.stderr) == (1, True)
    assert runner.invoke(app, ["new", "mine.json"]).exit_code == 2


def test_the_schema_is_that_of_scenes(tmp_path):
    printed = json.loads(runner.invoke(app, ["schema"]).stdout)
    assert {"simulation", "bodies", "obstacles"} < set(printed["properties"])
    out = runner.invoke(app, ["schema", "-o", str(tmp_path / "s.json")])
    assert "#:schema" in out.stdout
    assert json.loads((tmp_path / "s.json").read_text()) == printed


def test_an_editor_takes_what_loading_takes(tmp_path):
    """By a validator of its own: all bundled scenes and that of `pdipc new` are right, and slips that loading refuses are found."""
    jsonschema = pytest.importorskip("jsonschema", reason="needs jsonschema (extra: dev)")
    schema = json.loads(runner.invoke(app, ["schema"]).stdout)
    editor = jsonschema.Draft202012Validator(schema)
    editor.check_schema(schema)
    assert runner.invoke(app, ["new", str(tmp_path / "new.toml")]).exit_code == 0
    for path in (*bundled_scenes().values(), tmp_path / "new.toml"):
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        assert editor.is_valid(tables), path
    for key, value in (("materal", {}), ("kind", "clth"), ("material", {"poisson_ratio": 2}), ("mesh", {"shape": "cub"})):
        slip = {"bodies": [{"name": "a", "kind": "cloth", "mesh": {"shape": "grid"}}]}
        assert editor.is_valid(slip)
        slip["bodies"][0][key] = value
        assert not editor.is_valid(slip), key


def test_figures_are_listed():
    listed = runner.invoke(app, ["reproduce", "--list"])
    assert listed.exit_code == 0, listed.stderr
    told = dict(line.split(maxsplit=1) for line in listed.stdout.splitlines())
    assert {"fig2", "fig12", "table1"} < set(told)
    assert list(told).index("fig2") < list(told).index("fig12")


def test_the_shell_completes_names(monkeypatch):
    monkeypatch.setenv("_PDIPC_COMPLETE", "complete_bash")
    for words, expected in (
        ("pdipc run twi", "twisted_cloth"),
        ("pdipc che", "check-scene"),
        ("pdipc reproduce fig1", "fig12"),
    ):
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
        assert expected in runner.invoke(app, [], prog_name="pdipc").stdout.split()


def test_the_first_run_tells_that_kernels_are_compiled(capsys):
    import warp as wp

    from pdipc.output.progress import _told_of_compiling

    told, level = [], wp.config.log_level
    with _told_of_compiling(told.append):
        for what in (" (cached)", " (compiled)"):
            with wp.ScopedTimer("Module x load on device 'cpu'") as timer:  # as Warp loads a module
                timer.extra_msg = what
    assert told == [1]
    assert wp.config.log_level == level
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("length", "text"), [(None, "none"), (float("inf"), "none"), (2.0, "2 m"), (1.2e-3, "1.2 mm"), (3e-8, "30 nm")]
)
def test_lengths_for_people(length, text):
    assert metres(length) == text
