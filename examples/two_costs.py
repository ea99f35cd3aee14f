"""Two costs, each under a limit of its own: a Jackal that neither collides nor drives fast.

    python examples/two_costs.py               # train, evaluate, film: some minutes
    python examples/two_costs.py resume=true   # go on after Ctrl-C
    python examples/two_costs.py 'loss.cost_limit={collision_cost: 5, speed_cost: 40}'

An environment has several costs by the names of its entries, "<name>_cost"; those that
loss.cost_limit names are limited. curves.png in the run's folder has the level of each beside its
limit, and every metric of a cost is logged under its name.
"""

from __future__ import annotations

import sys

from torchrl_safe.trainers import cli

OPTIONS = [
    "env.robot=jackal",
    "env.task=navigation_speed",
    # Discounted sums. An untrained policy pays 35 of each; one that always drives fast pays 100.
    "loss.cost_limit={collision_cost: 5, speed_cost: 20}",
    "loss.anneal_frames=80000",
    "collector.init_frames=16000",
    "collector.total_frames=200000",
    "optim.critic_rounds=4",
    "optim.critic_frames=8000",
    "eval.interval=40000",
    "eval.num_episodes=10",
    "eval.num_steps=500",
    "eval.final_episodes=20",
    "run_dir=runs/two_costs/seed_${seed}",
]

if __name__ == "__main__":
    cli.train("safetac", [*OPTIONS, *sys.argv[1:]])
