"""Published settings: what they set, what wins over them, and what a mistake is told."""

from __future__ import annotations

import pytest

from torchrl_safe.trainers import METHODS, WCSAC, cli, saved
from torchrl_safe.trainers.options import flat, given
from torchrl_safe.trainers.published import PUBLISHED

EVERY = [(method, name) for method, each in PUBLISHED.items() for name in each]
# The problem is the run's, whoever solves it.
PROBLEM = {
    "loss.cost_limit",
    "loss.limit_unit",
    "loss.risk_level",
    "loss.cost_gamma",
    "env.name",
    "env.robot",
    "env.task",
    "eval.num_steps",
}


@pytest.mark.parametrize(("method", "name"), EVERY)
class TestEvery:
    def test_is_taken_and_nothing_else_changes(self, method, name):
        options = METHODS[method].Options
        defaults, taken = dict(flat(options())), dict(flat(options.of(published=name)))
        values = {option: value for option, (value, _) in PUBLISHED[method][name].values.items()}
        assert taken == defaults | values | {"published": name}

    def test_says_how_a_method_learns_not_what_it_solves(self, method, name):
        assert not PROBLEM & PUBLISHED[method][name].values.keys()

    def test_is_complete(self, method, name):
        """Defaults are tuned again and again: what was published must not move with them."""
        learning = {
            row
            for row, _ in flat(METHODS[method].Options())
            if row.startswith(("loss.", "optim.", "lagrangian.", "pid.", "critic.", "budget."))
        }
        # Of a mixture's one component nothing is relaxed; the others are of machines and failures.
        left = {"loss.initial_cost_limit", "optim.max_skipped", "optim.cuda_graphs"}
        assert learning - left - PROBLEM <= PUBLISHED[method][name].values.keys()

    def test_on_a_task(self, method, name):
        """Episodes of Circle have 500 steps, whatever was published."""
        options = METHODS[method].Options.of(published=name, **{"env.task": "SafetyPointCircle1"})
        assert options.env.episode_length == 500
        assert options.loss.cost_limit == 25


def test_what_the_papers_say():
    """Typed by hand from the sources: TRC's main.py, the loop of wcsac.py, run_agent.py."""
    trc = METHODS["trc"].Options.of(published="kim2022")
    assert (trc.optim.max_kl, trc.loss.lmbda, trc.collector.frames_per_batch) == (1e-3, 0.97, 4000)
    wcsac = WCSAC.Options.of(published="yang2021")
    assert wcsac.optim.num_updates == wcsac.collector.frames_per_batch  # a step per frame
    ppo = METHODS["ppo_lagrangian"].Options.of(published="ray2019")
    assert (ppo.lagrangian.init, ppo.lagrangian.lr, ppo.loss.clip_epsilon) == (1.0, 0.05, 0.2)
    # An episode's cost of 1,000 equal steps is ten times the discounted sum.
    pid = METHODS["ppo_pid"].Options.of(published="omnisafe").pid
    assert pytest.approx(pid.kp * (2.5 - 1.0)) == 0.1 * (25 - 10)


def test_what_is_given_wins():
    options = WCSAC.Options.of(published="yang2021", tau=0.02)
    assert (options.optim.tau, options.optim.minibatch_size) == (0.02, 256)
    assert given(options) == {"published", "optim.tau"}


def test_default_that_is_given_wins():
    options = cli.compose("trc", ["published=kim2022", "optim.max_kl=0.02"])
    assert (options.optim.max_kl, options.optim.damping) == (0.02, 0.01)


def test_from_python():
    trainer = WCSAC("point", published="yang2021", cost_limit=2.5)
    assert (trainer.options.optim.tau, trainer.options.loss.cost_limit) == (0.005, 2.5)


def test_command_line_prints_them(capsys):
    cli.train("trc", ["published=kim2022", "--cfg", "job"])
    printed = capsys.readouterr().out
    assert "published: kim2022" in printed
    assert "max_kl: 0.001" in printed


@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("cpo", "published must be null or one of 'ray2019', 'omnisafe' for cpo, got 'nobody'."),
        ("safetac", "published must be null for safetac, got 'nobody'."),
    ],
)
def test_unknown(method, message, capsys):
    with pytest.raises(SystemExit):
        cli.train(method, ["published=nobody"])
    assert message in capsys.readouterr().err


def test_run_shows_them_and_keeps_them(tmp_path):
    small = [
        "published=kim2022",
        *("num_threads=1", "policy.num_cells=[8]", "critic.num_cells=[8]"),
        *("env.num_envs=4", "collector.frames_per_batch=80", "optim.critic_rounds=1"),
        *("eval.num_episodes=2", "eval.final_episodes=2", "eval.num_steps=20"),
        *("video.num_steps=0", f"run_dir={tmp_path / 'run'}"),
    ]
    cli.train("trc", [*small, "collector.total_frames=80"])
    settings = saved.read_config(tmp_path / "run" / "config.yaml")
    assert (settings["published"], settings["optim"]["max_kl"]) == ("kim2022", 1e-3)
    assert settings["critic"]["num_cells"] == [8]
    cli.train("trc", [f"run_dir={tmp_path / 'run'}", "resume=true", "collector.total_frames=160"])
    again = saved.read_config(tmp_path / "run" / "config.yaml")
    assert (again["published"], again["optim"]["max_kl"]) == ("kim2022", 1e-3)
