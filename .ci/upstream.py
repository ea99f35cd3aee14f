"""Apply the contribution of docs/upstream.md to a source tree of TorchRL.

python .ci/upstream.py PATH/TO/rl

Moves the functionals and the estimator behind the code that is there, with their exports, enum
member, docs entry, tests and benchmark; the losses' own tests learn of the new member. Upstream
text that is not found as expected stops it before anything is written.
"""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

HERE = Path(__file__).parents[1]
ESTIMATE = "trace_lambda_return_estimate"
SAFETAC_ONLY = {
    "retrace_variance_reward",
    "squared_td_error",
    "visited_value_estimate",
    "_one_step_cost",
    "_shift",
}
MAIN = """

if __name__ == "__main__":
    pytest.main([__file__, *sys.argv[1:]])
"""


def definitions(path: str, without: set[str] = frozenset()) -> str:
    """Functions, classes and private constants of a file of ours, in order."""
    text = (HERE / path).read_text()
    lines = text.splitlines()
    parts = []
    for node in ast.parse(text).body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)):
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            if not ast.unparse(target).startswith(("_LOG", "_MAX")):
                continue
            parts.append("\n".join(lines[node.lineno - 1 : node.end_lineno]))
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name not in without:
            first = min([node.lineno, *(line.lineno for line in node.decorator_list)])
            parts.append("\n".join(lines[first - 1 : node.end_lineno]))
    return "\n\n" + "\n\n\n".join(parts) + "\n"


def insert(text: str, before: str, addition: str) -> str:
    """Put text before the first line that starts with something, indentation aside."""
    match = re.search(rf"^[ \t]*{re.escape(before)}", text, re.MULTILINE)
    if match is None:
        raise SystemExit(f"expected a line that starts with {before!r}; upstream has changed")
    return text[: match.start()] + addition + text[match.start() :]


def upstream(text: str) -> str:
    """Text of ours under upstream's names."""
    text = re.sub(
        r"torchrl_safe\.objectives\.value\.(\w+_estimate)",
        r"torchrl.objectives.value.functional.\1",
        text,
    )
    text = text.replace("torchrl_safe.", "torchrl.")
    text = text.replace(
        'register_value_estimator("retrace",',
        "register_value_estimator(\n    ValueEstimators.Retrace,",
    )
    return text.replace('RETRACE = "retrace"', "RETRACE = ValueEstimators.Retrace")


def main(root: Path) -> None:
    """Read everything, then write everything."""
    value = root / "torchrl/objectives/value"
    files = {}

    text = (value / "functional.py").read_text()
    text = insert(text, '"vtrace_advantage_estimate"', f'    "{ESTIMATE}",\n')
    text = insert(text, "import math", "from collections.abc import Callable, Sequence\n")
    text = insert(text, "import torch", "").replace(
        "import torch\n", "import torch\nfrom torch import Tensor\n", 1
    )
    text += definitions("torchrl_safe/_checks.py", {"check_count", "check_number"})
    files[value / "functional.py"] = text + definitions(
        "torchrl_safe/objectives/value/functional.py", SAFETAC_ONLY
    )

    text = (value / "advantages.py").read_text()
    text = insert(
        text,
        "import torch",
        "from collections.abc import Sequence\nfrom types import SimpleNamespace\n"
        "from typing import Any, Literal, TYPE_CHECKING\n\n",
    )
    text = text.replace(
        "from contextlib import nullcontext",
        "from contextlib import AbstractContextManager, nullcontext",
    )
    text = insert(
        text,
        "ProbabilisticTensorDictModule,",
        "    ProbabilisticTensorDictSequential,\n    skip_existing,\n",
    )
    text = insert(
        text,
        "from torchrl.envs.utils import",
        "from tensordict.utils import unravel_key\n\n"
        "from torchrl.data.tensor_specs import Bounded, Categorical, OneHot, TensorSpec\n",
    )
    text = insert(text, "td0_return_estimate,", f"    {ESTIMATE},\n")
    text = insert(
        text,
        "def _standardize_by_group(",
        "if TYPE_CHECKING:\n    from torchrl.objectives.common import LossModule\n\n\n",
    )
    ours = ("utils", "advantages")
    files[value / "advantages.py"] = text + "".join(
        upstream(definitions(f"torchrl_safe/objectives/value/{name}.py", {"with_action"}))
        for name in ours
    )

    text = (value / "__init__.py").read_text()
    text = insert(text, "TD0Estimate,", "    RetraceEstimator,\n")
    files[value / "__init__.py"] = insert(text, '"TD0Estimate",', '    "RetraceEstimator",\n')

    utils = root / "torchrl/objectives/utils.py"
    text = insert(utils.read_text(), 'VTrace = "', '    Retrace = "Retrace(lambda)"\n')
    files[utils] = insert(
        text,
        "ValueEstimators.VTrace: {",
        '    ValueEstimators.Retrace: {"gamma": 0.99, "lmbda": 0.97},\n',
    )

    docs = root / "docs/source/reference/objectives_common.rst"
    files[docs] = insert(docs.read_text(), "MultiAgentGAE", "    RetraceEstimator\n")

    licence = (value / "__init__.py").read_text().split("\n\n")[0] + "\n"
    tests = HERE / "tests/objectives/value"
    for name in ("functional", "estimator"):
        text = upstream((tests / f"test_retrace_{name}.py").read_text())
        if name == "functional":
            text = text.replace(
                f"from torchrl.objectives.value import {ESTIMATE}",
                f"from torchrl.objectives.value.functional import {ESTIMATE}",
            )
        else:
            text = text.replace(
                f"from torchrl.objectives.value import RetraceEstimator, {ESTIMATE}",
                "from torchrl.objectives.utils import ValueEstimators\n"
                "from torchrl.objectives.value import RetraceEstimator\n"
                f"from torchrl.objectives.value.functional import {ESTIMATE}",
            )
        text = insert(text, "import pytest", "import sys\n\n").replace(
            "\n\nimport sys", "\nimport sys"
        )
        files[root / f"test/objectives/test_retrace_{name}.py"] = licence + text + MAIN
    text = upstream((HERE / "benchmarks/bench_retrace.py").read_text())
    text = text.replace("def bench_", "def test_")
    files[root / "benchmarks/test_retrace_benchmark.py"] = licence + text

    # Upstream's grids run over every member of the enum and list those that a loss rejects.
    for path in sorted((root / "test/objectives").glob("test_*.py")):
        text = path.read_text()
        if path.name == "test_ppo.py":
            text = text.replace(
                "list(ValueEstimators) + [None]", "[*PPOLoss.SUPPORTED_VALUE_ESTIMATORS, None]"
            )
        elif "list(ValueEstimators)" in text:
            text = re.sub(
                r"( +)ValueEstimators\.VTrace,\n", r"\1ValueEstimators.Retrace,\n\g<0>", text
            )
        else:
            continue
        files[path] = text

    for path, text in files.items():
        path.write_text(text)
        sys.stdout.write(f"{path.relative_to(root)}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
