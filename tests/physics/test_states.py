"""States that no step has made: what a user may write into one, and what is refused."""

import copy

import numpy as np
import pytest

import pdipc
from pdipc.drive import Work, step
from physics.scenes import cloth, floor, scene, solid


def simulation(**settings):
    bodies = [solid("block", [0.1, 0.1, 0.1], [2, 2, 2], at=(0, 0.1, 0)), cloth("sheet", [0.3, 0.3], [6, 6], at=(0, 0.3, 0))]
    made = pdipc.Simulation(scene(bodies, [floor(2.0)], contact={"activation_distance": 1e-3}, **settings), "cpu")
    for _ in range(3):
        made.step()
    return made


def write(made, name, change):
    array = getattr(made.state, name)
    values = array.numpy().copy()
    change(values)
    array.assign(values)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda x: x[:27].__isub__([0.0, 0.1, 0.0]),
            'intersect, such as triangle .* of "block" and .* of "floor"; a step starts',
        ),
        (lambda x: x[3].fill(np.nan), r"positions\[3\] = .* is not finite"),
    ],
)
def test_positions_that_intersect_or_are_none_are_refused(change, told):
    made = simulation()
    write(made, "positions", change)
    given, seen = made.state.copy(), []
    made.observe = lambda x, x_end: seen.append(x)
    for _ in range(2):
        with pytest.raises(ValueError, match=told):
            made.step()
    assert not seen
    assert np.array_equal(made.positions, given.positions.numpy(), equal_nan=True) and made.state.step == given.step


def test_a_body_may_be_put_elsewhere():
    made = simulation()
    write(made, "positions", lambda x: x[:27].__iadd__([0.0, 0.5, 0.0]))
    write(made, "velocities", lambda v: v[:27].__imul__(0.0))
    assert made.step().converged
    assert made.positions[:27, 1].min() > 0.5


@pytest.mark.parametrize(
    ("name", "method"), [("velocities", "newton"), ("velocities", "local-global"), ("accelerations", "local-global")]
)
def test_velocities_that_are_no_numbers_are_told_and_gone(name, method):
    """Newton's method has no use for accelerations."""
    made = simulation(nonlinear_solver=method)
    write(made, name, lambda values: values[3].fill(np.nan))
    before = made.positions
    assert "not finite" in made.step().message
    # what rounding had left of the last position may be added to it
    np.testing.assert_allclose(made.positions, before, rtol=0.0, atol=1e-18)
    made.step()
    assert made.step().converged


def test_an_earlier_state_gives_the_same_bits():
    made = simulation()
    kept = copy.deepcopy(made.state)
    ends = []
    for _ in range(2):
        made.state = kept.copy()
        for _ in range(20):
            made.step()
        ends.append(made.positions)
    assert np.array_equal(*ends)
    assert kept.step == 3


def test_states_and_buffers_of_other_models_are_refused():
    made, single = simulation(), simulation(precision="float32")
    other = pdipc.Simulation(scene([cloth("sheet", [0.3, 0.3], [3, 3])]), "cpu")
    with pytest.raises(ValueError, match="work was made for another model"):
        step(made.model, made.state, other.work)
    with pytest.raises(ValueError, match=r"the state's positions are \(16,\) of .*; those of the model are \(80,\)"):
        step(made.model, other.state, made.work)
    with pytest.raises(ValueError, match=r"are \(80,\) of float32; those of the model are \(80,\) of float64"):
        step(made.model, single.state, made.work)
    assert step(made.model, made.state, Work(made.model)).converged


def test_a_state_is_judged_also_where_a_pin_begins():
    """The buffers are made anew there; what they began with went unjudged."""
    pin = {"select": {"vertices": [0]}, "start": 0.02}
    bodies = [
        solid("block", [0.1] * 3, [1, 1, 1], at=(0, 0.1, 0)),
        cloth("sheet", [0.3, 0.3], [3, 3], at=(0, 0.3, 0), pins=[pin]),
    ]
    made = pdipc.Simulation(scene(bodies, contact={"activation_distance": 1e-3}), "cpu")
    for _ in range(2):
        made.step()
    write(made, "positions", lambda x: x[8:].__setitem__((slice(None), 1), 0.1))
    with pytest.raises(ValueError, match="triangles that intersect"):
        made.step()


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_step_that_cannot_move_ends_where_it_began(precision):
    """x + remainder is x to the bit, or the remainder is forgotten: a state from outside has one of other positions."""
    made = pdipc.Simulation(scene([cloth("sheet", [0.3, 0.3], [2, 2])], precision=precision), "cpu")
    x = made.state.positions.numpy()
    rest = 0.4 * np.spacing(x)
    rest[0] = 0.6 * np.spacing(x[0])  # more than a half: the sum rounds away
    rest[1], rest[2] = 3.0, -1e-3
    made.state.remainders.assign(rest)
    work = made.work
    for to, values in ((work.x, x), (work.rest, rest), (work.x_start, x)):
        to.assign(values)
    work.predict()
    u = work.u.numpy()
    assert np.array_equal(x + u, x) and np.array_equal(u[3:], rest[3:]) and not u[1:3].any()
