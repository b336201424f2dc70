import numpy as np
import pytest

from meta_envs import reference_returns, task_set
from meta_envs.rand_params import HopperRandParams
from tests.meta_envs.gymnasium_twin import Floats, assert_same_state, robot_of, twins

NAMES = ("hopper_params", "walker_params")
SIZES = {
    "hopper_params": {"body_mass": 5, "body_inertia": 15, "dof_damping": 6, "geom_friction": 15},
    "walker_params": {"body_mass": 8, "body_inertia": 24, "dof_damping": 9, "geom_friction": 24},
}
DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0")


def columns(name: str, field: str) -> list[int]:
    names = task_set(name).param_names
    return [i for i, one in enumerate(names) if one.startswith(f"{field}_")]


def test_the_tables_are_the_fields() -> None:
    """The check values of numpy.random.RandomState(1234), to four decimals."""
    hopper, walker = (task_set(name).params for name in NAMES)
    assert (hopper.shape, walker.shape) == ((40, 41), (40, 65))
    for found, published in (
        (hopper[0, :5], [0.4721, 1.3459, 0.8594, 2.0021, 1.9761]),
        (hopper[0, 8:11], [3.0482, 2.4957, 0.7076]),
        (hopper[0, 23:26], [0.8134, 1.9775, 1.2691]),
        (hopper[0, 26:29], [0.7787, 2.0186, 0.6404]),
        (hopper[1, :5], [0.4639, 0.3325, 1.5303, 1.2589, 1.0844]),
        (walker[0, :8], [0.4721, 1.3459, 0.8594, 2.0021, 1.9761, 0.5751, 0.5805, 2.0842]),
    ):
        np.testing.assert_allclose(found, published, atol=5.1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_multipliers_are_in_their_ranges_and_named_after_the_model(name: str) -> None:
    tasks, model = task_set(name), robot_of(name).model
    names = list(tasks.param_names)
    bodies = [model.body(i).name for i in range(model.nbody)]
    joints = [model.joint(i).name for i in range(model.njnt)]
    geoms = [model.geom(i).name.removesuffix("_geom") for i in range(model.ngeom)]
    kinds = ("sliding", "torsional", "rolling")
    assert names == [
        *(f"body_mass_{body}" for body in bodies),
        *(f"body_inertia_{body}_{side}" for body in bodies for side in "xyz"),
        *(f"dof_damping_{joint}" for joint in joints),
        *(f"geom_friction_{geom}_{kind}" for geom in geoms for kind in kinds),
    ]
    for params in (tasks.params, tasks.sample(seed=2, n_tasks=300).params):
        for field, size in SIZES[name].items():
            part = params[:, columns(name, field)]
            assert part.shape[1] == size
            base = 1.3 if field == "dof_damping" else 1.5
            powers = np.log(part) / np.log(base)
            assert -3.0 <= powers.min() < -2.8
            assert 2.8 < powers.max() <= 3.0
            assert abs(powers.mean()) < 5 * np.sqrt(3.0 / powers.size)
    assert tasks.test_tasks.tolist() == list(range(2, 40, 4))
    assert tasks.bounds["body_mass_torso"] == (0.01, 100.0)
    assert tasks.bounds["dof_damping_rootx"] == (0.0, 100.0)


@pytest.mark.parametrize("name", NAMES)
def test_the_simulator_has_every_tasks_values(name: str) -> None:
    robot, tasks = robot_of(name), task_set(name)
    simulation = robot.simulation(len(tasks))
    simulation.set_params(tasks.params)
    for task in range(0, len(tasks), 3):
        model, same = simulation.model(task), robot.task_model(tasks.params[task])
        for field in SIZES[name]:
            nominal = getattr(robot.model, field)
            factors = tasks.params[task, columns(name, field)].reshape(nominal.shape)
            np.testing.assert_array_equal(getattr(model, field), nominal * factors)
            np.testing.assert_array_equal(getattr(same, field), nominal * factors)
        for field in DERIVED:
            np.testing.assert_array_equal(getattr(model, field), getattr(robot.model, field))
        masses = robot.model.body_mass * tasks.params[task, columns(name, "body_mass")]
        assert model.body_mass.sum() == pytest.approx(masses.sum(), rel=1e-12)


def after_a_while(robot: HopperRandParams, params: Floats) -> Floats:
    """States of n tasks after the same twelve actions from the same start, [n, S]."""
    n = len(params)
    simulation = robot.simulation(n, threads=2)
    simulation.set_params(params)
    state = robot.initial_state([np.random.default_rng(3) for _ in range(n)])
    actions = np.random.default_rng(4).uniform(-1.0, 1.0, (12, robot.nu))
    for action in actions:
        state = simulation.step(state, np.tile(action, (n, 1)))
    return state


@pytest.mark.parametrize("name", NAMES)
def test_every_multiplier_that_can_matter_changes_the_physics(name: str) -> None:
    robot = robot_of(name)
    assert isinstance(robot, HopperRandParams)
    size = len(robot.param_names)
    params = np.ones((size + 1, size))
    params[np.arange(size), np.arange(size)] = 1.5
    states = after_a_while(robot, params)
    moved = (states[:-1] != states[-1]).any(axis=1)
    for param, differs in zip(robot.param_names, moved, strict=True):
        # The world does not move, the roots have no damping, and the robots, which live in a
        # plane, neither turn about x and z nor roll. MuJoCo takes the larger of two frictions.
        inert = (
            "_world" in param
            or param.startswith("dof_damping_root")
            or (param.startswith("body_inertia") and not param.endswith("_y"))
            or param.endswith(("_torsional", "_rolling"))
        )
        if inert:
            assert not differs, param
        elif not param.startswith("geom_friction") or "foot" in param:
            assert differs, param


@pytest.mark.parametrize(
    ("name", "env_id", "file"),
    [
        ("hopper_params", "Hopper-v5", "hopper.xml"),
        ("walker_params", "Walker2d-v5", "walker2d.xml"),
    ],
)
def test_with_nominal_parameters_it_is_gymnasiums(name: str, env_id: str, file: str) -> None:
    robot = robot_of(name)
    params = np.ones(len(task_set(name).param_names))
    ended = 0
    for twin in twins(name, env_id, params, 60, xml_file=file):
        assert_same_state(robot, twin.next_state, twin.env)
        obs, reward, terminated, _, info = twin.result
        mine, terms = robot.reward(twin.state, twin.action, twin.next_state, params[None])
        assert terms["reward_forward"][0] == pytest.approx(info["x_velocity"], rel=1e-12)
        effort = 1e-3 * np.square(twin.action).sum()
        assert mine[0] == pytest.approx(info["x_velocity"] + 1.0 - effort, rel=1e-12)
        over = bool(robot.terminated(twin.next_state)[0])
        assert over == terminated
        if not over:
            assert mine[0] == pytest.approx(reward, rel=1e-12)
        np.testing.assert_array_equal(robot.observe(twin.next_state)[0], obs.astype(np.float32))
        ended += over
    assert 0 < ended < 60


def test_a_robot_of_ones_own_is_nominal_but_for_what_is_changed() -> None:
    robot, tasks = robot_of("hopper_params"), task_set("hopper_params")
    own = dict.fromkeys(tasks.param_names, 1.0) | {"body_mass_torso": 2.0}
    model = robot.task_model(tasks.with_params(own).params[0])
    changed = {field for field in SIZES["hopper_params"] if field != "body_mass"}
    for field in changed:
        np.testing.assert_array_equal(getattr(model, field), getattr(robot.model, field))
    expected = robot.model.body_mass.copy()
    expected[1] *= 2.0
    np.testing.assert_array_equal(model.body_mass, expected)
    with pytest.raises(ValueError, match="hopper_params: task_params lacks ") as caught:
        tasks.with_params({"body_mass_torso": 2.0})
    assert len(str(caught.value)) < 400


def test_observed_velocities_are_clipped() -> None:
    robot = robot_of("hopper_params")
    state = np.arange(18.0)[None] + 0.5
    state[0, 9:11] = [-11.0, 10.5]
    expected = [1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5, 8.5, -10.0, 10.0, 10.0]
    assert robot.observe(state)[0].tolist() == expected


def test_where_an_episode_ends() -> None:
    hopper, walker = (robot_of(name) for name in NAMES)

    def over(robot: HopperRandParams, **changes: float) -> bool:
        """Standing upright but for these columns."""
        state = np.zeros((1, robot.nq + 2 * robot.nv))
        state[0, 1] = 1.25
        for column, value in changes.items():
            state[0, int(column[1:])] = value
        return bool(robot.terminated(state)[0])

    assert isinstance(hopper, HopperRandParams)
    assert isinstance(walker, HopperRandParams)
    nan = float("nan")
    for changes, expected in (
        ({}, False),
        ({"c1": 0.7}, True),
        ({"c1": 0.71}, False),
        ({"c1": 50.0}, False),
        ({"c2": 0.2}, True),
        ({"c2": -0.19}, False),
        ({"c2": -0.21}, True),
        ({"c5": 100.0}, True),
        ({"c11": -99.0}, False),
        ({"c11": -100.0}, True),
        ({"c0": 1e4}, False),
        ({"c0": nan}, True),
        ({"c7": nan}, True),
        ({"c13": 1e4}, False),
    ):
        assert over(hopper, **changes) == expected, changes
    for changes, expected in (
        ({}, False),
        ({"c1": 0.8}, True),
        ({"c1": 1.99}, False),
        ({"c1": 2.0}, True),
        ({"c2": 0.99}, False),
        ({"c2": -1.0}, True),
        ({"c17": 1e4}, False),
        ({"c17": nan}, True),
    ):
        assert over(walker, **changes) == expected, changes


def test_staying_alive_without_moving_is_worth_200() -> None:
    for name in NAMES:
        robot = robot_of(name)
        state = robot.initial_state([np.random.default_rng(0)])
        reward, _ = robot.reward(state, np.zeros((1, robot.nu)), state, np.zeros((1, 1)))
        assert (robot.horizon * reward).tolist() == [200.0]


def test_random_actions_fall_at_once() -> None:
    returns = [reference_returns(task_set(name), episodes=4)["random"].mean() for name in NAMES]
    assert returns[0] == pytest.approx(6.8, abs=1.5)
    assert returns[1] == pytest.approx(-0.4, abs=1.5)
