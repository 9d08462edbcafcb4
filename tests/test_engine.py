"""The pool with stages made for the test: what a worker's death, a full disk or a fault leave behind."""

import errno
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

from dataset.receipts import ReceiptLog, host_name, read_receipts
from labeling.errors import ConfigError, VideoError
from pipelines import stage as stage_module
from pipelines.engine import Engine, minding_workers
from pipelines.items import Task, perform, sweep_staging
from pipelines.stage import DroppedError, WorkItem, item_state


class ToyStage:
    """Writes its text; ``settings['do']`` says what goes wrong."""

    name = "toy"

    def plan(self, job):
        """No job here."""
        return []

    def work(self, root: Path, item: WorkItem, staging: Path):
        """Do as told."""
        action = item.settings.get("do")
        if action == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if action == "die once" and not (root / "died").exists():
            (root / "died").write_text("x")
            os.kill(os.getpid(), signal.SIGKILL)
        if action == "drop":
            raise DroppedError("hole=3 frames from 1.000 s")
        if action == "fail":
            raise VideoError(f"{item.name}: is no video")
        if action == "fault":
            raise ValueError("a bug")
        if action == "quota":
            raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT), str(staging / "x"))
        if action == "full":
            raise OSError(28, "No space left on device", str(staging / "x"))
        if action == "slow":
            (root / f"started-{item.name}").write_text("x")
            time.sleep(60)
        if action != "nothing":
            for output in item.outputs:
                (staging / Path(output).name).write_text(f"{item.name} {item.settings.get('text', '')}")
        return {"length": len(item.name)}


@pytest.fixture(autouse=True)
def toy(monkeypatch):
    """Registers the stage, here and in workers (which find it on ``PYTHONPATH``)."""
    folder = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [folder, os.environ.get("PYTHONPATH", "")])))
    monkeypatch.setenv("ANIMATIC_EXTRA_STAGES", "toy=test_engine:ToyStage")
    stage_module.load_stage.cache_clear()
    yield
    stage_module.load_stage.cache_clear()


def item(name="a", **settings):
    return WorkItem(
        stage="toy", name=name, owner=name, version=1, settings=settings, inputs={"x": 1},
        outputs=(f"out/{name}.txt", f"out/{name}.more"),
    )  # fmt: skip


def run(root, items, *, workers=0, previous=None):
    with Engine(root, workers=workers) as engine:
        tasks = [Task(item=one, previous=(previous or {}).get(one.name)) for one in items]
        return {receipt.item: receipt for receipt in engine.run(tasks)}


def test_an_item_that_is_done_has_its_outputs_and_a_receipt_that_fits(tmp_path):
    receipt = run(tmp_path, [item(text="hello")])["a"]
    assert (tmp_path / "out/a.txt").read_text() == "a hello"
    assert receipt == read_receipts(tmp_path, "toy")["a"]
    assert receipt.state == "done" and receipt.facts == {"length": 1} and len(receipt.outputs) == 2
    assert item_state(item(text="hello"), receipt, tmp_path) == "current"
    assert not (tmp_path / ".staging").exists()


@pytest.mark.parametrize(
    "changes", [{"settings": {"text": "other"}}, {"inputs": {"x": 2}}, {"models": {"m": "1"}}, {"version": 2}], ids=str
)
def test_whatever_the_outputs_depend_on_makes_a_receipt_stale(tmp_path, changes):
    from dataclasses import replace

    receipt = run(tmp_path, [item()])["a"]
    assert item_state(replace(item(), **changes), receipt, tmp_path) == "stale"
    assert item_state(replace(item(), payload={"path": "/elsewhere"}, weight=9.0), receipt, tmp_path) == "current"


@pytest.mark.parametrize(
    ("action", "state", "reason", "retryable"),
    [
        ("drop", "dropped", "hole=3 frames from 1.000 s", False),
        ("fail", "failed", "video", False),
        ("fault", "failed", "fault", True),
        ("full", "failed", "storage", True),
        ("nothing", "failed", "data", False),
    ],
)
def test_what_goes_wrong_is_in_the_receipt(tmp_path, action, state, reason, retryable):
    receipt = run(tmp_path, [item(do=action)])["a"]
    assert (receipt.state, receipt.reason, receipt.retryable) == (state, reason, retryable)
    assert not (tmp_path / "out").exists() and receipt.outputs == ()
    expected = "retry" if retryable else "current"
    assert item_state(item(do=action), read_receipts(tmp_path, "toy")["a"], tmp_path) == expected


@pytest.mark.parametrize("action", ["full", "quota"])
def test_a_full_disk_stops_the_stage(tmp_path, action):
    made = run(tmp_path, [item("a"), item("b", do=action), item("c")])
    assert [made[name].state for name in made] == ["done", "failed"]
    assert "free some space" in made["b"].message


def test_a_worker_that_dies_does_not_take_the_others_along(tmp_path):
    items = [item("a"), item("b", do="die"), item("c"), item("d", do="die once"), item("e", do="fault")]
    made = run(tmp_path, items, workers=2)
    assert {name: made[name].state for name in sorted(made)} == {
        "a": "done", "b": "failed", "c": "done", "d": "done", "e": "failed"
    }  # fmt: skip
    assert (made["b"].reason, made["b"].retryable) == ("died", True) and "SIGKILL" in made["b"].message
    assert read_receipts(tmp_path, "toy") == dict(sorted(made.items()))


def test_the_old_receipt_is_withdrawn_before_its_outputs_are_replaced(tmp_path, monkeypatch):
    from pipelines import items

    first = run(tmp_path, [item(text="one")])
    publish = items.publish

    def killed(staging, job, names):
        publish(staging, job, names[:1])
        raise KeyboardInterrupt

    monkeypatch.setattr(items, "publish", killed)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, [item(text="two")], previous=first)
    monkeypatch.undo()
    held = read_receipts(tmp_path, "toy")["a"]
    # Half of the files are new: neither the old settings nor the new ones may pass for done.
    assert (held.state, held.reason, held.retryable) == ("failed", "interrupted", True)
    assert item_state(item(text="one"), held, tmp_path) == "stale"
    assert item_state(item(text="two"), held, tmp_path) == "retry"


def test_a_redone_item_counts_its_turns(tmp_path):
    first = run(tmp_path, [item(text="one")])
    second = run(tmp_path, [item(text="two")], previous=first)
    assert first["a"].turn == 1 and second["a"].turn > 1
    assert read_receipts(tmp_path, "toy")["a"] == second["a"]


def test_receipts_agree_but_for_seconds(tmp_path):
    logs = []
    for name in ("one", "two"):
        perform(tmp_path / name, Task(item=item(text="t")), ReceiptLog(tmp_path / name, "toy"))
        logs.append(read_receipts(tmp_path / name, "toy")["a"])
    assert {**_fields(logs[0]), "seconds": 0} == {**_fields(logs[1]), "seconds": 0}


def _fields(receipt):
    from dataclasses import asdict

    return asdict(receipt)


def test_workers_die_with_their_parent(tmp_path):
    code = (
        "import sys; from pathlib import Path\n"
        "from pipelines.engine import Engine; from test_engine import Task, item\n"
        "if __name__ == '__main__':\n"
        "    with Engine(Path(sys.argv[1]), workers=1) as engine:\n"
        "        list(engine.run([Task(item=item('a', do='slow'))]))\n"
    )
    script = tmp_path / "parent.py"
    script.write_text(code)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    parent = subprocess.Popen([sys.executable, str(script), str(tmp_path)], env=environment)
    try:
        staging = _wait_for(lambda: list((tmp_path / ".staging").glob("toy.a.*")), parent)[0]
        worker = int(staging.name.rpartition("-")[2])
        _wait_for(lambda: (tmp_path / "started-a").exists(), parent)
    finally:
        parent.kill()
        parent.wait()
    _wait_for(lambda: not _running(worker))
    sweep_staging(tmp_path)
    assert not (tmp_path / ".staging").exists()
    assert read_receipts(tmp_path, "toy") == {}


def _wait_for(condition, process=None):
    for _ in range(1200):
        if found := condition():
            return found
        assert process is None or process.poll() is None
        time.sleep(0.05)
    raise AssertionError("waited for a minute")


def _running(process):
    try:
        return "State:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except OSError:
        return False


def test_staging_of_a_process_that_lives_is_left_alone(tmp_path):
    from dataset.receipts import host_name

    mine = tmp_path / ".staging" / f"toy.a.{host_name()}-{os.getpid()}"
    other = tmp_path / ".staging" / "toy.b.elsewhere-1"
    for folder in (mine, other):
        folder.mkdir(parents=True)
    sweep_staging(tmp_path)
    assert mine.is_dir() and other.is_dir()


def test_a_killed_worker_of_a_pool_is_an_error_that_advises() -> None:
    context = get_context("spawn")
    with (
        pytest.raises(ConfigError, match="a worker died.*fewer --workers.*what is done is kept"),
        minding_workers(), ProcessPoolExecutor(1, mp_context=context) as pool,
    ):  # fmt: skip
        list(pool.map(signal.raise_signal, [signal.SIGKILL]))


@pytest.mark.parametrize("process", ["abc", "", "1e3", "9" * 30, "²"], ids=ascii)
def test_a_folder_that_no_worker_could_have_made_stays(tmp_path, process):
    folder = tmp_path / ".staging" / f"x.{host_name()}-{process}"
    folder.mkdir(parents=True)
    sweep_staging(tmp_path)
    assert folder.is_dir()
