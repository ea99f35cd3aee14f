"""Options: declared once, with type, default, meaning and what is allowed.

A group of options is a :class:`Group`, whose fields are made by :func:`option`; the options of a
method are an :class:`Options` with groups in it. Everything else is read off these: the command
line's names and defaults, error messages, what a resumed run may change, the page of
configurations.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Iterator, Mapping
from importlib.util import find_spec
from types import UnionType
from typing import Any, ClassVar, Literal, NamedTuple, Union, get_args, get_origin

import annotated_types
import numpy as np
import torch
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo
from torch import nn
from typing_extensions import Self

from torchrl_safe.envs import RANDOMIZATIONS, ROBOTS
from torchrl_safe.trainers.published import PUBLISHED
from torchrl_safe.trainers.tasks import NAMES, follows

MOST = 2**31 - 1  # what C's int holds
FRAMES = 2**63 - 1  # what a counter of frames holds
LARGEST = float(np.finfo(np.float32).max)
EXTRAS = ("tensorboard", "wandb", "ray")  # packages that bear the name of the extra
OF_THE_CALL = ("resume", "run_dir")  # and not of the run


def option(
    default: Any,
    meaning: str,
    *,
    choices: Collection[Any] | Callable[[], Collection[Any]] | None = None,
    allowed: str | None = None,
    fixed: bool = False,
    **bounds: Any,
) -> Any:
    """An option: a field of a :class:`Group`.

    Args:
        default: its value where none is given.
        meaning (str): one line.

    Keyword Args:
        choices (collection, optional): what is allowed, or a function that says it.
        allowed (str, optional): what is allowed, in words, where type and bounds do not say it.
        fixed (bool): whether a resumed run cannot take another value: the shape of what a
            checkpoint holds depends on it, or only the run's beginning does. Defaults to False.
        **bounds: ``gt``, ``ge``, ``lt`` and ``le``. An integer is at most what C's int holds.
    """
    if type(default) is int and "le" not in bounds:
        bounds["le"] = MOST
    extra: Any = {"choices": choices, "allowed": allowed, "fixed": fixed}
    return Field(default, description=meaning, json_schema_extra=extra, **bounds)


def again(
    group: type[Group],
    name: str,
    default: Any,
    *,
    meaning: str | None = None,
    fixed: bool | None = None,
) -> Any:
    """The option ``name`` of a group, with another default: for a class derived from it."""
    field = group.model_fields[name]
    extra: Any = field.json_schema_extra
    return option(
        default,
        meaning or field.description or "",
        choices=extra["choices"],
        allowed=extra["allowed"],
        fixed=extra["fixed"] if fixed is None else fixed,
        **_bounds(field),
    )


class Group(BaseModel):
    """Options that belong together. Values are of their type: no text is taken for a number."""

    model_config = ConfigDict(
        extra="forbid", validate_assignment=True, strict=True, allow_inf_nan=False
    )

    @field_validator("*", mode="after")
    @classmethod
    def _check_value(cls, value: Any, info: ValidationInfo) -> Any:
        """What pydantic does not check: choices, and numbers as networks will have them."""
        field = cls.model_fields[info.field_name or ""]
        extra: Any = field.json_schema_extra
        choices = _choices(extra)
        if choices is not None and value is not None and value not in choices:
            raise ValueError("no choice")
        if isinstance(value, float):  # 1 - 1e-9 is 1
            with np.errstate(over="ignore", under="ignore"):
                single = float(np.float32(value))
            bounds = _bounds(field)
            within = (
                single > bounds.get("gt", -np.inf)
                and single >= bounds.get("ge", -LARGEST)
                and single < bounds.get("lt", np.inf)
                and single <= bounds.get("le", LARGEST)
            )
            if not within:
                raise ValueError("out of bounds in single precision")
        return value


class Env(Group):
    """The environment."""

    name: str = option(
        "robot",
        "what to train in: a robot of ours (robot), a Gymnasium environment (gym), or "
        "module:function, which returns a TorchRL environment with a cost",
        min_length=1,
        fixed=True,
    )
    robot: str | None = option(
        "point",
        "of env=robot; null for a task of Safety-Gymnasium's, which has its own",
        choices=ROBOTS,
        fixed=True,
    )
    task: str | None = option(
        None,
        "of env=robot: another task than the robot's own; one of Safety-Gymnasium's brings its "
        "robot, episodes and limit along",
        choices=NAMES,
        allowed="null, 'goal', 'navigation', 'navigation_speed' or a task of Safety-Gymnasium's, "
        "such as 'SafetyPointGoal1' and 'SafetyHopperVelocity'",
        fixed=True,
    )
    id: str | None = option(None, "of env=gym: the environment's", min_length=1)
    cost: str | None = option(None, "of env=gym: module:function, the cost of a step", min_length=1)
    num_envs: int = option(
        400,
        "environments side by side; many short episodes: the safety critic generalises by the "
        "layouts it has seen",
        ge=1,
    )
    episode_length: int = option(
        125, "steps, in training only: evaluation episodes have eval.num_steps", ge=1
    )
    standardize_frames: int = option(
        0,
        "random steps before training, on top of its frames: networks standardise observations "
        "with their mean and deviation; 0 for none",
        ge=0,
        le=FRAMES,
        fixed=True,
    )
    randomization: str | None = option(
        None, "of mass, friction and so on, in training only; of env=robot", choices=RANDOMIZATIONS
    )


class Collector(Group):
    """Who acts, and for how long."""

    backend: Literal["single", "multi_sync", "multi_async", "ray"] = option(
        "single", "one process or several: see collectors.py"
    )
    num_workers: int = option(2, "processes of the other backends", ge=1)
    frames_per_batch: int = option(8000, "frames per update", ge=1)
    total_frames: int = option(
        1_000_000, "of the whole run, resumed parts included", ge=1, le=FRAMES
    )
    init_frames: int = option(
        20_000, "of the untrained policy, before the first update", ge=0, le=FRAMES
    )


class ReplayBuffer(Group):
    """What is replayed: transitions."""

    size: int = option(1_000_000, "transitions", ge=1, fixed=True)


class SliceBuffer(ReplayBuffer):
    """What is replayed: slices of trajectories."""

    storage: Literal["memory", "memmap"] = option(
        "memory", "or memmap: files in run_dir, which may outgrow the memory"
    )
    slice_len: int = option(20, "steps per replayed slice: the reach of Retrace", ge=1)


class PolicyNetwork(Group):
    """The network of a policy."""

    num_cells: list[int] = option(
        [128, 128], "hidden layers", allowed="a list of integers of at least 1", fixed=True
    )

    @field_validator("num_cells")
    @classmethod
    def _check_widths(cls, value: list[int]) -> list[int]:
        return check_widths(value)


class NoisyPolicy(PolicyNetwork):
    """The policy, deterministic, with noise to explore."""

    noise: float = option(
        0.1, "standard deviation of the noise to explore, of half the action's range", gt=0
    )


class Policy(PolicyNetwork):
    """The policy, a mixture of Gaussians."""

    num_components: int = option(1, "Gaussians in the mixture, K", ge=1, fixed=True)
    relaxation: Literal["gumbel_softmax", "straight_through", "implicit"] = option(
        "implicit", "the policy gradient through K"
    )
    temperature: float = option(0.5, "of the relaxation", gt=0)
    log_std_bounds: list[float] = option(
        [-4.0, 2.0], "before tanh", allowed="two finite numbers, the smaller one first"
    )

    @field_validator("log_std_bounds")
    @classmethod
    def _check_bounds(cls, value: list[float]) -> list[float]:
        if len(value) != 2 or not -LARGEST <= value[0] < value[1] <= LARGEST:
            raise ValueError("no bounds")
        return value


class Critic(Group):
    """The critics."""

    num_cells: list[int] = option(
        [128, 128], "hidden layers of each", allowed="a list of integers of at least 1", fixed=True
    )

    @field_validator("num_cells")
    @classmethod
    def _check_widths(cls, value: list[int]) -> list[int]:
        return check_widths(value)


class Loss(Group):
    """What is learned."""

    gamma: float = option(0.99, "discount of the reward", ge=0, lt=1)


class ConstrainedLoss(Loss):
    """What is learned under a limit on a cost: one problem for all methods."""

    cost_gamma: float = option(0.99, "discount of the cost", ge=0, lt=1)
    risk_level: float = option(0.125, "share of worst outcomes in the CVaR", gt=0, le=1)
    cost_limit: float | dict[str, float] = option(
        5.0,
        "on the cost, in limit_unit; of several costs, one for each by its name",
        allowed="a number in [0, inf), or one for each cost by its name",
    )
    limit_unit: Literal["discounted", "step", "episode"] = option(
        "discounted",
        "of cost_limit: the discounted sum, the mean per step, or the sum of an episode of "
        "eval.num_steps",
    )
    initial_ratio: ClassVar[float] = 1.0

    initial_cost_limit: float | dict[str, float] | None = option(
        None,
        "moves linearly to cost_limit; null is cost_limit itself",
        allowed="null, a number in [0, inf), or one for each cost by its name",
    )
    anneal_frames: int = option(500_000, "over these frames", ge=0, le=FRAMES)

    @field_validator("cost_limit", "initial_cost_limit", mode="after")
    @classmethod
    def _check_limits(cls, value: Any) -> Any:
        limits = value.values() if isinstance(value, dict) else () if value is None else (value,)
        if value == {} or not all(0 <= limit <= LARGEST for limit in limits):
            raise ValueError("no limit")
        return value


class KLRegion(Group):
    """A trust-region step without constraints."""

    max_kl: float = option(0.02, "size of the trust region, nats", gt=0)
    damping: float = option(0.01, "added to the diagonal of the curvature", ge=0)
    cg_iters: int = option(10, "conjugate-gradient iterations", ge=1)
    backtrack_ratio: float = option(
        0.8, "of one line-search candidate to the one before", gt=0, lt=1
    )
    max_backtracks: int = option(10, "candidates after the first", ge=0)
    cuda_graphs: bool = option(True, "on a GPU: launch work at once, not kernel by kernel")


class TrustRegion(KLRegion):
    """The trust-region step."""

    recovery_ratio: float = option(
        0.7, "share of the trust region's radius that a violated constraint may claim", gt=0, le=1
    )


class InitialPrice(Group):
    """What a multiplier starts with."""

    init: float = option(0.1, "multiplier to start with", gt=0, fixed=True)


class Lagrangian(InitialPrice):
    """A multiplier that learns by gradient."""

    lr: float = option(0.005, "of the multiplier, which moves by at most this once per batch", gt=0)


class Logger(Group):
    """The log."""

    backend: Literal["csv", "tensorboard", "wandb", ""] = option(
        "csv", 'wandb is offline unless WANDB_MODE says otherwise; "" for none'
    )
    project_name: str = option("torchrl_safe", "wandb's", min_length=1)


class Eval(Group):
    """Evaluations, during training and at its end."""

    interval: int = option(200_000, "frames", ge=1, le=FRAMES)
    num_episodes: int = option(20, "of an evaluation during training", ge=1)
    final_episodes: int = option(100, "of the one at the end", ge=1)
    num_steps: int = option(1000, "per episode", ge=1)


class Checkpoint(Group):
    """Checkpoints."""

    interval: int = option(400_000, "frames", ge=1, le=FRAMES)
    keep_last: int = option(1, "checkpoints kept", ge=1)


class Video(Group):
    """The film at the end."""

    num_steps: int = option(1000, "0 for none", ge=0)


def devices() -> list[str]:
    """Where tensors can be on this machine."""
    count = torch.cuda.device_count()
    return ["cpu", *(["cuda"] if count else []), *(f"cuda:{i}" for i in range(count))]


class Options(Group):
    """All options of a method.

    A method's class sets :attr:`method`, by which files name it, and adds its groups.

    Raises:
        ValueError: if an option is unknown, its value is impossible, or two do not go together.

    Examples:
        >>> from torchrl_safe.trainers import SafeTAC
        >>> options = SafeTAC.Options.of(cost_limit=2.5, num_components=3)
        >>> options.loss.cost_limit, options.policy.num_components, sorted(given(options))
        (2.5, 3, ['loss.cost_limit', 'policy.num_components'])
        >>> SafeTAC.Options.of(risk_level=2)
        Traceback (most recent call last):
        ValueError: loss.risk_level must be a number in (0, 1], got 2.
    """

    method: ClassVar[str] = ""
    known: ClassVar[dict[str, type[Options]]] = {}

    seed: int = option(0, "of networks, noise and layouts", ge=0, le=2**64 - 1, fixed=True)
    num_threads: int | None = option(
        None,
        "of torch and of the simulator; null is two, of which torch uses one while others want "
        "the cores: the last bits of sums then depend on them",
        ge=1,
        le=MOST,
    )
    device: str = option(
        "cpu",
        "or cuda, cuda:1: of networks, replay and updates; the simulator is on the CPU",
        choices=lambda: devices(),
    )
    run_dir: str | None = option(
        None,
        "everything the run writes goes here; null is runs/METHOD/ENVIRONMENT/seed_SEED",
        min_length=1,
        allowed="null or a path",
    )
    resume: bool = option(False, "go on from the newest checkpoint in run_dir")

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        if cls.method:
            cls.known[cls.method] = cls

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise ValueError(_message(type(self), error, values)) from None

    @classmethod
    def of(cls, **named: Any) -> Self:
        """Options by name: dotted, or the last part where only one option has it.

        Raises:
            ValueError: if there is no such option or several, or a value is impossible.
        """
        values: dict[str, Any] = {}
        for name, value in named.items():
            full = cls._full_name(name)
            if full in values:
                raise ValueError(f"{full} is given twice.")
            values[full] = value
        return cls(**_nested(values))

    def changed(self, **named: Any) -> Self:
        """These options with others in their place, by name as in :meth:`of`.

        Raises:
            ValueError: if there is no such option or several, or a value is impossible.
        """
        values = dict(flat(self))
        kept = {name: values[name] for name in given(self)}
        return type(self).of(**kept | {self._full_name(n): value for n, value in named.items()})

    @classmethod
    def _full_name(cls, name: str) -> str:
        names = [each.name for each in describe(cls)]
        if name in names:
            return name
        found = [each for each in names if each.rpartition(".")[2] == name]
        if len(found) > 1:
            raise ValueError(
                f"{name} is the name of several options: {', '.join(found)}. Write one of them as "
                f"**{{{found[0]!r}: ...}}."
            )
        if not found:
            raise ValueError(_unknown(cls, name))
        return found[0]

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Options:
        """The options that :meth:`settings` wrote, of the method that they name.

        The method is one that is known here: nothing that a file names is imported.

        Raises:
            ValueError: if the method is unknown, or the options are not those of the method.
        """
        import torchrl_safe.trainers.methods  # noqa: F401, makes them known

        method = settings.get("method")
        if method not in cls.known:
            raise ValueError(f"method must be one of {sorted(cls.known)}, got {method!r}.")
        return cls.known[method](**{n: v for n, v in settings.items() if n != "method"})

    def settings(self) -> dict[str, Any]:
        """Everything, written out: plain values in plain dicts."""
        return {"method": self.method, **self.model_dump()}

    @property
    def folder(self) -> str:
        """Where the run is."""
        if self.run_dir is not None:
            return self.run_dir
        env = getattr(self, "env", None)
        names = []
        if env is not None:
            ours = env.task if follows(env.task) else env.robot
            names = [ours if env.name == "robot" else env.id or env.name]
        return "/".join(["runs", self.method, *names, f"seed_{self.seed}"])

    def check_installed(self) -> None:
        """Look for the packages of a logger or collector.

        Raises:
            ModuleNotFoundError: if one is missing, with what installs it.
        """
        values = dict(flat(self))
        for name, plain in (("logger.backend", "csv"), ("collector.backend", "single")):
            extra = values.get(name)
            if extra in EXTRAS and find_spec(extra) is None:
                raise ModuleNotFoundError(
                    f"{name}={extra} needs a package: pip install 'torchrl-safe[{extra}]'; "
                    f"{name}={plain} needs none."
                )

    @classmethod
    def published_values(cls, name: str | None) -> dict[str, Any]:
        """The options of :data:`~torchrl_safe.trainers.published.PUBLISHED` of this method.

        Raises:
            ValueError: if there are none of this name.
        """
        known = PUBLISHED.get(cls.method, {})
        if name is None:
            return {}
        if name not in known:
            names = f" or one of {', '.join(map(repr, known))}" if known else ""
            raise ValueError(f"published must be null{names} for {cls.method}, got {name!r}.")
        return {option: value for option, (value, _) in known[name].values.items()}

    @model_validator(mode="after")
    def _follow(self) -> Self:
        """Options that nobody has given are what was published, or the task says."""
        published = self.published_values(getattr(self, "published", None))
        env = getattr(self, "env", None)
        if not isinstance(env, Env):
            return self
        if env.name != "robot" and env.task is not None:
            raise ValueError(f"env.task must be null for env={env.name}, got {env.task!r}.")
        said, repeated = follows(env.task), given(self)
        if said and "env.robot" in repeated and env.robot is not None:
            raise ValueError(
                f"env.robot must be null for env.task={env.task}, which has its own, got "
                f"{env.robot!r}."
            )
        if env.name == "robot" and env.robot is None and not said:
            raise ValueError(f"env.robot must be one of {', '.join(map(repr, ROBOTS))}, got null.")
        followed = published | said
        for name in followed.keys() & dict(flat(self)).keys() - repeated:
            group, _, last = name.partition(".")
            setattr(getattr(self, group), last, followed[name])
            getattr(self, group).model_fields_set.discard(last)  # nobody has given it
        return self

    @model_validator(mode="after")
    def _check_together(self) -> Self:
        """Options that depend on one another; those that a method lacks are not checked."""
        values = dict(flat(self))
        if values.get("replay_buffer.storage") == "memmap" and self.device != "cpu":
            raise ValueError(
                "replay_buffer.storage=memmap keeps the replay on the CPU, so that device must be "
                f"cpu, got {self.device!r}."
            )
        workers = values.get("collector.backend", "single") != "single"
        for name, divisor in (
            ("collector.frames_per_batch", "env.num_envs"),
            *((("env.num_envs", "collector.num_workers"),) if workers else ()),
            ("optim.critic_frames", "replay_buffer.slice_len"),
            ("replay_buffer.batch_size", "replay_buffer.slice_len"),
            ("optim.num_updates", "optim.policy_delay"),
        ):
            if {name, divisor} <= values.keys() and values[name] % values[divisor]:
                raise ValueError(
                    f"{name} must be a multiple of {divisor}={values[divisor]}, got {values[name]}."
                )
        if {"replay_buffer.slice_len", "env.num_envs"} <= values.keys():
            _check_slices(values)
        for name, ceiling in (
            ("replay_buffer.slice_len", "env.episode_length"),
            ("collector.frames_per_batch", "replay_buffer.size"),
            ("optim.critic_frames", "replay_buffer.size"),
        ):
            if {name, ceiling} <= values.keys() and values[name] > values[ceiling]:
                raise ValueError(
                    f"{name} must be at most {ceiling}={values[ceiling]}, got {values[name]}."
                )
        return self


class MethodOptions(Options):
    """What the options of all methods have."""

    published: str | None = option(
        None,
        "settings that the method was published with, for all options that are not given",
        allowed="null or one of the names in published.py that the method has",
        fixed=True,
    )
    env: Env = Field(default_factory=Env)
    collector: Collector = Field(default_factory=Collector)
    policy: Policy = Field(default_factory=Policy)
    critic: Critic = Field(default_factory=Critic)
    logger: Logger = Field(default_factory=Logger)
    eval: Eval = Field(default_factory=Eval)
    checkpoint: Checkpoint = Field(default_factory=Checkpoint)
    video: Video = Field(default_factory=Video)


def check_widths(value: list[int]) -> list[int]:
    """Sizes of hidden layers.

    Raises:
        ValueError: if one is not positive.
    """
    if not all(1 <= width <= MOST for width in value):
        raise ValueError("no widths")
    return value


def flat(group: Group, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Options by their dotted names."""
    for name in type(group).model_fields:
        value = getattr(group, name)
        if isinstance(value, Group):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def given(group: Group, prefix: str = "") -> set[str]:
    """Dotted names of the options that somebody has set, to whatever value."""
    names: set[str] = set()
    for name in group.model_fields_set:
        value = getattr(group, name)
        names |= given(value, f"{prefix}{name}.") if isinstance(value, Group) else {prefix + name}
    return names


class Description(NamedTuple):
    """An option, in words.

    Attributes:
        name: dotted.
        default: where none is given.
        allowed: what is allowed.
        meaning: one line.
        fixed: whether a resumed run cannot take another value.
    """

    name: str
    default: Any
    allowed: str
    meaning: str
    fixed: bool


def per_episode(limit: float, unit: str, cost_gamma: float, num_steps: int) -> float:
    """What a limit amounts to as the sum of an episode's costs, at the same cost in every step.

    Args:
        limit (float): in ``unit``.
        unit (str): of ``loss.limit_unit``.
        cost_gamma (float): discount of the cost, in [0, 1).
        num_steps (int): of the episode.

    Examples:
        >>> per_episode(5.0, "discounted", 0.99, 1_000)  # 0.05 in each of 1,000 steps
        50.0
        >>> per_episode(0.05, "step", 0.99, 1_000), per_episode(25.0, "episode", 0.99, 1_000)
        (50.0, 25.0)
    """
    if unit == "episode":
        return limit
    rate = limit * (1 - cost_gamma) if unit == "discounted" else limit
    return round(rate * num_steps, 9)  # 1 - 0.99 is not quite 0.01


def describe(group: type[Group], prefix: str = "") -> list[Description]:
    """Every option of a class, in the order of their declaration."""
    rows = []
    for name, field in group.model_fields.items():
        kind: Any = field.annotation
        if isinstance(kind, type) and issubclass(kind, Group):
            rows += describe(kind, f"{prefix}{name}.")
        else:
            extra: Any = field.json_schema_extra
            rows.append(
                Description(
                    prefix + name,
                    field.default,
                    _allowed(field),
                    field.description or "",
                    extra["fixed"],
                )
            )
    return rows


def settle(saved: Mapping[str, Any], new: Options) -> tuple[Options, dict[str, tuple[Any, Any]]]:
    """The options with which a saved run goes on, and what of them changes.

    Args:
        saved (mapping): the :meth:`~Options.settings` of the run so far, maybe of an older version.
        new (Options): those of the call; what is not :func:`given` stays as it was.

    Returns:
        tuple: the options of now, and from the name of each that changes to its old and new value.

    Raises:
        ValueError: if an option is given another value that a run cannot take up, by its name.
    """
    changed: dict[str, tuple[Any, Any]] = {}
    fixed = set()
    if saved.get("method") != new.method:  # who starts another method says so
        changed["method"], fixed = (saved.get("method"), new.method), {"method"}
    values = dict(flat(new))
    repeated = given(new)
    for name, value in values.items():
        before = _look_up(saved, name, value)
        if name in OF_THE_CALL or before == value:
            continue
        if name in repeated:
            changed[name] = (before, value)
        else:
            values[name] = before
    fixed |= {row.name for row in describe(type(new)) if row.fixed} & changed.keys()
    if fixed:
        was = ", ".join(
            f"{n} was {old!r} and is {value!r}" for n, (old, value) in changed.items() if n in fixed
        )
        raise ValueError(
            f"run_dir={new.folder} cannot go on with other values of {', '.join(sorted(fixed))}: "
            f"{was}. Leave them out, or start a new run in another run_dir."
        )
    return type(new)(**_nested(values)), changed


def settings_of(component: Any) -> Callable[[], None]:
    """Remembers what a component was made with, to put it back when a checkpoint is loaded.

    A checkpoint holds the settings of the time it was written at: those of an optimizer's groups
    (learning rates, ``max_kl``, damping), and numbers that a module keeps as buffers (discounts,
    the limit). The options of now are the ones that count.

    Args:
        component: an optimizer or a module; of anything else nothing is remembered.

    Returns:
        callable: puts the settings back.

    Examples:
        >>> weight = torch.nn.Parameter(torch.zeros(1))
        >>> old, new = (torch.optim.Adam([weight], lr=lr) for lr in (0.1, 0.2))
        >>> put_back = settings_of(new)
        >>> new.load_state_dict(old.state_dict())
        >>> new.param_groups[0]["lr"]
        0.1
        >>> put_back()
        >>> new.param_groups[0]["lr"]
        0.2
    """
    if isinstance(component, torch.optim.Optimizer):
        groups = [
            {name: value for name, value in group.items() if name != "params"}
            for group in component.param_groups
        ]

        def put_back() -> None:
            for group, settings in zip(component.param_groups, groups, strict=True):
                group.update(settings)

    elif isinstance(component, nn.Module):
        numbers = {n: b.clone() for n, b in component.named_buffers() if b.ndim == 0}

        def put_back() -> None:
            for name, buffer in component.named_buffers():
                if name in numbers:
                    buffer.copy_(numbers[name])

    else:

        def put_back() -> None:
            pass

    return put_back


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted names as dicts in dicts."""
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        inner = nested
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[last] = value
    return nested


def _look_up(settings: Mapping[str, Any], name: str, otherwise: Any) -> Any:
    value: Any = settings
    for part in name.split("."):
        if not isinstance(value, Mapping) or part not in value:
            return otherwise
        value = value[part]
    return value


def _choices(extra: Mapping[str, Any]) -> Collection[Any] | None:
    choices = extra["choices"] if extra else None
    return choices() if callable(choices) else choices


def _bounds(field: FieldInfo) -> dict[str, Any]:
    kinds = {
        annotated_types.Gt: "gt",
        annotated_types.Ge: "ge",
        annotated_types.Lt: "lt",
        annotated_types.Le: "le",
        annotated_types.MinLen: "min_length",
    }
    return {
        kinds[type(each)]: getattr(each, kinds[type(each)])
        for each in field.metadata
        if type(each) in kinds
    }


def _allowed(field: FieldInfo) -> str:
    """What an option's value must be, in words."""
    extra: Any = field.json_schema_extra
    if extra["allowed"]:
        return extra["allowed"]
    kind: Any = field.annotation
    nothing = ""
    if get_origin(kind) in (Union, UnionType):
        kinds = [each for each in get_args(kind) if each is not type(None)]
        nothing = "null or " if len(kinds) < len(get_args(kind)) else ""
        kind = kinds[0]
    choices = _choices(extra)
    if get_origin(kind) is Literal:
        choices = get_args(kind)
    if kind is bool:
        choices = (True, False)
    if choices is not None:
        return f"{nothing}one of {', '.join(map(repr, choices))}"
    bounds = _bounds(field)
    if kind is int:
        least = "" if "ge" not in bounds else f" of at least {bounds['ge']} and"
        return f"{nothing}an integer{least} at most {bounds['le']}"
    if kind is float:
        low = f"({bounds['gt']}" if "gt" in bounds else f"[{bounds.get('ge', '-inf')}"
        high = f"{bounds['le']}]" if "le" in bounds else f"{bounds.get('lt', 'inf')})"
        return f"{nothing}a number in {low}, {high}"
    return f"{nothing}a name"


def _message(options: type[Options], error: ValidationError, values: Mapping[str, Any]) -> str:
    """The first mistake, with the option's dotted name and what is allowed."""
    first = error.errors()[0]
    field: Any = None
    group: Any = options
    names: list[str] = []
    for part in first["loc"]:
        if not (isinstance(group, type) and issubclass(group, Group)):
            break  # inside of a value
        names.append(str(part))
        if part not in group.model_fields:
            return _unknown(options, ".".join(names))
        field = group.model_fields[str(part)]
        group = field.annotation
    if field is None:  # of options together
        return str(first["ctx"]["error"]) if "ctx" in first else first["msg"]
    name, value = ".".join(names), first["input"]
    if isinstance(group, type) and issubclass(group, Group):
        return f"{name} must be a group of options, got {value!r}."
    if len(first["loc"]) > len(names):  # of an entry: show all of it
        value = _look_up(values, name, value)
    return f"{name} must be {_allowed(field)}, got {_shown(value)}."


def _unknown(options: type[Options], name: str) -> str:
    names = [row.name for row in describe(options)]
    last = name.rpartition(".")[2]
    close = difflib.get_close_matches(name, names) or [
        each
        for each in names
        if each.rpartition(".")[2] in difflib.get_close_matches(last, [last, *_lasts(names)])
    ]
    return f"{name} is not an option; there are {', '.join(close or names)}."


def _lasts(names: list[str]) -> list[str]:
    return [name.rpartition(".")[2] for name in names]


def _shown(value: Any) -> str:
    """A value as it was written, and where it differs visibly, as networks will have it."""
    if not isinstance(value, float):
        return repr(value)
    with np.errstate(over="ignore", under="ignore"):
        single = np.float32(value)
    rounded = value not in (0, 1) and single in (0, 1, np.inf, -np.inf) and abs(value) < np.inf
    return f"{value!r}, which is {single} in single precision" if rounded else repr(value)


def _check_slices(values: Mapping[str, Any]) -> None:
    """The first update replays slices of trajectories that must be there by then."""
    frames, slice_len = values["collector.frames_per_batch"], values["replay_buffer.slice_len"]
    num_envs = values["env.num_envs"]
    batches = max(1, -(-values["collector.init_frames"] // frames))
    if values["collector.backend"] == "multi_async":  # the next batch is another worker's
        num_envs, batches = num_envs // values["collector.num_workers"], 1
    steps = frames // num_envs
    if steps < 2 or batches * steps < slice_len:
        least = num_envs * max(2, -(-slice_len // batches))
        raise ValueError(
            f"collector.frames_per_batch must be at least {least}, got {frames}: {num_envs} "
            f"environments must take {slice_len} steps (replay_buffer.slice_len), and 2 in every "
            f"batch, before the first update at collector.init_frames="
            f"{values['collector.init_frames']}."
        )
