"""Costs of foreign environments: highway-env, Safety-Gymnasium's interface, dm_control."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import gymnasium
import highway_env  # noqa: F401 (registers its environments)
import numpy as np
import pytest
import torch
from torchrl.envs import (
    DMControlWrapper,
    FrameSkipTransform,
    GymEnv,
    GymWrapper,
    RenameTransform,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.libs.safety_gymnasium import SafetyGymnasiumWrapper
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import (
    CostToReward,
    GymRobotEnv,
    SafeFrameSkip,
    check_safe_env,
    cost_from_info,
)

POINT = "torchrl_safe/PointGoal-v0"


def assert_costs(rollout, expected) -> None:
    cost = rollout["next", "cost"]
    assert cost.dtype == torch.float32
    assert cost.shape == (*rollout.shape, 1)
    assert (cost.squeeze(-1).numpy() == np.asarray(expected, np.float32)).all()


class SixTuple(gymnasium.Wrapper):
    """``step`` as Safety-Gymnasium has it: obs, reward, cost, terminated, truncated, info."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, info["cost"], terminated, truncated, info


class NaNEnv(GymRobotEnv):
    def step(self, action):
        *out, info = super().step(action)
        return *out, info | {"cost": float("nan")}


@pytest.mark.parametrize("missing", ["mujoco.batch", "mujoco", "dm_control"])
def test_without_the_simulator(missing):
    """As beside an environment that pins an old MuJoCo, or none."""
    code = f"""if True:
        import sys
        sys.modules[{missing!r}] = None
        import gymnasium, torch
        from torchrl.envs import GymEnv
        from torchrl_safe.envs import CostToReward, SafeFrameSkip, check_safe_env, cost_from_info
        assert {POINT!r} in gymnasium.registry
        source = lambda info: 1.0
        check_safe_env(cost_from_info(GymEnv("Pendulum-v1"), source))
    """
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)


class TestHighway:
    """A package we have no say in; it reports crashes."""

    @staticmethod
    def make() -> GymEnv:
        config = {"vehicles_count": 12, "lanes_count": 2, "duration": 30}
        return GymEnv("highway-fast-v0", config=config, categorical_action_encoding=True)

    def test_contract(self):
        check_safe_env(cost_from_info(self.make(), "crashed"), num_steps=4)

    def test_crash_costs(self):
        env = cost_from_info(self.make(), "crashed")
        env.set_seed(0)
        faster = torch.tensor(3)
        rollout = env.rollout(30, lambda td: td.set("action", faster))
        crashed = [0.0] * (len(rollout) - 1) + [1.0]
        assert rollout["next", "terminated"][-1].all()
        assert_costs(rollout, crashed)
        assert (rollout["next", "violation"].squeeze(-1).numpy() == np.array(crashed)).all()
        # The cost of the step before is in no root entry.
        assert "cost" not in rollout.keys()

    def test_a_cost_of_ones_own(self):
        env = cost_from_info(self.make(), lambda info: max(0.0, info["speed"] - 20.0) / 10.0)
        env.set_seed(0)
        rollout = env.rollout(3, lambda td: td.set("action", torch.tensor(3)))
        assert (rollout["next", "cost"] > 0).all()


class TestCostFromInfo:
    def test_values(self):
        env = cost_from_info(GymWrapper(GymRobotEnv()), violation_above=0.5)
        plain = GymRobotEnv()
        env.set_seed(7)  # resets
        plain.reset(seed=7)
        rollout = env.rollout(30, auto_reset=False, tensordict=env.reset())
        plain.reset()
        infos = [plain.step(action)[4] for action in rollout["action"].numpy()]
        assert_costs(rollout, [info["cost"] for info in infos])

    @pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
    def test_vector(self, mode):
        vector_kwargs = {"autoreset_mode": gymnasium.vector.AutoresetMode.DISABLED}
        options = {"vector_kwargs": vector_kwargs} if mode == "sync" else vector_kwargs
        envs = gymnasium.make_vec(
            POINT, num_envs=3, vectorization_mode=mode, episode_length=6, **options
        )
        env = cost_from_info(GymWrapper(envs))
        check_safe_env(env, time_limit=6)
        assert env.full_reward_spec["cost"].shape == (3, 1)

    def test_workers(self):
        env = SerialEnv(2, lambda: cost_from_info(GymEnv(POINT)))
        check_env_specs(env)
        assert env.rollout(3)["next", "cost"].shape == (2, 3, 1)

    def test_transforms(self):
        env = cost_from_info(GymEnv(POINT, episode_length=5))
        env.append_transform(RewardSum(in_keys=["reward", "cost"], out_keys=["return", "costs"]))
        env.append_transform(StepCounter())
        check_safe_env(env, time_limit=5)
        rollout = env.rollout(5)["next"]
        assert rollout["costs"][-1] == pytest.approx(rollout["cost"].sum().item())

    def test_missing_key(self):
        env = cost_from_info(GymEnv(POINT), "danger")
        td = env.reset()
        with pytest.raises(KeyError, match=r"info has no 'danger'; it has .*'cost'"):
            env.rand_step(td)

    def test_takes_no_cost_of_a_reset(self):
        env = cost_from_info(GymEnv(POINT))
        assert "cost" not in env.reset().keys()
        assert not env.reset()["violation"].any()

    def test_observation_of_that_name(self):
        class Shows(Reports):
            observation_space = gymnasium.spaces.Dict({"cost": Reports.observation_space})

        with pytest.raises(ValueError, match=r"has entries \['cost'\] of its own"):
            cost_from_info(GymWrapper(Shows([])))
        env = cost_from_info(GymWrapper(Shows([])), {"cash": "cost"})
        assert "cash_cost" in env.full_reward_spec.keys()

    def test_rejects(self, suite):
        with pytest.raises(TypeError, match="must be a GymWrapper or GymEnv, got DMControlWrapper"):
            cost_from_info(DMControlWrapper(suite.load()))
        with pytest.raises(TypeError, match="env must not have transforms yet"):
            cost_from_info(TransformedEnv(GymEnv(POINT), StepCounter()))
        with pytest.raises(ValueError, match="frame_skip=2 loses the costs"):
            cost_from_info(GymEnv(POINT, frame_skip=2))
        with pytest.raises(TypeError, match=r"Several costs go in at once, cost=\{name: ...\}"):
            cost_from_info(cost_from_info(GymEnv(POINT)), "violation")
        envs = gymnasium.make_vec(POINT, num_envs=2, autoreset_mode="SameStep")
        with pytest.raises(ValueError, match=r"autoreset_mode='Disabled', got .*SAME_STEP"):
            cost_from_info(GymWrapper(envs))


class Reports(gymnasium.Env):
    """Puts the infos of a script into ``info``, one per step, and -1 before the first."""

    observation_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, script):
        self.script = script

    def observe(self):
        return self.np_random.uniform(-1, 1, 3).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self.observe(), dict.fromkeys(["cost", "torque", "speed"], -1.0)

    def step(self, action):
        self.count += 1
        over = self.count == len(self.script)
        return self.observe(), 0.0, False, over, self.script[self.count - 1]


def wrapped(*scripts) -> GymWrapper:
    """One environment for one script, a vector environment for several."""
    if len(scripts) == 1:
        return GymWrapper(Reports(scripts[0]))
    mode = gymnasium.vector.AutoresetMode.DISABLED
    makers = [lambda script=script: Reports(script) for script in scripts]
    return GymWrapper(gymnasium.vector.SyncVectorEnv(makers, autoreset_mode=mode))


class TestSeveralCosts:
    SCRIPTS = (
        [{"torque": 0.25, "speed": 3.0}, {"torque": 0.75, "speed": 1.0}],
        [{"torque": 0.5, "speed": 2.0}, {"torque": 0.0, "speed": 4.0}],
    )

    @pytest.mark.parametrize("num_envs", [1, 2])
    def test_each_has_a_leaf_and_a_flag(self, num_envs):
        env = cost_from_info(
            wrapped(*self.SCRIPTS[:num_envs]),
            {"torque": "torque", "speed": lambda info: info["speed"] / 2},
            violation_above={"torque": 0.25, "speed": 0.75},
        )
        check_env_specs(env)
        assert set(env.full_reward_spec.keys()) == {"reward", "torque_cost", "speed_cost"}
        # In float64, by hand.
        torque = np.array([[step["torque"] for step in script] for script in self.SCRIPTS])
        speed = np.array([[step["speed"] / 2 for step in script] for script in self.SCRIPTS])
        rollout = env.rollout(2)["next"]
        for name, value, bound in (("torque", torque, 0.25), ("speed", speed, 0.75)):
            value = value[:num_envs].reshape(*rollout.shape, 1)
            assert (rollout[f"{name}_cost"].numpy() == value).all()
            assert (rollout[f"{name}_violation"].numpy() == (value > bound)).all()
        for name in ("torque", "speed"):
            check_safe_env(
                env, cost_key=f"{name}_cost", violation_key=f"{name}_violation", time_limit=2
            )

    def test_one_bound_for_all(self):
        env = cost_from_info(
            wrapped(self.SCRIPTS[0]), {"t": "torque", "s": "speed"}, violation_above=0.75
        )
        rollout = env.rollout(2)["next"]
        assert rollout["t_violation"].flatten().tolist() == [False, False]
        assert rollout["s_violation"].flatten().tolist() == [True, True]

    def test_transforms_and_losses_take_them(self):
        env = cost_from_info(wrapped(self.SCRIPTS[0]), {"torque": "torque", "speed": "speed"})
        env.append_transform(RewardSum())
        last = env.rollout(2)["next"][-1]
        assert last["episode_torque_cost"].item() == 1.0
        assert last["episode_speed_cost"].item() == 4.0

    def test_rejects(self):
        make = partial(cost_from_info, wrapped([]))
        with pytest.raises(ValueError, match=r"must name at least one cost, .* got \[\]"):
            make({})
        with pytest.raises(ValueError, match=r"by strings, got \[1\]"):
            make({1: "cost"})
        with pytest.raises(TypeError, match=r"a key in info or a function of it, got 0\.5"):
            make({"torque": 0.5})
        with pytest.raises(ValueError, match=r"must be for \['torque'\], got \['speed'\]"):
            make({"torque": "torque"}, violation_above={"speed": 1.0})
        with pytest.raises(ValueError, match=r"must be for one number, got \['speed'\]"):
            make("torque", violation_above={"speed": 1.0})


class TestMissingCost:
    """What an environment did not report is missing, alone as among others."""

    ALWAYS, NEVER, ONCE = [{"cost": 1.0}] * 2, [{}] * 2, [{"cost": 1.0}, {}]
    SOURCES = ("cost", lambda info: info["cost"], lambda info: info["cost"] * 2)

    @pytest.mark.parametrize("source", SOURCES)
    @pytest.mark.parametrize("script", [NEVER, ONCE])
    def test_alone(self, source, script):
        with pytest.raises(KeyError, match=r"'cost': info has no 'cost'; it has \[\]"):
            cost_from_info(wrapped(script), source).rollout(2)

    @pytest.mark.parametrize("source", SOURCES)
    @pytest.mark.parametrize("script", [NEVER, ONCE])
    def test_among_others(self, source, script):
        env = cost_from_info(wrapped(self.ALWAYS, script, script), source)
        message = r"info has no 'cost' in environments \[1, 2\]; it has \['cost'\]"
        with pytest.raises(KeyError, match=message):
            env.rollout(2)

    def test_by_all(self):
        with pytest.raises(KeyError, match=r"info has no 'cost'; it has \[\]"):
            cost_from_info(wrapped(self.NEVER, self.NEVER)).rollout(2)

    def test_a_default(self):
        """The same function gives each environment the costs that it has alone."""
        scripts = (self.ALWAYS, self.NEVER, self.ONCE)
        source = lambda info: info.get("cost", 0.25)  # noqa: E731
        alone = [cost_from_info(wrapped(script), source).rollout(2) for script in scripts]
        together = cost_from_info(wrapped(*scripts), source).rollout(2)
        assert (together["next", "cost"] == torch.stack(alone)["next", "cost"]).all()
        assert together["next", "cost"].flatten().tolist() == [1, 1, 0.25, 0.25, 1, 0.25]
        none = cost_from_info(wrapped(self.NEVER, self.NEVER), source).rollout(2)
        assert (none["next", "cost"] == 0.25).all()

    def test_nested(self):
        scripts = [{"costs": {"a": 1.0, "b": 2.0}}], [{"costs": {"a": 3.0}}]
        source = lambda info: info["costs"]["a"] + info["costs"].get("b", 0.0)  # noqa: E731
        env = cost_from_info(wrapped(*scripts), source)
        assert env.rollout(1)["next", "cost"].flatten().tolist() == [3.0, 3.0]
        env = cost_from_info(wrapped(*scripts), lambda info: info["costs"]["b"])
        with pytest.raises(KeyError, match=r"info has no 'b' in environments \[1\]"):
            env.rollout(1)


class TestBadCost:
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, None])
    def test_not_finite(self, value):
        good, bad = [{"cost": 1.0}] * 2, [{"cost": 1.0}, {"cost": value}]
        with pytest.raises(ValueError, match="cost 'cost' must be finite, it is not"):
            cost_from_info(wrapped(bad)).rollout(2)
        with pytest.raises(ValueError, match=r"must be finite, it is not at \[\[1\]\]"):
            cost_from_info(wrapped(good, bad)).rollout(2)

    @pytest.mark.parametrize("value", ["much", {"a": 1.0}])
    def test_no_number(self, value):
        with pytest.raises(TypeError, match="'cost' must be numbers, got"):
            cost_from_info(wrapped([{"cost": value}])).rollout(1)

    def test_shape(self):
        scripts = [[{"cost": np.ones(3)}]] * 2
        with pytest.raises(ValueError, match=r"'cost' must be one .* of shape \(\), got \(3,\)"):
            cost_from_info(wrapped(scripts[0])).rollout(1)
        with pytest.raises(ValueError, match=r"of shape \(2,\), got \(2, 3\)"):
            cost_from_info(wrapped(*scripts)).rollout(1)
        env = cost_from_info(wrapped(*scripts), lambda info: info["cost"].sum())
        with pytest.raises(ValueError, match=r"of shape \(2,\), got \(\)"):
            env.rollout(1)

    @pytest.mark.parametrize("value", [True, np.bool_(1), 1, np.int64(1), np.ones(1)])
    def test_whatever_a_number_is_made_of(self, value):
        script = [{"cost": value}]
        for env in (wrapped(script), wrapped(script, script)):
            assert (cost_from_info(env).rollout(1)["next", "cost"] == 1.0).all()


class TestCostToReward:
    def test_torchrls_safety_gymnasium_wrapper(self):
        env = SafetyGymnasiumWrapper(SixTuple(GymRobotEnv(episode_length=9)))
        assert env.observation_spec["cost"].shape == ()  # why it needs an adapter
        env = TransformedEnv(env, CostToReward(violation_above=0.5))
        check_safe_env(env, time_limit=9)
        plain = GymRobotEnv()
        env.set_seed(2)
        plain.reset(seed=2)
        rollout = env.rollout(9)
        plain.reset()
        infos = [plain.step(action)[4] for action in rollout["action"].numpy()]
        assert_costs(rollout, [info["cost"] for info in infos])

    def test_dm_control(self, suite):
        env = DMControlWrapper(suite.load("point", random=0, episode_length=9))
        env = TransformedEnv(env, CostToReward(violation_key=None))  # it has its own
        check_safe_env(env, time_limit=9)

    def test_names(self, suite):
        env = DMControlWrapper(suite.load("point", random=0))
        env = TransformedEnv(env, CostToReward(violation_key=("flags", "unsafe")))
        check_safe_env(env, violation_key=("flags", "unsafe"))

    def test_another_name_for_the_cost(self, suite):
        env = DMControlWrapper(suite.load("point", random=0, episode_length=9))
        env = TransformedEnv(env, RenameTransform(["cost"], ["danger"]))
        env.append_transform(CostToReward(cost_key="danger", violation_key=None))
        assert {"reward", "danger"} <= set(env.full_reward_spec.keys())
        check_safe_env(env, cost_key="danger", time_limit=9)
        with pytest.raises(Exception, match="cost"):  # the default looks for another
            check_safe_env(env, time_limit=9)

    def test_violation(self, suite):
        env = DMControlWrapper(suite.load("point", random=0))
        env = TransformedEnv(env, CostToReward(violation_key="above", violation_above=0.01))
        rollout = env.rollout(200, lambda td: td.set("action", torch.tensor([1.0, 0.3]).double()))
        cost = rollout["next", "cost"]
        assert (rollout["next", "above"] == (cost > 0.01)).all()
        assert 0 < rollout["next", "above"].sum() < 200
        assert not env.reset()["above"].any()

    def test_skipped_frames(self, suite):
        """Their costs would be lost in silence, while TorchRL adds up their rewards."""
        for skipping in (
            DMControlWrapper(suite.load("point", random=0), frame_skip=2),
            SafetyGymnasiumWrapper(SixTuple(GymRobotEnv()), frame_skip=2),
            TransformedEnv(DMControlWrapper(suite.load("point")), FrameSkipTransform(2)),
            TransformedEnv(DMControlWrapper(suite.load("point")), SafeFrameSkip(2)),
        ):
            env = TransformedEnv(skipping, CostToReward(violation_key=None), auto_unwrap=False)
            with pytest.raises(ValueError, match="frame_skip=2 loses the costs"):
                env.rollout(2)

    def test_not_finite(self):
        env = SafetyGymnasiumWrapper(SixTuple(NaNEnv()))
        env = TransformedEnv(env, CostToReward())
        with pytest.raises(ValueError, match="cost 'cost' must be finite"):
            env.rollout(2)
        with pytest.raises(ValueError, match="violation_above must be a number, got nan"):
            CostToReward(violation_above=float("nan"))

    def test_rejects(self, suite):
        env = DMControlWrapper(suite.load("point", random=0))
        with pytest.raises(ValueError, match="has an observation 'violation' of its own"):
            _ = TransformedEnv(env, CostToReward()).observation_spec
        with pytest.raises(KeyError, match="there is no observation 'danger' among"):
            _ = TransformedEnv(env, CostToReward("danger")).observation_spec
        with pytest.raises(ValueError, match=r"one number per environment, .* got \(24,\)"):
            _ = TransformedEnv(env, CostToReward("observation")).observation_spec
