"""TRPO-Lagrangian (Ray et al. 2019), a trust region on the Lagrangian, and TRPO-PID."""

from __future__ import annotations

from typing import Any, ClassVar

from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from torchrl_safe.objectives import lagrangian
from torchrl_safe.trainers.on_policy import KLOptions, TrustRegionTrainer
from torchrl_safe.trainers.options import MethodOptions
from torchrl_safe.trainers.policy_steps import Controlled, Priced, make_multiplier


class TRPOLagrangianOptions(Priced, KLOptions):
    """The options of TRPO-Lagrangian."""

    method: ClassVar[str] = "trpo_lagrangian"


class TRPOLagrangian(TrustRegionTrainer):
    """Trust region policy optimization of the Lagrangian: costs have a price, not a constraint.

    Examples:
        >>> from torchrl_safe.trainers import TRPOLagrangian
        >>> trainer = TRPOLagrangian("point", cost_limit=2.5)
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = TRPOLagrangianOptions

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy, surrogates with critics of states, the trust region, and a multiplier."""
        self.multiplier = make_multiplier(self)
        return {**super().build(env), "multiplier": self.multiplier}

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """The multiplier's step, then a trust-region step up the Lagrangian."""
        measured = self.measure(batch)
        priced = self.multiplier.react(self, self.measured_levels(measured))
        constrained = self.closure(data, self.limits(), measured)

        def closure() -> TensorDict:
            out = constrained()
            value = lagrangian(out["objective"], out.pop("constraint"), self.multiplier())
            return out.set("objective", value)

        report = self.trust_region.step(closure)
        return {**report.to_dict(), **priced, **self.deviations(measured)}


class TRPOPIDOptions(Controlled, KLOptions):
    """The options of TRPO-PID."""

    method: ClassVar[str] = "trpo_pid"


class TRPOPID(TRPOLagrangian):
    """TRPO-Lagrangian with a multiplier that a PID controller sets.

    Examples:
        >>> from torchrl_safe.trainers import TRPOPID
        >>> policy = TRPOPID("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options = TRPOPIDOptions
