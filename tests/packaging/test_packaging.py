"""What is installed: its weight, versions and page, and that it works without the repository."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import textwrap
from email.parser import Parser
from pathlib import Path
from zipfile import ZipFile

import pytest
import tiny
import torch
from packaging.requirements import Requirement

from torchrl_safe.envs import SafeRobotEnv
from torchrl_safe.record import (
    plot_calibration,
    plot_learning_curves,
    plot_trajectories,
    record_video,
)

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PYTHONS = ["3.10", "3.11", "3.12", "3.13", "3.14"]


def python(code: str, executable: str | Path = sys.executable, **kwargs) -> str:
    """What a new interpreter prints."""
    done = subprocess.run(
        [executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, **kwargs
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


class TestImport:
    def test_loads_nothing(self):
        """What is not loaded takes no time, whatever else the machine does."""
        code = """
            import sys
            before = set(sys.modules)
            import torchrl_safe
            print({name.partition(".")[0] for name in set(sys.modules) - before}
                  - sys.stdlib_module_names)
        """
        assert python(code, cwd=ROOT) == "{'torchrl_safe'}"

    def test_blocks_load_what_torchrl_loads(self):
        code = """
            import sys
            import torchrl.data, torchrl.envs, torchrl.modules, torchrl.objectives.value
            before = {name.partition(".")[0] for name in sys.modules}
            from torchrl_safe import *
            print({name.partition(".")[0] for name in sys.modules} - before
                  - sys.stdlib_module_names)
        """
        assert python(code, cwd=ROOT) == "{'torchrl_safe'}"

    def test_names(self):
        code = """
            import torchrl_safe
            assert torchrl_safe.objectives.value.RetraceEstimator is torchrl_safe.RetraceEstimator
            assert set(torchrl_safe.__all__) <= set(dir(torchrl_safe))
            assert not hasattr(torchrl_safe, "no_such_block")
        """
        python(code, cwd=ROOT)

    def test_training_names_its_extra(self):
        code = """
            import importlib.util
            importlib.util.find_spec = lambda name: None
            try:
                import torchrl_safe.trainers.cli
            except ModuleNotFoundError as error:
                print(error)
        """
        said = python(code, cwd=ROOT)
        assert said.startswith("training needs hydra and")
        assert said.endswith("pip install 'torchrl-safe[train]'.")

    def test_what_is_missing_is_named_with_its_extra(self, tmp_path, monkeypatch):
        env = SafeRobotEnv("point", num_envs=1, num_threads=1)
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        for call in (
            lambda: plot_learning_curves(tmp_path, tmp_path / "curves.png"),
            lambda: plot_calibration({}, tmp_path / "calibration.png"),
            lambda: plot_trajectories([torch.zeros(1)], tmp_path / "trajectories.png"),
            lambda: record_video(env, env.rand_action, tmp_path / "video.mp4"),
        ):
            with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchrl-safe\[train\]'"):
                call()
        assert not list(tmp_path.iterdir())


class TestVersions:
    def test_one_version(self):
        assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text()
        newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
        assert newest[1] == PROJECT["version"]

    @pytest.mark.parametrize("version", PYTHONS)
    def test_what_is_tested_is_in_range(self, version):
        """One exact version of everything that the README's commands ask for, on every Python."""
        environment = {"python_version": version, "python_full_version": f"{version}.0"}

        def applies(requirement: Requirement) -> bool:
            return requirement.marker is None or requirement.marker.evaluate(environment)

        tested = {}
        for line in (ROOT / "constraints.txt").read_text().splitlines():
            if line and not line.startswith("#") and applies(pinned := Requirement(line)):
                assert pinned.name not in tested
                (tested[pinned.name],) = pinned.specifier
        extras = PROJECT["optional-dependencies"]
        asked = [*map(Requirement, PROJECT["dependencies"] + extras["train"] + extras["test"])]
        asked = [one for one in asked if one.name != PROJECT["name"] and applies(one)]
        for requirement in asked:
            exact = tested[requirement.name]
            assert exact.operator == "=="
            assert requirement.specifier.contains(exact.version), requirement
        needs_labmaze = "dm-control" in {requirement.name for requirement in asked}
        assert needs_labmaze == (version in ("3.10", "3.11", "3.12"))


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    """The source distribution of the checkout, and the wheel that is built from it alone."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("this is no clone")
    folder = tmp_path_factory.mktemp("built")
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    for name in listed.stdout.decode().split("\0"):
        if (ROOT / name).is_file():  # neither "" nor what was deleted
            copy = folder / "clone" / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes((ROOT / name).read_bytes())
    build = f"from setuptools import build_meta; print(build_meta.%s({str(folder)!r}))"
    python(build % "build_sdist", cwd=folder / "clone")
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    source = folder / sdist.name.removesuffix(".tar.gz")
    python(build % "build_wheel", cwd=source)
    (wheel,) = folder.glob("*.whl")
    return source, wheel


@pytest.mark.slow
class TestBuilt:
    def test_sdist_is_whole(self, built):
        source, _ = built
        for name in [
            "conftest.py",
            "docs/index.md",
            "docs/images/learning.png",
            "examples/safetac_point.py",
            "benchmarks/pytest.ini",
            "CHANGELOG.md",
            "CITATION.cff",
            "CODE_OF_CONDUCT.md",
            "CONTRIBUTING.md",
            "SECURITY.md",
            "LICENSE",
            "constraints.txt",
        ]:
            assert (source / name).is_file(), name

    def test_wheel_is_the_package(self, built):
        """Every file below torchrl_safe and nothing else, and a page without dead links."""
        source, wheel = built
        with ZipFile(wheel) as archive:
            names = {name for name in archive.namelist() if ".dist-info/" not in name}
            (metadata,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
            page = Parser().parsestr(archive.read(metadata).decode())
        files = (path for path in (source / "torchrl_safe").rglob("*") if path.is_file())
        assert names == {path.relative_to(source).as_posix() for path in files}
        assert page["Version"] == PROJECT["version"]
        assert page["Description-Content-Type"] == "text/markdown"
        links = re.findall(r"\]\(([^)]*)\)", page.get_payload())
        assert links
        assert all(link.startswith("https://") for link in links), links

    def test_works_without_the_repository(self, built, tmp_path):
        """In an environment of its own, which borrows only the packages that it needs."""
        _, wheel = built
        environ = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        venv = tmp_path / "venv"
        interpreter = venv / "bin" / "python"
        pip = [sys.executable, "-m", "pip", "--python", interpreter]
        for command in (
            [sys.executable, "-m", "venv", "--without-pip", venv],
            [*pip, "install", "-q", "--no-deps", "--no-index", wheel],
        ):
            subprocess.run(command, check=True, cwd=tmp_path, env=environ)
        scheme = sysconfig.get_preferred_scheme("prefix")
        site = Path(sysconfig.get_path("purelib", scheme, {"base": str(venv)}))
        # A path in such a file is searched last, and its own .pth files, an editable install's
        # among them, are not read.
        (site / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
        code = """
            import torchrl_safe
            from torchrl.modules import MLP
            from torchrl_safe import *
            from torchrl_safe.envs import ROBOTS, SafeRobotEnv

            for robot in ROBOTS:
                env = SafeRobotEnv(robot, num_envs=2, num_threads=1)
                network = MLP(out_features=2 * (1 + 2 * env.action_spec.shape[-1]), num_cells=[8])
                policy = GMMTanhPolicy(network, env.action_spec, num_components=2)
                assert env.rollout(5, policy)["next", "cost"].shape == (2, 5, 1)
            print(torchrl_safe.__file__)
        """
        assert Path(python(code, interpreter, cwd=tmp_path, env=environ)).is_relative_to(venv)

        train = ["train", "safetac", "env=robot", "env.robot=point", "run_dir=run", *tiny.OVERRIDES]
        for command in (
            [*train, f"collector.total_frames={2 * tiny.FRAMES}"],
            ["evaluate", "run", "--episodes", "2", "--no-film"],
            ["play", "run", "--episodes", "2", "--steps", "10"],
        ):
            done = subprocess.run(
                [venv / "bin" / "torchrl-safe", *command],
                cwd=tmp_path,
                env=environ,
                capture_output=True,
                text=True,
            )
            assert done.returncode == 0, done.stderr
        for file in ("run/config.yaml", "run/results.json", "run/evaluation/results.json"):
            assert (tmp_path / file).is_file()
        (film,) = tmp_path.glob("*.mp4")
        assert film.stat().st_size > 1000
