"""Anybody's environment, with one cost or several, of any method that can have it."""

from __future__ import annotations

import math
from functools import partial

import gymnasium
import pytest
import small
import torch
from torch import nn
from torchrl.envs import GymEnv, GymWrapper, ParallelEnv, SerialEnv, StepCounter, TransformedEnv

from torchrl_safe import record
from torchrl_safe.envs import CostFunction, SafeRobotEnv
from torchrl_safe.trainers import CPO, METHODS, TRC, SafeTAC, load_policy
from torchrl_safe.trainers.environments import UntrustedError, make_env


def speed(step):
    """Cost of a pendulum that turns fast."""
    return step["next", "observation"][..., 2].abs() > 4.0


def pendulum():
    return TransformedEnv(GymEnv("Pendulum-v1"), CostFunction(speed))


def several_pendulums(num_envs):
    mode = {"autoreset_mode": gymnasium.vector.AutoresetMode.DISABLED}
    envs = gymnasium.make_vec("Pendulum-v1", num_envs, vector_kwargs=mode)
    return TransformedEnv(GymWrapper(envs), CostFunction(speed))


def cart():
    def far(step):
        return step["next", "observation"][..., 0].abs() > 0.1

    return TransformedEnv(GymEnv("CartPole-v1"), CostFunction(far))


def curves(run_dir):
    return {n: values.tolist() for n, (_, values) in record.read_metrics(run_dir / "log").items()}


HOW = {
    "num_threads": 1,
    "frames_per_batch": 200,
    "total_frames": 400,
    "policy.num_cells": [8],
    "critic.num_cells": [8],
    "critic_rounds": 1,
    "optim.minibatch_size": 100,
    "init_frames": 0,
    "eval.num_steps": 20,
    "video.num_steps": 0,
}
EPISODES = {"num_envs": 2, "eval.num_episodes": 2, "final_episodes": 2}


class TestCommandLine:
    def test_gym_with_a_cost(self, tmp_path):
        """The limit of an episode and the level in the log are in one unit, the measured one."""
        run_dir = tmp_path / "run"
        options = small.options(
            "cpo",
            "env=gym",
            "env.id=Pendulum-v1",
            f"env.cost={__name__}:speed",
            "loss.cost_limit=10",
            "loss.limit_unit=episode",
            run_dir=run_dir,
        )
        METHODS["cpo"](options=options).train()
        logged = curves(run_dir)
        assert logged["update/cost_limit"] == pytest.approx([10.0, 10.0])
        # CPO's level is the mean of the cost per step, of eval.num_steps=20 steps.
        rates = logged["train/cost_rate"]
        assert logged["update/cost_level"] == pytest.approx([20 * r for r in rates], rel=1e-5)
        assert logged["train/cv_rate"] == pytest.approx(rates)  # a bool: what costs, violates

    def test_gym_can_be_filmed(self, tmp_path):
        """Each of a batch draws itself; the pictures are pygame's."""
        pytest.importorskip("pygame")
        cost = f"env.cost={__name__}:speed"
        options = small.options("cpo", "env=gym", "env.id=Pendulum-v1", cost, run_dir=tmp_path)
        env = make_env(options, 2, 0)
        env.reset()
        first, second = env.render()
        assert first.shape == (500, 500, 3)
        assert (first != second).any()  # another angle

    def test_function_of_a_module_is_not_imported_for_strangers(self, tmp_path):
        run_dir = tmp_path / "run"
        options = small.options("wcsac", f"env={__name__}:pendulum", run_dir=run_dir)
        METHODS["wcsac"](options=options).train()
        with pytest.raises(UntrustedError, match=f"env.name={__name__}:pendulum"):
            load_policy(run_dir)
        policy = load_policy(run_dir, env=pendulum)
        assert policy(pendulum().reset())["action"].abs() <= 2.0

    @pytest.mark.parametrize(
        ("overrides", "message"),
        [
            (["env=gim"], "env.name must be one of 'robot', 'gym' or module:function"),
            (["env=no_module:make"], "env.name=no_module:make cannot be imported"),
            (["env=math:nothing"], "env.name=math:nothing must be a function"),
            (["env=gym"], "env.id must name an environment for env=gym, got null"),
            (["env=gym", "env.id=Pendulum-v1"], "must have a cost 'cost' beside the reward"),
            (["loss.cost_limit={speed_cost: 1}"], "must have a cost 'speed_cost'"),
        ],
    )
    def test_message(self, tmp_path, overrides, message):
        options = small.options("cpo", *overrides, run_dir=tmp_path / "run")
        with pytest.raises(ValueError, match=message):
            METHODS["cpo"](options=options).train()

    @pytest.mark.parametrize(
        ("make", "longest"),
        [
            (pendulum, 200),
            (lambda: pendulum().append_transform(StepCounter(max_steps=150)), 150),
            (lambda: SerialEnv(2, pendulum), 200),
            (several_pendulums, 200),
            (lambda num_envs: SafeRobotEnv("point", num_envs=num_envs, episode_length=90), 90),
        ],
        ids=["gymnasium", "step counter", "serial", "vector", "ours"],
    )
    def test_limit_of_longer_episodes_than_there_are(self, tmp_path, make, longest):
        """A sum over steps that no episode has is a looser limit than the one that is read."""
        run_dir = str(tmp_path / "run")
        how = {"limit_unit": "episode", "eval.num_steps": longest + 1, "run_dir": run_dir}
        message = f"eval.num_steps must be at most {longest}, the length .*=episode, got"
        with pytest.raises(ValueError, match=message):
            CPO(make, **HOW | EPISODES | how).train()
        options = CPO(make, **HOW | EPISODES | how | {"limit_unit": "step"}).options
        assert make_env(options, 2, 0, source=make).batch_size == (2,)


class TestFromPython:
    @pytest.mark.parametrize(
        ("make", "how"),
        [
            (pendulum, EPISODES),
            (lambda: pendulum, EPISODES),
            (lambda: SerialEnv(2, pendulum), {}),
            pytest.param(lambda: ParallelEnv(2, pendulum), {}, marks=pytest.mark.slow),
        ],
        ids=["one", "function", "serial", "parallel"],
    )
    def test_environment(self, tmp_path, make, how):
        trainer = CPO(make(), cost_limit=2.5, run_dir=str(tmp_path / "run"))
        policy = trainer.train(**HOW, **how)
        assert policy(pendulum().reset())["action"].shape == (1,)
        assert math.isfinite(curves(tmp_path / "run")["update/cost_level"][-1])

    def test_function_of_a_number_and_a_seed(self, tmp_path):
        asked = []

        def make(num_envs, seed):
            asked.append((num_envs, seed))
            return SerialEnv(num_envs, pendulum)

        TRC(make, run_dir=str(tmp_path / "run"), **HOW, **EPISODES).train()
        assert [n for n, _ in asked] == [2, 2, 2]
        assert len({seed for _, seed in asked}) == 3  # training and both evaluations

    def test_discrete_actions(self, tmp_path):
        trainer = TRC(cart, run_dir=str(tmp_path / "run"), **HOW, **EPISODES)
        action = trainer.train()(cart().reset())["action"]
        assert action.sum() == 1
        assert action.shape == (2,)
        kl = curves(tmp_path / "run")["update/kl"]
        assert all(0 < each <= 0.03 for each in kl)
        with pytest.raises(ValueError, match=r"SafeTAC needs continuous actions.*OneHot"):
            SafeTAC(cart, run_dir=str(tmp_path / "other"), **EPISODES).train()

    @pytest.mark.parametrize("method", ["focops", "cup", "p3o"])
    def test_gradient_steps_on_discrete_actions(self, tmp_path, method):
        run_dir = tmp_path / "run"
        METHODS[method](cart, run_dir=str(run_dir), **HOW, **EPISODES).train()
        kl = curves(run_dir)["update/kl"]
        assert all(0 < each <= 0.1 for each in kl)

    def test_network_of_the_user(self, tmp_path):
        asked = []

        def network(inputs, num_outputs):
            asked.append(([spec.shape[-1] for spec in inputs], num_outputs))
            return nn.Linear(inputs[0].shape[-1], num_outputs)

        trainer = TRC(pendulum, network=network, run_dir=str(tmp_path / "run"), **HOW, **EPISODES)
        trainer.train()
        assert asked == [([3], 3), ([3], 1), ([3], 1), ([3], 1)]

    def test_batch_is_the_environments(self, tmp_path):
        trainer = CPO(SerialEnv(2, pendulum), run_dir=str(tmp_path / "run"))
        with pytest.raises(ValueError, match=r"env.num_envs must be 2, the batch of env, got 3"):
            trainer.train(num_envs=3, frames_per_batch=300)

    @pytest.mark.parametrize(
        ("arguments", "error", "message"),
        [
            ({"env": "unicycle"}, ValueError, "'jackal', got 'unicycle'"),
            ({"env": 3}, TypeError, "env must be a robot's name, .* got int"),
            ({"cost_limt": 3}, ValueError, "cost_limt is not an option; there are loss.cost_limit"),
            ({"num_cells": [3]}, ValueError, "several options: policy.num_cells, critic.num_cells"),
            ({"cost_limit": -1}, ValueError, r"loss.cost_limit must be a number in \[0, inf\)"),
        ],
    )
    def test_message(self, arguments, error, message):
        with pytest.raises(error, match=message):
            CPO(**arguments)


class TestSeveralCosts:
    jackal = ("env.robot=jackal", "env.task=navigation_speed")
    limits = "loss.cost_limit={collision_cost: 5, speed_cost: 20}"

    @pytest.mark.parametrize(
        "method", ["safetac", "trc", "cpo", "wcsac", "offpolicy_trc", "cup", "p3o", "crpo"]
    )
    def test_limits(self, tmp_path, method):
        run_dir = tmp_path / "run"
        options = small.options(
            method, *self.jackal, self.limits, "loss.initial_cost_limit=40", run_dir=run_dir
        )
        METHODS[method](options=options).train()
        logged = curves(run_dir)
        share = 400 / 500_000  # of loss.anneal_frames
        for name, limit in (("collision_cost", 5), ("speed_cost", 20)):
            assert f"eval/det/{name}" in logged
            assert math.isfinite(logged[f"update/cost_level/{name}"][-1])
            assert logged[f"update/cost_limit/{name}"][-1] == pytest.approx(
                40 + share * (limit - 40)
            )
        assert "update/cost_level" not in logged

    @pytest.mark.parametrize("update", ["lagrangian", "pid"])
    def test_multipliers(self, tmp_path, update):
        """The price of the violated one rises, that of the other does not."""
        run_dir = tmp_path / "run"
        overrides = (f"update={update}", *self.jackal, "loss.anneal_frames=0")
        limits = "loss.cost_limit={collision_cost: 1000, speed_cost: 0}"
        options = small.options("safetac", *overrides, limits, run_dir=run_dir)
        METHODS["safetac"](options=options).train()
        logged = curves(run_dir)
        assert logged["update/cost_level/speed_cost"][0] > 0
        assert logged["update/multiplier/speed_cost"][0] > 0.1
        assert logged["update/multiplier/collision_cost"][0] < 0.1

    def test_one_of_both(self, tmp_path):
        """A limit on one cost leaves the other free, and evaluation tells both."""
        run_dir = tmp_path / "run"
        limit = "loss.cost_limit={speed_cost: 20}"
        options = small.options("trc", *self.jackal, limit, run_dir=run_dir)
        METHODS["trc"](options=options).train()
        logged = curves(run_dir)
        assert {"update/cost_level", "final/speed_cost", "final/collision_cost"} <= logged.keys()


def test_state_of_foreign_environments_is_not_taken_for_saved(tmp_path):
    """A resumed run starts episodes anew: its observations are of its own environments."""
    run_dir = tmp_path / "run"
    make = partial(small.options, "trc", f"env={__name__}:pendulum", run_dir=run_dir)
    METHODS["trc"](options=make()).train()
    METHODS["trc"](options=make("resume=true", "collector.total_frames=600")).train()
    assert len(curves(run_dir)["update/cost_level"]) == 3
    assert torch.tensor(curves(run_dir)["update/kl"]).isfinite().all()


@pytest.mark.parametrize("task", [None, "SafetyPointGoal1", "SafetyHopperVelocity"])
def test_nobody_says_how_many_threads(task):
    """The default of a run, which tests of small runs do not have."""
    options = METHODS["safetac"].Options().changed(**{"env.task": task})
    assert options.num_threads is None
    env = make_env(options, 2, seed=0)
    assert env.batch_size == (2,)
    env.close()
