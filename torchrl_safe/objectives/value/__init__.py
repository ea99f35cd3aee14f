"""Value estimation: Retrace targets as functions and as a TorchRL value estimator."""

from __future__ import annotations

from torchrl_safe._deprecation import moved
from torchrl_safe.objectives.value.advantages import RetraceEstimator
from torchrl_safe.objectives.value.distribution import (
    distributional_retrace_estimate,
    sampled_lambda_return_estimate,
)
from torchrl_safe.objectives.value.functional import (
    retrace_variance_reward,
    squared_td_error,
    trace_lambda_return_estimate,
    visited_value_estimate,
)
from torchrl_safe.objectives.value.policy import PolicyEvaluation, evaluate_policy

__all__ = [
    "PolicyEvaluation",
    "RetraceEstimator",
    "distributional_retrace_estimate",
    "evaluate_policy",
    "retrace_variance_reward",
    "sampled_lambda_return_estimate",
    "squared_td_error",
    "trace_lambda_return_estimate",
    "visited_value_estimate",
]

__getattr__ = moved(
    __name__,
    {
        "retrace_lambda_return_estimate": (
            "torchrl_safe.objectives.value.trace_lambda_return_estimate"
        )
    },
)
