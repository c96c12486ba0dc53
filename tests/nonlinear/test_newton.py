"""Newton's method: it descends, what it calls converged is, and stiff bodies do what they must."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from physics.scenes import cloth, floor, scene, solid, watched
from scipy.spatial.transform import Rotation

import pdipc
from pdipc import constraints
from pdipc.drive import step
from pdipc.work import Work


def block(young, **more):
    """A block just above the floor, turned, on its way down."""
    of = {"young": young, "poisson": 0.3, "rotation": (10, 0, 15), "velocity": (0.2, -1.0, 0.0), **more}
    return scene(
        [solid("block", (0.1, 0.1, 0.1), (3, 3, 3), at=(0, 0.075, 0), **of)], [floor(1.0)], contact=CONTACT, time_step=0.01
    )


def sheet_on_ball():
    ball = {"name": "ball", "mesh": {"shape": "sphere", "radius": 0.1}}
    return scene([cloth("sheet", (0.3, 0.3), (6, 6), at=(0.01, 0.104, 0.0))], [ball], contact=CONTACT, time_step=0.01)


def pile():
    low = solid("low", (0.1, 0.1, 0.1), (2, 2, 2), at=(0, 0.0515, 0), young=1e6)
    top = solid(
        "top", (0.08, 0.08, 0.08), (2, 2, 2), at=(0.01, 0.144, 0.005), rotation=(0, 20, 0), young=1e8, velocity=(0, -1, 0)
    )
    return scene([low, top], [floor(1.0)], contact=CONTACT, time_step=0.01)


CONTACT = {"activation_distance": 2e-3, "friction": 0.0}
SCENES = {
    "soft block": lambda: block(1e5),
    "stiff block": lambda: block(1e9),
    "sheet on a ball": sheet_on_ball,
    "pile": pile,
}


class Potential:
    """E + Psi + B of a step, J, by other means than the solver's sums: from what `work` starts the step with."""

    def __init__(self, model):
        self.model = model
        self.other = Work(dataclasses.replace(model, settings=dataclasses.replace(model.settings, nonlinear_solver="newton")))
        self.projector = constraints.Projector(model.device, model.real, model.vertex_count, model.projector.sets)

    def __call__(self, work):
        model, out = self.model, wp.zeros(1, dtype=wp.float64, device="cpu")
        mass, h = model.mass.numpy(), model.settings.time_step
        u, z = work.u.numpy(), work.z.numpy()
        inertia = 0.5 * (mass * ((u - z) ** 2).sum(axis=1)).sum() / h**2
        self.projector.energy(work.x_start, work.u, out, 0)
        self.other.list_pairs(work.x)
        self.other.pairs.differentiate(work.x)
        return inertia + float(out.numpy()[0]) + self.other.pairs.energy_of_vertex.numpy().sum()


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("solver", ["newton", "local-global"])
def test_the_potential_never_rises(name, solver):
    """From one outer iteration to the next, in impact and at rest."""
    made = SCENES[name]()
    simulation = made.simulation.model_copy(update={"nonlinear_solver": solver, "max_outer": 30})
    model = pdipc.build(made.model_copy(update={"simulation": simulation}), "cpu")
    work, state, potential = Work(model, recorded=False), model.initial_state(), Potential(model)
    accept, found = work.method.accept, []
    tolerated = (work.method if solver == "newton" else work.method.descent).tolerated
    start = work.method.start
    work.method.start = lambda: start() or found.append([potential(work)])
    work.method.accept = lambda: accept() or found[-1].append(potential(work))
    for _ in range(4 if name == "sheet on a ball" else 6):
        state = step(model, state, work).state
    assert max(len(of_step) for of_step in found) > 3
    for of_step in found:
        assert np.diff(of_step).max() <= 1e-9 * np.abs(of_step).max() + 2.0 * tolerated**2
    assert sum(of_step[-1] < of_step[0] for of_step in found) >= 3


@pytest.mark.parametrize("name", SCENES)
def test_a_converged_step_is_as_near_as_it_says(name):
    """Against the same step with a tolerance of 1e-6 m/s: no vertex is farther away than three tolerances."""
    made = SCENES[name]()
    model = pdipc.build(made, "cpu")
    simulation = made.simulation.model_copy(update={"tolerance": 1e-6, "max_outer": 200})
    reference = pdipc.build(made.model_copy(update={"simulation": simulation}), "cpu")
    assert reference.settings.tolerance == pytest.approx(1e-8)
    work, other, state = Work(model), Work(reference), model.initial_state()
    touched = 0
    for _ in range(8):
        exact = step(reference, state, other)
        result = step(model, state, work)
        assert result.converged
        assert exact.converged or exact.residual < 1e-2 * model.settings.tolerance  # rounding may end it before that
        error = np.linalg.norm(result.state.positions.numpy() - exact.state.positions.numpy(), axis=1).max()
        assert error <= 3.0 * model.settings.tolerance
        touched += result.barriers > 0
        state = result.state
    assert touched >= 2


def test_two_simulations_of_one_model_do_not_see_each_other():
    """Taken in turns, with lists of different lengths, each makes the steps that it makes alone, bit for bit."""
    model = pdipc.build(pile(), "cpu")
    alone, first, second = pdipc.Simulation(model), pdipc.Simulation(model), pdipc.Simulation(model)
    positions = []
    for _ in range(8):
        alone.step()
        positions.append(alone.positions)
    for k in range(8):
        first.step()
        assert np.array_equal(first.positions, positions[k])
        if k >= 4:
            second.step()
            assert np.array_equal(second.positions, positions[k - 4])


def test_gravity_in_single_precision():
    """h = 1e-4 s, 2.5 m up: a fall of 1e-7 m in the first step is less than a position can hold. Implicit Euler falls g t (t + h) / 2."""
    body = solid("block", (0.2, 0.2, 0.2), (1, 1, 1), at=(0, 2.5, 0))
    made = pdipc.Simulation(scene([body], contact={"activation_distance": 5e-2}, precision="float32", time_step=1e-4), "cpu")
    y = made.positions[:, 1].mean()
    for _ in range(300):
        made.step()
    assert y - made.positions[:, 1].mean() == pytest.approx(0.5 * 9.81 * 0.03 * 0.0301, rel=0.01)


@pytest.mark.parametrize("young,density", [(1e6, 1000.0), (2e11, 7850.0)], ids=["rubber", "steel"])
def test_a_cube_on_its_corner_falls_over(young, density):
    """Let go off balance it lies on a face after half a second, whatever it is made of, and every step converges."""
    turn = (40, 0, 30)
    corners = 0.05 * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    low = Rotation.from_euler("xyz", turn, degrees=True).apply(corners)[:, 1].min()
    cube = solid(
        "cube",
        (0.1,) * 3,
        (2,) * 3,
        at=(0, 0.002 - low, 0),
        rotation=turn,
        young=young,
        density=density,
        poisson=0.3,
        friction=0.3,
    )
    contact = {"activation_distance": 1e-3}
    made = watched(scene([cube], [floor(4.0, friction=0.3)], contact=contact, time_step=0.01))
    results = [made.step() for _ in range(50)]
    assert made.positions[:27, 1].mean() < 0.06
    assert sum(not result.converged for result in results) == 0


def test_forces_are_balanced_where_a_step_has_converged():
    """The reported force vanishes beside that of inertia as the tolerance does, and tells a step that was cut short."""
    made = block(1e6)
    made = made.model_copy(update={"simulation": made.simulation.model_copy(update={"tolerance": 1e-6})})
    model = pdipc.build(made, "cpu")
    work, state, touched = Work(model), model.initial_state(), 0
    for _ in range(4):
        before, result = state, step(model, state, work)
        state, touched = result.state, touched + (result.barriers > 0)
        assert result.converged
        assert result.force_residual < 1e-3 * result.force_scale
    assert touched
    cut = step(dataclasses.replace(model, settings=dataclasses.replace(model.settings, max_outer=1)), before)
    assert not cut.converged
    assert cut.force_residual > 0.1 * cut.force_scale
    assert "cap of 1 outer" in cut.message


@pytest.mark.parametrize("young", [1e4, 1e6, 1e8, 2e11])
def test_local_global_steps_that_converge_are_where_newtons_are(young):
    """Motions of stiff bodies are short however much is left of a step: then it has not converged."""
    block = solid("block", (0.2, 0.2, 0.2), (3, 3, 3), at=(0, 0.19, 0), rotation=(10, 20, 5), velocity=(0, -1, 0), young=young)
    block["material"]["model"] = "arap"
    contact = {"activation_distance": 2e-3}
    exact, quick = (
        pdipc.Simulation(scene([block], [floor(4.0)], contact=contact, nonlinear_solver=name, tolerance=tolerance), "cpu")
        for name, tolerance in (("newton", 1e-8), ("local-global", 0.01))
    )
    converged = 0
    for _ in range(12):
        state = exact.state.arrays()
        result = step(quick.model, quick.model.state_from(state), quick.work)
        exact.step()
        error = np.linalg.norm(result.state.positions.numpy() - exact.positions, axis=1).max()
        assert not result.converged or error <= 3.0 * quick.model.settings.tolerance
        converged += result.converged
    assert converged >= (12 if young <= 1e6 else 4)  # it falls before it hits the floor
