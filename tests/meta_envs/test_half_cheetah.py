import gymnasium
import mujoco
import numpy as np
import pytest

from meta_envs import MetaEnv, MetaVectorEnv, TaskSet, task_set
from tests.meta_envs.gymnasium_twin import Floats, assert_same_state, robot_of, twins


@pytest.fixture(autouse=True)
def _own_log(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gymnasium's own class makes MuJoCo warn, in a file in the working directory."""
    monkeypatch.chdir(str(tmp_path))


def still_returns(tasks: TaskSet) -> Floats:
    env = MetaVectorEnv(tasks.env, tasks=range(len(tasks)), task_set=tasks)
    env.reset(seed=0)
    total = np.zeros(len(tasks))
    for _ in range(200):
        total += env.step(np.zeros((len(tasks), 6)))[1]
    return total


def test_the_targets_are_the_fields() -> None:
    tasks = task_set("half_cheetah_vel")
    assert tasks.param_names == ("target_velocity",)
    targets = tasks.params[:, 0]
    assert (len(targets), targets[0], targets[-1]) == (100, 1.0, 3.0)
    np.testing.assert_allclose(np.diff(targets), 2.0 / 99, rtol=1e-12)
    assert tasks.test_tasks.tolist() == list(range(2, 98, 5))
    assert len(tasks.train_tasks) == 80
    assert list(tasks.splits) == ["interpolate", "extrapolate", "moderate", "extreme"]
    fresh = tasks.sample(seed=0, n_tasks=2000).params[:, 0]
    assert 1.0 <= fresh.min() < 1.01
    assert 2.99 < fresh.max() <= 3.0


def test_the_two_directions_are_for_training_and_for_the_test() -> None:
    tasks = task_set("half_cheetah_dir")
    assert tasks.params.tolist() == [[-1.0], [1.0]]
    assert tasks.train_tasks.tolist() == tasks.test_tasks.tolist() == [0, 1]
    fresh = tasks.sample(seed=0, n_tasks=100).params[:, 0]
    assert set(fresh) == {-1.0, 1.0}
    assert 30 < (fresh > 0).sum() < 70
    for direction in (0.0, 0.5):
        with pytest.raises(ValueError, match=r"direction must be -1 or 1, got 0"):
            MetaEnv("half_cheetah_dir", task_params={"direction": direction})


def test_it_moves_as_gymnasiums_does() -> None:
    robot = robot_of("half_cheetah_vel")
    params = np.array([1.7])
    for twin in twins("half_cheetah_vel", "HalfCheetah-v5", params, 60, ctrl_cost_weight=0.05):
        assert_same_state(robot, twin.next_state, twin.env)
        reward, terms = robot.reward(twin.state, twin.action, twin.next_state, params[None])
        info = twin.result[4]
        assert terms["velocity"][0] == info["x_velocity"]
        assert terms["reward_control"][0] == pytest.approx(info["reward_ctrl"], rel=1e-12)
        expected = -abs(info["x_velocity"] - 1.7) + info["reward_ctrl"]
        assert reward[0] == pytest.approx(expected, rel=1e-12)
        obs = robot.observe(twin.next_state)[0]
        np.testing.assert_array_equal(obs[:17], twin.result[0].astype(np.float32))
        mujoco.mj_kinematics(twin.env.model, twin.env.data)
        np.testing.assert_allclose(obs[17:], twin.env.data.body("torso").xpos, rtol=1e-6)
        backwards, terms = robot_of("half_cheetah_dir").reward(
            twin.state, twin.action, twin.next_state, np.array([[-1.0]])
        )
        assert terms["reward_forward"][0] == -info["x_velocity"]
        assert backwards[0] == pytest.approx(-info["x_velocity"] + info["reward_ctrl"])
        assert not robot.terminated(twin.next_state).any()


def test_it_starts_as_gymnasiums_does() -> None:
    theirs = gymnasium.make("HalfCheetah-v5").reset(seed=11)[0]
    mine = MetaVectorEnv("half_cheetah_vel", num_envs=1).reset(seed=11)[0][0]
    np.testing.assert_array_equal(mine[:17], theirs.astype(np.float32))


def test_standing_still() -> None:
    tasks = task_set("half_cheetah_vel")
    found = still_returns(tasks)
    assert found.mean() == pytest.approx(-400.0, abs=0.5)
    np.testing.assert_allclose(found, -200.0 * tasks.params[:, 0], atol=3.0)
    # The field's other range, from 0 m/s: -300.
    slower = [{"target_velocity": float(target)} for target in np.linspace(0.0, 3.0, 61)]
    assert still_returns(tasks.with_params(slower)).mean() == pytest.approx(-300.0, abs=1.0)
    np.testing.assert_allclose(still_returns(task_set("half_cheetah_dir")), 0.0, atol=3.0)


def test_running_the_right_way_pays() -> None:
    env = MetaVectorEnv("half_cheetah_dir", tasks=[0, 1])
    env.reset(seed=[3, 3])
    generator = np.random.default_rng(0)
    for _ in range(20):
        action = np.repeat(generator.uniform(-1.0, 1.0, (1, 6)), 2, axis=0)
        _, reward, _, _, info = env.step(action)
        assert info["velocity"][0] == info["velocity"][1]
        difference = 2.0 * info["velocity"][1]
        assert reward[1] - reward[0] == pytest.approx(difference, abs=1e-9)
