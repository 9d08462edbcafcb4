"""What a training leaves to others: two in one folder, kills between two writes, records that were damaged."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from training_fixtures import in_children, one_thread, tiny_config, tiny_job  # noqa: F401

from labeling.errors import ConfigError, StorageError
from training.checkpoints import list_checkpoints, newest_checkpoint, save_checkpoint
from training.run_log import read_metrics
from training.trainer import train


def refusal(call: Callable[[], Any]) -> str:
    with pytest.raises(ConfigError) as error:
        call()
    return str(error.value)


def test_two_trainings_do_not_share_a_folder(tiny_job: Path, tmp_path: Path) -> None:  # noqa: F811
    """The second is refused at once; the first ends as if it had been alone."""
    config, told = tiny_config("motion", checkpoint={"every_steps": 1}), []

    def second(_: int) -> str:
        return refusal(lambda: train(config, data=tiny_job, out=tmp_path, quiet=True))

    def on_step(step: int, _: float) -> None:
        if step == 2:
            told.extend(in_children(1, second))

    train(config, data=tiny_job, out=tmp_path, quiet=True, on_step=on_step)
    assert told == [f"{tmp_path} is in use: {told[0].split(': ')[1].split(' trains')[0]} trains there; let it end, or "
                    "give another --out"]  # fmt: skip
    assert f"process {os.getpid()} on " in told[0]
    assert [line["step"] for line in read_metrics(tmp_path)] == [1, 2, 3, 4]
    assert newest_checkpoint(tmp_path / "checkpoints") == tmp_path / "checkpoints" / "step_00000004"
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_the_mark_of_a_killed_training_keeps_nobody_out(tmp_path: Path) -> None:
    from training.claims import Claim

    def killed(_: int) -> None:
        Claim(tmp_path)
        os.kill(os.getpid(), 9)

    assert in_children(1, killed) == [None]
    assert list(tmp_path.iterdir()), "it left its mark"
    Claim(tmp_path).release()
    assert not list(tmp_path.iterdir())


def test_a_folder_made_for_a_claim_goes_with_it(tmp_path: Path) -> None:
    from training.claims import Claim

    out = tmp_path / "a" / "b"
    for wrote in (False, True):
        claim = Claim(out)
        if wrote:
            (out / "metrics.jsonl").write_text("")
        claim.release()
        assert out.exists() == (tmp_path / "a").exists() == wrote
    assert [path.name for path in out.iterdir()] == ["metrics.jsonl"]


def test_saving_sweeps_what_the_dead_left_and_nothing_of_the_living(tmp_path: Path) -> None:
    from dataset.receipts import host_name

    (dead,) = in_children(1, lambda _: os.getpid())
    names = {
        "dead": f".step_00000007.{host_name()}-{dead}", "living": f".step_00000007.{host_name()}-{os.getppid()}",
        "elsewhere": f".step_00000007.other-host-{dead}", "older version": ".step_00000007.123",
    }  # fmt: skip
    for name in names.values():
        (tmp_path / name).mkdir()
    save_checkpoint(tmp_path, 8, {"a": b"x"}, keep=1)
    left = {kind for kind, name in names.items() if (tmp_path / name).exists()}
    assert left == {"living", "elsewhere"}


def test_a_staging_folder_that_vanishes_is_a_storage_error(tmp_path: Path, monkeypatch) -> None:
    import shutil

    from training import checkpoints

    digest = checkpoints._digest
    monkeypatch.setattr(checkpoints, "_digest", lambda path: (digest(path), shutil.rmtree(path.parent))[0])
    with pytest.raises(StorageError, match="taken away while a checkpoint was written"):
        save_checkpoint(tmp_path, 1, {"a": b"x"}, keep=1)
    assert list_checkpoints(tmp_path) == []
