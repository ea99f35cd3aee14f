from __future__ import annotations

import logging
import os
import subprocess

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, exploration_type

from torchrl_safe.record import record_video


class FilmedEnv(EnvBase):
    """Counts its steps and paints the count as the grey of the picture."""

    def __init__(self, length: int = 1_000, num_envs: int = 2) -> None:
        super().__init__(batch_size=[num_envs])
        shape = (num_envs, 1)
        done = Binary(1, shape=shape, dtype=torch.bool)
        self.observation_spec = Composite(time=Unbounded(shape), shape=self.batch_size)
        self.action_spec = Unbounded(shape)
        self.reward_spec = Unbounded(shape)
        self.full_done_spec = Composite(
            done=done, terminated=done.clone(), truncated=done.clone(), shape=self.batch_size
        )
        # Environment n ends after `length + n` steps.
        self.length = length + torch.arange(num_envs)[:, None]
        self.modes: list[object] = []
        self.failure: tuple[int, Exception] | None = None
        self.frame_type = np.uint8

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        start = torch.zeros(*self.batch_size, 1)
        self.time = start if mask is None else self.time.masked_fill(mask, 0)
        no = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict(
            {"time": self.time, "done": no, "terminated": no.clone(), "truncated": no.clone()},
            batch_size=self.batch_size,
        )

    def _step(self, tensordict):
        self.modes.append(exploration_type())
        self.time = self.time + 1
        end = self.time >= self.length
        return TensorDict(
            {
                "time": self.time,
                "reward": torch.zeros(*self.batch_size, 1),
                "done": end,
                "terminated": torch.zeros_like(end),
                "truncated": end.clone(),
            },
            batch_size=self.batch_size,
        )

    def _set_seed(self, seed):
        pass

    def render(self, *, index, width, height):
        time = int(self.time[index])
        if self.failure is not None and time >= self.failure[0]:
            raise self.failure[1]
        return np.full((height, width, 3), 20 + 10 * time, self.frame_type)


def policy(td):
    return td.set("action", torch.zeros(*td.batch_size, 1))


def ffmpeg(*arguments):
    return subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *arguments], capture_output=True)


def greys(path, width, height):
    """Mean grey of every frame, after checking that they are grey."""
    raw = ffmpeg("-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-").stdout
    frames = np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3).astype(float)
    assert all(frame.std() < 3 for frame in frames)
    return [float(frame.mean()) for frame in frames]


@pytest.mark.parametrize(
    ("length", "num_steps", "every", "index", "filmed"),
    [
        (1_000, 10, 1, 0, range(10)),
        (1_000, 10, 3, 0, [0, 3, 6, 9]),
        (1_000, 1, 5, 0, [0]),
        # The filmed environment's episode ends: the next one's frames do not belong here.
        (6, 100, 1, 0, range(6)),
        (6, 100, 1, 1, range(7)),
        (6, 100, 4, 1, [0, 4]),
    ],
)
def test_frames(tmp_path, caplog, length, num_steps, every, index, filmed):
    path = record_video(
        FilmedEnv(length),
        policy,
        tmp_path / "new/clip.mp4",
        num_steps=num_steps,
        every=every,
        fps=20,
        width=66,
        height=50,
        index=index,
    )
    assert path == tmp_path / "new/clip.mp4"
    assert os.listdir(path.parent) == ["clip.mp4"]
    assert greys(path, 66, 50) == pytest.approx([20 + 10 * t for t in filmed], abs=3)
    about = ffmpeg("-i", path).stderr.decode()
    assert " 66x50" in about
    assert " 20 fps" in about
    assert f"Duration: 00:00:{len(filmed) / 20:05.2f}" in about
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


def test_browsers_play_it(tmp_path):
    path = record_video(FilmedEnv(), policy, tmp_path / "a.mp4", num_steps=4, width=64, height=64)
    about = ffmpeg("-i", path).stderr.decode()
    assert "h264" in about
    assert "yuv420p" in about
    # The index comes before the data: it plays while it loads.
    data = path.read_bytes()
    assert 0 < data.find(b"moov") < data.find(b"mdat")


def test_exploration_type_and_random_state(tmp_path):
    env = TransformedEnv(FilmedEnv())
    before = torch.get_rng_state()

    def noisy(td):
        return td.set("action", torch.randn(*td.batch_size, 1))

    for mode in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        record_video(
            env, noisy, tmp_path / "a.mp4", num_steps=1, width=16, height=16, exploration_type=mode
        )
    assert env.modes == [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC]
    assert torch.equal(before, torch.get_rng_state())


def test_seed_is_the_environments_and_the_actions(tmp_path):
    class Seeded(FilmedEnv):
        def _set_seed(self, seed):
            self.seeds = [*getattr(self, "seeds", []), seed]

    env, actions = Seeded(), []
    before = torch.get_rng_state()

    def noisy(td):
        actions.append(torch.randn(*td.batch_size, 1))
        return td.set("action", actions[-1])

    for seed in (3, 3, 4):
        record_video(env, noisy, tmp_path / "a.mp4", num_steps=1, width=16, height=16, seed=seed)
    assert env.seeds == [3, 3, 4]
    assert actions[0].equal(actions[1])
    assert not actions[0].equal(actions[2])
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("fails_at", [0, 3])
def test_failing_render_leaves_no_file_and_no_process(tmp_path, monkeypatch, fails_at):
    writers = []
    get_writer = imageio.get_writer
    monkeypatch.setattr(
        imageio, "get_writer", lambda *a, **k: writers.append(get_writer(*a, **k)) or writers[-1]
    )
    env = FilmedEnv()
    env.failure = fails_at, OSError("no OpenGL context")
    with pytest.raises(RuntimeError, match=r"could not render.*no OpenGL context") as caught:
        record_video(env, policy, tmp_path / "a.mp4", num_steps=9, width=16, height=16)
    assert isinstance(caught.value.__cause__, OSError)
    assert [writer.closed for writer in writers] == [True]
    assert os.listdir(tmp_path) == []


def test_failure_keeps_the_old_video(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"old")

    def broken(td):
        if td["time"].max() >= 2:
            raise ZeroDivisionError
        return policy(td)

    with pytest.raises(ZeroDivisionError):
        record_video(FilmedEnv(), broken, tmp_path / "a.mp4", width=16, height=16)
    assert os.listdir(tmp_path) == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"old"


def test_wrong_pictures_are_reported(tmp_path):
    env = FilmedEnv()
    env.frame_type = np.float32
    with pytest.raises(RuntimeError, match=r"could not render.*got float32"):
        record_video(env, policy, tmp_path / "a.mp4", width=16, height=16)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"num_steps": 0}, "num_steps must be positive, got 0"),
        ({"every": 0}, "every must be positive"),
        ({"fps": float("nan")}, "fps must be positive, got nan"),
        ({"width": 33}, "width must be a positive even number.*33"),
        ({"height": 0}, "height must be a positive even number.*0"),
        ({"index": 2}, r"index must be in \[0, 2\), got 2"),
        ({"index": -1}, r"index must be in \[0, 2\), got -1"),
        ({"path": "clip.gif"}, "path must end in .mp4, got 'clip.gif'"),
    ],
)
def test_rejects(tmp_path, bad, message):
    env = FilmedEnv()
    with pytest.raises(ValueError, match=message):
        record_video(env, policy, **({"path": tmp_path / "a.mp4"} | bad))
    assert env.modes == []
    assert os.listdir(tmp_path) == []


def test_grid(tmp_path):
    """Three environments, which end after 3, 4 and 5 steps, in a square with a white corner."""
    path = record_video(
        FilmedEnv(length=3, num_envs=3),
        policy,
        tmp_path / "grid.mp4",
        num_steps=10,
        every=1,
        width=64,
        height=48,
        index=[0, 1, 2],
    )
    raw = ffmpeg("-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-").stdout
    frames = np.frombuffer(raw, np.uint8).reshape(-1, 96, 128, 3).astype(int)
    assert len(frames) == 5
    for time, frame in enumerate(frames):
        tiles = frame[24, 32], frame[24, 96], frame[72, 32], frame[72, 96]
        expected = [20 + 10 * min(time, 2 + number) for number in range(3)] + [255]
        for tile, grey in zip(tiles, expected, strict=True):
            assert np.abs(tile - grey).max() <= 4  # compression


@pytest.mark.parametrize("num_envs", [None, 3])
def test_environments_that_draw_as_gymnasium_does(tmp_path, num_envs):
    """Pictures 12 wide and 6 high in tiles of 64 by 64: 32 high, in the middle, white around."""

    class Drawn(FilmedEnv):
        def render(self):
            pictures = [np.full((6, 12, 3), 60 + 40 * n, np.uint8) for n in range(num_envs or 1)]
            return pictures if num_envs else pictures[0]

    env = Drawn(num_envs=num_envs or 1)
    index = [2, 0] if num_envs else [0]
    path = record_video(
        env, policy, tmp_path / "a.mp4", num_steps=4, width=64, height=64, index=index
    )
    raw = ffmpeg("-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-").stdout
    frame = np.frombuffer(raw, np.uint8).reshape(2, 64, 64 * len(index), 3)[0].astype(int)
    for tile, number in enumerate(index):
        column = frame[:, 64 * tile + 32, 0]
        assert np.abs(column[20:44] - (60 + 40 * number)).max() <= 8  # compression
        assert column[[0, 8, 55, 63]].min() >= 245


@pytest.mark.parametrize("index", [[], [0, 2]])
def test_grid_of_impossible_environments(tmp_path, index):
    with pytest.raises(ValueError, match="index must"):
        record_video(FilmedEnv(), policy, tmp_path / "grid.mp4", index=index)
