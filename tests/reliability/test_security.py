"""What is loaded runs no code, nothing is sent, and no string reaches a shell."""

from __future__ import annotations

import ast
import contextlib
import hashlib
import json
import os
import pickle
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import run_exported
import tiny
from torchrl.checkpoint import CheckpointError

from torchrl_safe import _files
from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.trainers import checkpoints, load_policy, saved, saved_policies, trainer
from torchrl_safe.trainers.commands import evaluate, export, play, watch
from torchrl_safe.trainers.environments import UntrustedError
from torchrl_safe.trainers.run import Run as OriginalRun

REPOSITORY = Path(__file__).parents[2]


class Run(OriginalRun):
    """Remembers what a script made."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        Run.last = self


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A finished run; what loads its checkpoint is in ``Run.last``."""
    run_dir = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "Run", Run)
        tiny.launch(run_dir, "collector.total_frames=200")
    return run_dir


@pytest.fixture
def run_dir(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "run")


class Payload:
    """Unpickled, it makes a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def payload(marker: Path, protocol: int = 4) -> bytes:
    return pickle.dumps(Payload(marker), protocol)


def load(run_dir: Path, component: str) -> None:
    Run.last.checkpoint.load(checkpoints.latest(run_dir), components=[component])


def reseal(run_dir: Path, name: str) -> None:
    """What someone does who knows how a run is written: digests that fit what lies there."""
    checkpoint, folder = checkpoints.latest(run_dir), components(run_dir)[name]
    files = sorted(file for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
    sealed = {
        file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in files
        if file != folder / checkpoints.DIGESTS
    }
    (folder / checkpoints.DIGESTS).write_text(json.dumps(sealed))
    manifest = json.loads((checkpoint / "manifest.json").read_text())
    digest = hashlib.sha256((folder / checkpoints.DIGESTS).read_bytes()).hexdigest()
    manifest["metadata"]["digests"][name] = digest
    (checkpoint / "manifest.json").write_text(json.dumps(manifest))


def components(run_dir: Path) -> dict[str, Path]:
    checkpoint = checkpoints.latest(run_dir)
    records = json.loads((checkpoint / "manifest.json").read_text())["components"]
    return {name: checkpoint / record["path"] for name, record in records.items()}


def test_payload_works(tmp_path):
    """Or the tests below would prove nothing."""
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        marker = tmp_path / str(protocol)
        pickle.loads(payload(marker, protocol))
        assert marker.exists()


def test_checkpoint_as_written_loads_and_holds_no_pickle(run_dir):
    for name, folder in components(run_dir).items():
        assert (folder / checkpoints.DIGESTS).exists()
        if name != "collector":  # closed with its run; that it resumes is tested elsewhere
            load(run_dir, name)
    suffixes = {file.suffix for file in (run_dir / "checkpoints").rglob("*") if file.is_file()}
    assert suffixes == set(checkpoints.SUFFIXES)


def test_pickle_in_every_file(run_dir, tmp_path, monkeypatch):
    """Each file in turn; then again by someone who also writes fitting digests."""
    monkeypatch.setattr(os, "fsync", lambda _: None)  # hundreds of times
    marker, count = tmp_path / "marker", 0
    for name, folder in components(run_dir).items():
        files = [file for file in folder.rglob("*") if file.is_file()]
        for file in files:
            whole = file.read_bytes()
            file.write_bytes(payload(marker))
            with pytest.raises(CheckpointError, match=name) as caught:
                load(run_dir, name)
            if file.name != checkpoints.DIGESTS:
                assert str(file) in str(caught.value)
                manifest = checkpoints.latest(run_dir) / "manifest.json"
                sealed, held = (folder / checkpoints.DIGESTS).read_bytes(), manifest.read_bytes()
                reseal(run_dir, name)
                with contextlib.suppress(CheckpointError):  # bytes in place of numbers may load
                    load(run_dir, name)
                (folder / checkpoints.DIGESTS).write_bytes(sealed)
                manifest.write_bytes(held)
            file.write_bytes(whole)
            assert not marker.exists(), file
            count += 1
    assert count > 100


@pytest.mark.parametrize(
    "name", ["prefetch.pkl", "transform.t", "state.pt", "other.pickle", "sampler/x.pt", "state.tdz"]
)
def test_added_pickle(run_dir, tmp_path, name):
    """Files that TorchRL's own loaders would find; with fitting digests, too."""
    marker = tmp_path / "marker"
    for component, folder in components(run_dir).items():
        file = folder / name
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(payload(marker))
        for sealed in (False, True):
            if sealed:
                reseal(run_dir, component)
            with pytest.raises(CheckpointError, match="may run code when it is read"):
                load(run_dir, component)
    assert not marker.exists()


ANYTHING = {"_type": "<class 'tensordict.tensorclass.NonTensorData'>", "_metadata": None}


def test_metadata_that_asks_for_a_pickle(run_dir, tmp_path):
    """A memory-mapped folder may call itself a container of arbitrary objects, or hold one."""
    marker = tmp_path / "marker"
    state = components(run_dir)["policy"] / "state"
    whole = (state / "meta.json").read_text()
    evil = state / "evil"
    evil.mkdir()
    for folder in (state, evil):
        (folder / "other.pickle").write_bytes(payload(marker))
    for inner, outer in (
        (ANYTHING, whole),
        ({}, json.dumps(ANYTHING)),
        (ANYTHING, json.dumps(json.loads(whole) | {"evil": {"type": "NonTensorData"}})),
        (ANYTHING, json.dumps(json.loads(whole) | {"evil": {"type": "TensorDict"}})),
    ):
        (evil / "meta.json").write_text(json.dumps(inner))
        (state / "meta.json").write_text(outer)
        reseal(run_dir, "policy")
        with pytest.raises(CheckpointError, match="may run code"):
            load_policy(run_dir)
    for folder in (state, evil):  # the metadata alone is refused, too
        (folder / "other.pickle").unlink()
    reseal(run_dir, "policy")
    with pytest.raises(CheckpointError, match="may run code"):
        load_policy(run_dir)
    assert not marker.exists()


@pytest.mark.parametrize("name", ["digests.json", "meta.json", "notes"])
@pytest.mark.parametrize("where", [".", "state"])
def test_linked_folder_of_any_name(run_dir, tmp_path, name, where):
    marker, elsewhere = tmp_path / "marker", run_dir / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "meta.json").write_text(json.dumps(ANYTHING))
    (elsewhere / "other.pickle").write_bytes(payload(marker))
    folder = components(run_dir)["policy"]
    meta = json.loads((folder / "state" / "meta.json").read_text())
    meta[name] = {"type": "NonTensorData"}
    if name != "meta.json":
        (folder / "state" / "meta.json").write_text(json.dumps(meta))
    link = folder / where / name
    link.unlink(missing_ok=True)
    reseal(run_dir, "policy")
    link.unlink(missing_ok=True)
    link.symlink_to(os.path.relpath(elsewhere, link.parent))
    with pytest.raises(CheckpointError, match=f"{name} must be a regular file, and is a link"):
        load_policy(run_dir)
    assert not marker.exists()


@pytest.mark.parametrize("switch", ["state", "buffer"])
def test_the_library_itself_is_told_not_to_unpickle(run_dir, tmp_path, monkeypatch, switch):
    """Behind the checks, which are left out here, tensordict's own switch is off."""
    marker = tmp_path / "marker"
    name = {"state": "policy", "buffer": "buffer"}[switch]
    folder = components(run_dir)[name] / {"state": "state", "buffer": "storage"}[switch]
    (folder / "meta.json").write_text(json.dumps(ANYTHING))
    (folder / "other.pickle").write_bytes(payload(marker))
    monkeypatch.setattr(checkpoints, "check_component", lambda *_: None)
    with pytest.raises(CheckpointError, match=r"Refusing to load pickled|pickled non-tensor"):
        load(run_dir, name)
    assert not marker.exists()


def test_folder_that_cannot_be_listed(run_dir, monkeypatch):
    """What is in it was not looked at."""
    hidden = components(run_dir)["policy"] / "state" / "hidden"
    hidden.mkdir()
    scandir = os.scandir

    def refuse(path):
        if Path(path) == hidden:
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(CheckpointError, match="hidden cannot be listed: Permission denied"):
        load_policy(run_dir)


def paths_on_the_way(run_dir: Path) -> list[Path]:
    """Every folder and file between a run's folder and its policy's weights."""
    folder = components(run_dir)["policy"]
    files = sorted(folder.rglob("*"))
    config = components(run_dir)["config"]
    parents = [path for path in folder.parents if run_dir in path.parents]
    manifest = checkpoints.latest(run_dir) / "manifest.json"
    return [run_dir / "config.yaml", manifest, *parents, folder, config, *files]


def test_links_are_followed_nowhere(run_dir, tmp_path):
    """Moved away and linked to, each in turn: the same bytes, and refused by name."""
    ways = paths_on_the_way(run_dir)
    assert len(ways) > 10
    for path in ways:
        away = tmp_path / "away"
        path.rename(away)
        path.symlink_to(away)
        with pytest.raises(CheckpointError, match=f"{path.name} must be .*, and is a link"):
            load_policy(run_dir)
        path.unlink()
        away.rename(path)
    load_policy(run_dir)


def test_a_run_may_lie_behind_a_link(run_dir, tmp_path):
    (tmp_path / "link").symlink_to(run_dir)
    load_policy(tmp_path / "link")


@pytest.mark.parametrize("kind", ["pipe", "socket"])
def test_nothing_waits_for_what_is_no_file(run_dir, kind):
    """Each file in turn is a pipe, whose reader would wait for a writer for ever."""
    for path in paths_on_the_way(run_dir):
        if path.is_dir():
            continue
        whole = path.read_bytes()
        path.unlink()
        if kind == "pipe":
            os.mkfifo(path)
        else:
            with socket.socket(socket.AF_UNIX) as server, contextlib.chdir(path.parent):
                server.bind(path.name)
        with pytest.raises(CheckpointError, match=f"{path.name} must be .*, and is a {kind}"):
            load_policy(run_dir)
        path.unlink()
        path.write_bytes(whole)
    os.mkfifo(run_dir / "log" / "scalars" / "x.csv")
    with pytest.raises(ValueError, match=r"x\.csv must be a regular file, and is a pipe"):
        watch.look(run_dir)


def test_huge_files_are_not_read(run_dir):
    """Holes of a terabyte take no space on the disk, and an hour to add up."""
    started = time.monotonic()
    for path in paths_on_the_way(run_dir):
        if path.is_dir() or path.name == "config.yaml":  # which is not read
            continue
        whole = path.read_bytes()
        os.truncate(path, 2**40)
        with pytest.raises(CheckpointError, match=r"is larger than|the most that there can be"):
            load_policy(run_dir)
        path.unlink()
        path.write_bytes(whole)
    os.truncate(run_dir / "log" / "scalars" / "train" / "cv_rate.csv", 2**40)
    with pytest.raises(ValueError, match=r"cv_rate\.csv is larger than"):
        watch.look(run_dir)
    os.truncate(run_dir / "config.yaml", 2**40)
    with pytest.raises(CheckpointError, match=r"config\.yaml is larger than"):
        watch.look(run_dir)
    assert time.monotonic() - started < 60


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"shape": [2**40, 24]}, "wants"),
        ({"shape": [8, 25]}, "wants"),
        ({"shape": [8, -24]}, "does not say"),
        ({"shape": [8.0, 24]}, "does not say"),
        ({"shape": [2**70]}, "does not say"),
        ({"shape": [1] * 99}, "does not say"),
        ({"dtype": "torch.float64"}, "wants"),
        ({"dtype": "torch.load"}, "does not say"),
        ({"is_nested": True}, "does not say"),
        ({"type": "NonTensorData"}, "does not say"),
    ],
)
def test_shapes_that_would_lengthen_a_file(run_dir, change, match):
    """Mapped with a larger shape, a file grows to it."""
    folder = components(run_dir)["policy"] / "state"
    meta = json.loads((folder / "meta.json").read_text())
    meta["tensor_00000000"] |= change
    (folder / "meta.json").write_text(json.dumps(meta))
    reseal(run_dir, "policy")
    sizes = {file: file.stat().st_size for file in folder.iterdir()}
    with pytest.raises(CheckpointError, match=match):
        load_policy(run_dir)
    assert {file: file.stat().st_size for file in folder.iterdir()} == sizes


@pytest.mark.parametrize("key", ["../../x", "/etc/passwd", "a/b", "a\x1b[2J", ""])
def test_metadata_that_names_other_files(run_dir, tmp_path, key):
    folder = components(run_dir)["policy"] / "state"
    meta = json.loads((folder / "meta.json").read_text())
    for entry in ({"type": "TensorDict"}, meta["tensor_00000000"]):
        (folder / "meta.json").write_text(json.dumps(meta | {key: entry}))
        reseal(run_dir, "policy")
        with pytest.raises(CheckpointError, match="an impossible key") as caught:
            load_policy(run_dir)
        assert "\x1b" not in str(caught.value)


def test_storage_that_names_other_files(run_dir, tmp_path):
    """A storage of plain trees lists the files to map, whose names may lead anywhere."""
    outside = tmp_path / "outside.memmap"
    outside.write_bytes(b"secret")
    metadata = components(run_dir)["buffer"] / "storage" / "storage_metadata.json"
    tree = {f"{tmp_path}/outside": {"shape": [1000], "dtype": "torch.float32"}}
    metadata.write_text(json.dumps({"is_pytree": True, "len": 4, "metadata": tree}))
    reseal(run_dir, "buffer")
    with pytest.raises(CheckpointError, match="no tensordicts"):
        load(run_dir, "buffer")
    assert outside.read_bytes() == b"secret"


@pytest.mark.parametrize(
    "entry",
    [
        {"kind": "path", "value": "/"},
        {"kind": "numpy", "key": "tensor_00000000", "dtype": "S1000000000"},
        {"kind": "numpy_scalar", "dtype": "O", "value": 1},
        {"kind": "range", "items": [0, 10**18, 1]},
        {"kind": "tensor", "key": "tensor_99999999", "device": "cpu"},
        {"kind": "value", "value": {"kind": "value"}},
        {"kind": None},
        [],
        "value",
    ],
)
def test_state_that_is_more_than_data(run_dir, entry):
    file = components(run_dir)["policy"] / "state.json"
    schema = json.loads(file.read_text())
    schema["items"].append([{"kind": "value", "value": "more"}, entry])
    file.write_text(json.dumps(schema))
    reseal(run_dir, "policy")
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_policy(run_dir)


@pytest.mark.parametrize("text", ["[" * 200_000, '{"kind": 1, "kind": 2}', "\xff", "{} {}", ""])
def test_json_that_is_none(run_dir, text):
    for file in (
        components(run_dir)["policy"] / "state.json",
        components(run_dir)["policy"] / "state" / "meta.json",
        checkpoints.latest(run_dir) / "manifest.json",
    ):
        whole = file.read_bytes()
        file.write_bytes(text.encode("latin-1"))
        if file.name != "manifest.json":
            reseal(run_dir, "policy")
        with pytest.raises(CheckpointError, match=f"{file.name} is (no JSON|nested too deep)"):
            load_policy(run_dir)
        file.write_bytes(whole)


def test_missing_or_foreign_digests(run_dir, tmp_path):
    """Nothing is taken on trust: not without digests, not with those of another component."""
    folder = components(run_dir)["policy"]
    digests = (folder / checkpoints.DIGESTS).read_bytes()
    (folder / checkpoints.DIGESTS).unlink()
    with pytest.raises(CheckpointError, match=r"digests\.json is missing"):
        load_policy(run_dir)
    (folder / checkpoints.DIGESTS).write_bytes(digests)
    load_policy(run_dir)

    other = tmp_path / "other"
    tiny.launch(other, "collector.total_frames=100", "seed=5")
    shutil.move(folder, tmp_path / "own")
    shutil.copytree(components(other)["policy"], folder)
    with pytest.raises(CheckpointError, match=f"{folder / 'digests.json'} is not what was written"):
        load_policy(run_dir)

    manifest = checkpoints.latest(run_dir) / "manifest.json"
    content = json.loads(manifest.read_text())
    for digests in (None, {}, [], {"policy": 1}, {"policy": "0" * 63}):
        content["metadata"]["digests"] = digests
        manifest.write_text(json.dumps(content))
        with pytest.raises(CheckpointError, match=r"no digests|is not what was written"):
            load_policy(run_dir)


def test_digests_that_name_files_outside(run_dir, tmp_path):
    outside = run_dir / "config.yaml"
    folder = components(run_dir)["policy"]
    for name in (os.path.relpath(outside, folder), str(outside)):
        reseal(run_dir, "policy")
        listed = json.loads((folder / checkpoints.DIGESTS).read_text())
        listed[name] = hashlib.sha256(outside.read_bytes()).hexdigest()
        (folder / checkpoints.DIGESTS).write_text(json.dumps(listed))
        manifest = checkpoints.latest(run_dir) / "manifest.json"
        content = json.loads(manifest.read_text())
        content["metadata"]["digests"]["policy"] = checkpoints.digest(folder / checkpoints.DIGESTS)
        manifest.write_text(json.dumps(content))
        with pytest.raises(CheckpointError, match="is not what was written"):
            load_policy(run_dir)


@pytest.mark.parametrize("path", ["..", "components/..", "components/../..", "/etc", "components"])
def test_manifest_that_leads_elsewhere(run_dir, path):
    manifest = checkpoints.latest(run_dir) / "manifest.json"
    content = json.loads(manifest.read_text())
    content["components"]["policy"]["path"] = path
    manifest.write_text(json.dumps(content))
    with pytest.raises(CheckpointError, match=r"policy|Unsafe"):
        load_policy(run_dir)


def test_every_flipped_bit(run_dir, monkeypatch):
    """Of what a policy is read from: refused, or a bit that changes nothing."""
    expected = load_policy(run_dir).state_dict()
    manifest = checkpoints.latest(run_dir) / "manifest.json"
    folders = (components(run_dir)[name] for name in ("policy", "config"))
    files = [file for folder in folders for file in folder.rglob("*") if file.is_file()]
    policy = load_policy(run_dir)
    monkeypatch.setattr(saved_policies, "make_env", lambda *_, **__: None)
    monkeypatch.setattr(saved_policies, "make_policy", lambda *_: policy.requires_grad_(True))
    refused = 0
    for file in (manifest, *files):
        whole = file.read_bytes()
        for position in range(0, len(whole), 1 + len(whole) // 40):
            flipped = bytearray(whole)
            flipped[position] ^= 1 << position % 8
            file.write_bytes(flipped)
            try:
                read = load_policy(run_dir).state_dict()
            except CheckpointError:
                refused += 1
            else:
                assert file == manifest
                assert all(read[name].equal(expected[name]) for name in expected)
        file.write_bytes(whole)
    assert refused > 200


def test_policy_that_does_not_fit(run_dir, tmp_path):
    """Weights of another shape, and weights that are no numbers."""
    other = tmp_path / "other"
    tiny.launch(other, "collector.total_frames=100", "policy.num_cells=[9]")
    shutil.rmtree(components(run_dir)["policy"])
    shutil.copytree(components(other)["policy"], components(run_dir)["policy"])
    reseal(run_dir, "policy")
    with pytest.raises(CheckpointError, match="size mismatch"):
        load_policy(run_dir)
    weights = components(other)["policy"] / "state" / "tensor_00000000.memmap"
    weights.write_bytes(np.full(9 * 24, np.nan, np.float32).tobytes())
    reseal(other, "policy")
    with pytest.raises(CheckpointError, match="is not finite"):
        load_policy(other)


def change_config(run_dir: Path, **options: object) -> None:
    """The checkpoint's configuration with other options, sealed; dots in names are ``__``."""
    _, checkpoint = saved.load_run(run_dir)
    config = saved.Configuration()
    checkpoints.load_components(checkpoint, config=config)
    for name, value in options.items():
        *parents, last = name.split("__")
        entry = config.saved
        for parent in parents:
            entry = entry[parent]
        entry[last] = value
    state = SimpleNamespace(state_dict=lambda: config.saved)
    folder = components(run_dir)["config"]
    shutil.rmtree(folder)
    checkpoints.StateAdapter("config", {}).save(state, folder, args=(), kwargs={})
    reseal(run_dir, "config")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"env__robot": "${oc.env:SECRET}"}, "env.robot must be null or one of"),
        ({"${oc.env:SECRET}": 1}, "is not an option"),
        ({"method": "os:system"}, "method must be one of"),
        ({"env__robot": "\x1b[2J"}, "env.robot must be null or one of"),
        ({"\x1b[2J": 1}, "impossible key"),
        ({"unknown": 1}, "unknown is not an option"),
        ({"policy__num_cells": [10**9, 10**9]}, "must be of at most"),
        ({"policy__num_components": 10**9}, "must be at most"),
        ({"eval__num_steps": 10**12}, "at most"),
        ({"env": "point"}, "env must be a group of options"),
        ({"policy": None}, "policy must be a group of options"),
    ],
)
def test_configuration_that_asks_for_too_much(run_dir, monkeypatch, options, match):
    """As a checkpoint of somebody else may hold it, well sealed."""
    monkeypatch.setenv("SECRET", "hunter2")
    change_config(run_dir, **options)
    with pytest.raises(CheckpointError, match=match) as caught:
        load_policy(run_dir)
    assert "\x1b" not in str(caught.value)
    assert "hunter2" not in str(caught.value)


def test_code_that_a_configuration_names_is_not_imported(run_dir, tmp_path, monkeypatch):
    """Unless whoever looks says that it is trusted; another environment needs no trust."""
    marker = tmp_path / "marker"
    (tmp_path / "stranger.py").write_text(
        f"import pathlib\npathlib.Path({str(marker)!r}).touch()\n"
        "from torchrl_safe.envs import SafeGoalEnv\n"
        "def make(num_envs, seed):\n    return SafeGoalEnv('point', num_envs=num_envs, seed=seed)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    expected = load_policy(run_dir).state_dict()
    change_config(run_dir, env__name="stranger:make")
    looks = (
        load_policy,
        export.main,
        lambda run_dir: evaluate.main(run_dir, 1, 0, film=False),
        lambda run_dir: play.main(str(run_dir), 1),
    )
    for look in looks:
        with pytest.raises(UntrustedError, match=r"names code, env.name=stranger:make"):
            look(run_dir)
    ours = load_policy(run_dir, lambda num_envs: SafeGoalEnv("point", num_envs=num_envs))
    assert not marker.exists()
    theirs = load_policy(run_dir, trust=True)
    assert marker.exists()
    for policy in (ours, theirs):
        assert all(policy.state_dict()[name].equal(expected[name]) for name in expected)


def test_threads_are_those_of_this_machine(run_dir):
    change_config(run_dir, num_threads=10**6)
    options, _ = saved.load_run(run_dir)
    assert options.num_threads == os.cpu_count()


BOMB = "a0: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &{'abcdefghij'[i]} [{', '.join([f'*{chr(96 + i)}'] * 10)}]\n" for i in range(1, 10)
)


@pytest.mark.parametrize(
    "text",
    [
        BOMB,
        "a: &a [1]\nb: 2\n",
        "!!python/object/apply:os.system ['touch marker']\n",
        "run: !!python/object/apply:pathlib.Path.touch [marker]\n",
        "a: !!binary aGk=\n",
        "a: 1\na: 2\n",
        "[" * 10_000,
        "a: [\n",
        "- 1\n",
        "a: \x1b[2J\n",
        "",
    ],
)
def test_configuration_is_plain_yaml(tmp_path, monkeypatch, text):
    """Sealed by whoever wrote it; tried on what reads it, that is watch.py and a resumed run."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "config.yaml"
    seal = hashlib.sha256(text.encode()).hexdigest()
    path.write_text(f"{text}{saved.SEAL.decode()}{seal}\n")
    started = time.monotonic()
    with pytest.raises(CheckpointError, match=r"config\.yaml (is no plain|holds no)") as caught:
        saved.read_config(path)
    assert time.monotonic() - started < 60
    assert "\x1b" not in str(caught.value)
    assert not (tmp_path / "marker").exists()


def test_configuration_is_sealed(run_dir, tmp_path):
    """Whatever bit of it flips; and a policy does not depend on it, its checkpoint has its own."""
    path = run_dir / "config.yaml"
    whole = path.read_bytes()
    expected = load_policy(run_dir).state_dict()
    for position in range(len(whole) - 1):
        flipped = bytearray(whole)
        flipped[position] ^= 1 << position % 8
        path.write_bytes(flipped)
        with pytest.raises(CheckpointError, match=f"{path} is not what was written"):
            saved.read_config(path)
    path.write_bytes(payload(tmp_path / "marker"))
    read = load_policy(run_dir).state_dict()
    assert all(read[name].equal(expected[name]) for name in expected)
    assert not (tmp_path / "marker").exists()


@pytest.mark.parametrize(
    "options",
    [
        {"run_dir": "Läufe/実験"},
        {"run_dir": "2024-01-01"},
        {"a": [1e-5, 1e20, 3, True, None, "1e3"]},
    ],
)
def test_configuration_comes_back(tmp_path, options):
    saved.write_config(tmp_path / "config.yaml", SimpleNamespace(settings=lambda: options))
    assert saved.read_config(tmp_path / "config.yaml") == options


def test_broken_manifest_ends_a_resumption(run_dir, tmp_path):
    marker = tmp_path / "marker"
    (checkpoints.latest(run_dir) / "manifest.json").write_bytes(payload(marker))
    with pytest.raises(CheckpointError, match=r"the manifest of .*checkpoint-000000000200"):
        load_policy(run_dir)
    with pytest.raises(CheckpointError, match="the manifest of"):
        tiny.launch(run_dir, "resume=true", "collector.total_frames=300")
    assert not marker.exists()


class TestNothingIsWrittenOutside:
    """Links lie where the commands write."""

    @pytest.fixture
    def precious(self, tmp_path):
        path = tmp_path / "precious"
        path.write_text("precious")
        yield path
        assert path.read_text() == "precious"

    def test_watch(self, run_dir, precious):
        (run_dir / "curves.png").unlink()
        (run_dir / "curves.png").symlink_to(precious)
        watch.look(run_dir)
        assert not (run_dir / "curves.png").is_symlink()

    @pytest.mark.parametrize("suffix", [".pt2", ".onnx"])
    def test_export(self, run_dir, precious, suffix):
        (run_dir / f"policy{suffix}").symlink_to(precious)
        path = export.main(run_dir, onnx=suffix == ".onnx")
        assert not path.is_symlink()

    def test_evaluate(self, run_dir, precious):
        out = run_dir / "evaluation"
        out.mkdir()
        for name in ("results.json", "trajectories.png", "calibration.png"):
            (out / name).symlink_to(precious)
        evaluate.main(run_dir, 1, 0, film=False)
        assert not (out / "results.json").is_symlink()

    def test_evaluate_into_a_linked_folder(self, run_dir, precious):
        for target in (precious.parent, precious.parent / "new"):
            (run_dir / "evaluation").symlink_to(target)
            with pytest.raises(ValueError, match="evaluation must be a folder, and is a link"):
                evaluate.main(run_dir, 1, 0, film=False)
            (run_dir / "evaluation").unlink()
        assert not (precious.parent / "new").exists()

    def test_drafts(self, run_dir, precious, monkeypatch):
        """A link of the very name of a draft is an error, not a way."""
        monkeypatch.setattr(_files.secrets, "token_hex", lambda _: "known")
        (run_dir / ".draft-known-curves.png").symlink_to(precious)
        with pytest.raises(FileExistsError):
            watch.look(run_dir)

    @pytest.mark.parametrize("name", ["log", "log/scalars", "log/scalars/train/cv_rate.csv"])
    def test_resume_with_a_linked_log(self, run_dir, precious, name):
        path = run_dir / name
        target = precious if path.is_file() else precious.parent / "folder"
        if target != precious:
            target.mkdir()
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        path.symlink_to(target)
        with pytest.raises(ValueError, match="and is a link"):
            tiny.launch(run_dir, "resume=true", "collector.total_frames=300")
        assert target == precious or not list(target.iterdir())

    def test_leftovers_behind_links(self, run_dir, precious):
        """What a kill left is deleted, what a link of such a name points to is not."""
        folder = precious.parent / "folder"
        folder.mkdir()
        (folder / "kept").touch()
        checkpoints_ = run_dir / "checkpoints"
        (checkpoints_ / ".checkpoint-1").symlink_to(folder)
        (run_dir / ".draft-1-curves.png").symlink_to(precious)
        (run_dir / ".draft-2-video.mp4").write_bytes(b"half")
        checkpoints.remove_leftovers(run_dir)
        assert not list(run_dir.glob(".draft*"))
        assert [path.name for path in checkpoints_.iterdir()] == ["checkpoint-000000000200"]
        shutil.move(checkpoints_, precious.parent / "elsewhere")
        (precious.parent / "elsewhere" / ".checkpoint-1").mkdir()
        checkpoints_.symlink_to(precious.parent / "elsewhere")
        with pytest.raises(ValueError, match="checkpoints must be a folder, and is a link"):
            checkpoints.remove_leftovers(run_dir)
        assert (precious.parent / "elsewhere" / ".checkpoint-1").exists()
        assert (folder / "kept").exists()


ESCAPE = "\x1b]0;owned\x07\x1b[2J\nframes  9,999 of x\u202e"


def test_names_are_printed_escaped(run_dir, tmp_path, capsys):
    """In tables, lines and errors: no title is set, no screen cleared, no line forged."""
    (run_dir / "log" / "scalars" / f"{ESCAPE}.csv").write_text("100,1\n")
    (run_dir / "log" / "scalars" / "frames.csv").write_text("1,7\n")
    odd = tmp_path / ESCAPE
    run_dir.rename(odd)
    watch.main(odd, every=1.0, once=True)
    export.main(odd, onnx=False)
    evaluate.main(odd, 1, 0, film=False)
    out = capsys.readouterr().out
    assert "\\x1b]0;owned\\x07" in out
    (components(odd)["policy"] / ESCAPE).touch()
    messages = []
    for call in (
        lambda: load_policy(odd),
        lambda: load_policy(tmp_path / "missing" / ESCAPE),
        lambda: watch.main(tmp_path / ESCAPE / "missing", every=1.0, once=True),
        lambda: run_exported.load(odd / "missing.onnx"),
    ):
        with pytest.raises((CheckpointError, OSError)) as caught:
            call()
        messages.append(str(caught.value))
    for text in (out, *messages):
        assert not set(text) & set("\x1b\x07\u202e")
        assert "\nframes  9,999" not in text
    assert len([line for line in out.splitlines() if line.startswith("frames ")]) == 1


def test_onnx_policy_runs_no_code(tmp_path):
    """The format for files from elsewhere; a .pt2 is a program, as docs/runs.md says."""
    marker, file = tmp_path / "marker", tmp_path / "policy.onnx"
    for protocol in (0, 2, 4):
        file.write_bytes(payload(marker, protocol))
        with pytest.raises(Exception, match="INVALID_PROTOBUF"):
            run_exported.load(file)
    assert not marker.exists()


# A process that may talk to itself alone: every other connection and look-up is an error.
GUARD = """
import sys

def guard(event, args):
    if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
        if not isinstance(args[1], (str, bytes)):
            raise RuntimeError(f"network: {event} {args[1]}")
    if event in ("socket.getaddrinfo", "socket.gethostbyname", "urllib.Request"):
        raise RuntimeError(f"network: {event} {args}")
    if event in ("os.system", "pty.spawn") or (
        event == "subprocess.Popen" and args[0] and "sh" in str(args[0]).rsplit("/")[-1:]
    ):
        raise RuntimeError(f"shell: {event} {args}")

sys.addaudithook(guard)
"""


def python(code: str, **kwargs) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(Path(__file__).parent), str(REPOSITORY)])
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env=os.environ | {"PYTHONPATH": path} | kwargs.pop("env", {}),
        **kwargs,
    )


def test_guard_guards():
    code = "import socket; socket.create_connection(('127.0.0.1', 9))"
    assert "RuntimeError: network" in python(GUARD + code).stderr
    assert "RuntimeError: shell" in python(GUARD + "import os; os.system('true')").stderr


def test_no_network_and_no_shell(tmp_path):
    """Import and a training run; a folder and a project named by someone who expects a shell."""
    code = (
        "import torchrl_safe, torchrl_safe.envs, torchrl_safe.record, tiny, pathlib\n"
        "tiny.launch(pathlib.Path(\"'run;touch injected;$(touch injected)'\"),"
        " 'collector.total_frames=100',"
        " \"logger.project_name='$(touch injected);touch injected'\")\n"
    )
    result = python(GUARD + code, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run;touch injected;$(touch injected)"]


def test_wandb_sends_nothing_unless_asked(tmp_path):
    """With a server and a key in the environment; wandb's own process would use them."""
    server = socket.create_server(("127.0.0.1", 0))
    connections = []

    def accept():
        with contextlib.suppress(OSError):
            while True:
                with server.accept()[0] as connection:
                    connections.append(connection.recv(2**16))
                    # Left without an answer, wandb's process may not end.
                    connection.sendall(b"HTTP/1.1 401 No\r\nContent-Length: 0\r\n\r\n")

    thread = threading.Thread(target=accept, daemon=True)
    thread.start()
    env = {
        "WANDB_BASE_URL": f"http://127.0.0.1:{server.getsockname()[1]}",
        "WANDB_API_KEY": "0" * 40,
        "HOME": str(tmp_path),
    }
    code = (
        "import tiny, pathlib\n"
        "tiny.launch(pathlib.Path('run'), 'collector.total_frames=100', 'logger.backend=wandb')\n"
    )
    result = python(code, cwd=tmp_path, env=env)
    assert result.returncode == 0, result.stderr
    assert list(tmp_path.rglob("offline-run-*"))
    assert not connections
    # That this would have been seen: asked to send, it knocks.
    online = "import wandb; wandb.login(verify=True, timeout=5)"
    python(online, cwd=tmp_path, env=env | {"WANDB_MODE": "online"})
    assert connections
    server.shutdown(socket.SHUT_RDWR)
    server.close()
    thread.join(10)


@pytest.mark.parametrize("folder", ["torchrl_safe", "examples"])
def test_source_has_no_way_to_run_strings(folder):
    """No pickle, no unguarded torch.load, no eval or exec, no shell, no network.

    Modules are imported by name for names that have moved, which are constants, and in one place
    that asks first.
    """
    modules = {"pickle", "cloudpickle", "shelve", "marshal", "subprocess", "socket", "urllib"}
    modules |= {"requests", "http", "importlib.import_module"}
    for path in (REPOSITORY / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names = {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
            else:
                names = set()
            top = REPOSITORY / "torchrl_safe" / "__init__.py"  # its own packages, when asked for
            if path == top or path.name in ("environments.py", "_deprecation.py"):
                names -= {"importlib.import_module"}
            # One starts the interpreter that its caller names, the other asks git for a commit.
            if path.name in ("bridge.py", "surroundings.py"):
                names -= {"subprocess"}
                assert "shell=" not in ast.unparse(node)
            assert not names & modules, f"{path}:{node.lineno}"
            if isinstance(node, ast.Call):
                call = ast.unparse(node.func)
                assert call not in ("eval", "exec", "os.system", "os.popen"), (
                    f"{path}:{node.lineno}"
                )
                if call == "torch.load":
                    assert "weights_only=True" in ast.unparse(node), f"{path}:{node.lineno}"
