"""What is loaded runs no code, nothing is sent, and no string reaches a shell."""

from __future__ import annotations

import ast
import contextlib
import json
import os
import pickle
import shutil
import socket
import subprocess
import sys
import threading
from pathlib import Path

import checkpoints
import pytest
import run_exported
import tiny
import utils
import yaml
from torchrl.checkpoint import CheckpointError

REPOSITORY = Path(__file__).parents[2]


class Run(utils.Run):
    """Remembers what a script made."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        Run.last = self


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A finished run; what loads its checkpoint is in ``Run.last``."""
    run_dir = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny.safetac_point, "Run", Run)
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
                sealed = (folder / checkpoints.DIGESTS).read_bytes()
                checkpoints.seal(folder)
                with contextlib.suppress(CheckpointError):  # bytes in place of numbers may load
                    load(run_dir, name)
                (folder / checkpoints.DIGESTS).write_bytes(sealed)
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
        for seal in (False, True):
            if seal:
                checkpoints.seal(folder)
            with pytest.raises(CheckpointError, match="may run code when it is read"):
                load(run_dir, component)
    assert not marker.exists()


def test_metadata_that_asks_for_a_pickle(run_dir, tmp_path):
    """A memory-mapped folder may call itself a container of arbitrary objects."""
    marker, elsewhere = tmp_path / "marker", tmp_path / "elsewhere"
    for linked in (False, True):
        folder = components(run_dir)["policy"]
        state = folder / "state"
        if linked:
            shutil.move(state, elsewhere)
            state.symlink_to(elsewhere)
        meta = {"_type": "<class 'tensordict.tensorclass.NonTensorData'>", "_metadata": None}
        (state / "meta.json").write_text(json.dumps(meta))
        (state / "other.pickle").write_bytes(payload(marker))
        if not linked:
            checkpoints.seal(folder)
        with pytest.raises(CheckpointError, match="may run code"):
            utils.load_policy(run_dir)
    assert not marker.exists()


def test_manifest_and_configuration(run_dir, tmp_path):
    marker = tmp_path / "marker"
    config = (run_dir / "config.yaml").read_text()
    for text in (
        f"!!python/object/apply:os.system ['touch {marker}']",
        f"run: !!python/object/apply:pathlib.Path.touch [{marker}]",
    ):
        (run_dir / "config.yaml").write_text(text)
        with pytest.raises(yaml.constructor.ConstructorError, match="python/object"):
            utils.load_policy(run_dir)
    (run_dir / "config.yaml").write_bytes(payload(marker))
    with pytest.raises((yaml.YAMLError, UnicodeDecodeError)):
        utils.load_policy(run_dir)
    (run_dir / "config.yaml").write_text(config)
    (checkpoints.latest(run_dir) / "manifest.json").write_bytes(payload(marker))
    with pytest.raises(CheckpointError, match=r"the manifest of .*checkpoint-000000000200"):
        utils.load_policy(run_dir)
    with pytest.raises(CheckpointError, match="the manifest of"):
        tiny.launch(run_dir, "resume=true", "collector.total_frames=300")
    assert not marker.exists()


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
    path = os.pathsep.join([str(tiny.EXAMPLES), str(Path(__file__).parent), str(REPOSITORY)])
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
    """No pickle, no unguarded torch.load, no eval or exec, no shell, no network."""
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
            assert not names & modules, f"{path}:{node.lineno}"
            if isinstance(node, ast.Call):
                call = ast.unparse(node.func)
                assert call not in ("eval", "exec", "os.system", "os.popen"), (
                    f"{path}:{node.lineno}"
                )
                if call == "torch.load":
                    assert "weights_only=True" in ast.unparse(node), f"{path}:{node.lineno}"
