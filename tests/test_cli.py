"""The command line: what a person types, and the one line that they get back for what they can mend."""

import ast
import json
import re
import shlex
import shutil
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest
import yaml
from pipeline_fixtures import SMALL, write_detector, write_street
from safetensors.numpy import save_file

from pipelines.cli import main
from pipelines.cli_options import listed
from pipelines.next_training import next_training
from training.adapter_notes import OUR_METADATA


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    return write_street(tmp_path_factory.mktemp("v") / "street.mp4", frames=24)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("c") / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return path


@pytest.fixture(autouse=True)
def no_weights(tmp_path_factory, monkeypatch):
    """No weights but the shipped ones, whatever this machine has."""
    monkeypatch.setenv("ANIMATIC_MODELS", str(tmp_path_factory.mktemp("none")))


def animatic(monkeypatch, capsys, *arguments):
    """Exit code, standard output and standard error of a command."""
    monkeypatch.setattr(sys, "argv", ["animatic", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    code = end.value.code
    out = capsys.readouterr()
    return (0 if code is None else code), out.out, out.err


@pytest.fixture
def run(monkeypatch, capsys):
    return lambda *arguments: animatic(monkeypatch, capsys, *arguments)


@pytest.fixture(scope="module")
def job(tmp_path_factory, video, config):
    root = tmp_path_factory.mktemp("j") / "J"
    command = [sys.executable, "-c", "from pipelines.cli import main; main()", "label", str(video), "--out", str(root)]
    done = subprocess.run(
        [*command, "--config", str(config), "--keep-share", "1", "--workers", "0"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "pack 1 done" in done.stdout
    return root


def test_help_names_every_command_and_loads_nothing_heavy():
    code = (
        "import sys; import pipelines.cli as c; import typer\n"
        "print(sorted(typer.main.get_command(c.app).commands))\n"
        "print(sorted({'numpy', 'cv2', 'torch', 'pydantic', 'pyarrow'} & set(sys.modules)))"
    )
    names, heavy = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.splitlines()
    commands = {
        "label", "index", "count", "select", "cut", "keypoints", "ego", "render", "pack", "slice", "status", "inspect",
        "cache", "train", "generate", "models", "demo", "export", "chart", "stability", "report", "plan", "evaluate",
        "study",
    }  # fmt: skip
    assert set(ast.literal_eval(names)) == commands
    assert heavy == "[]"


@pytest.mark.parametrize("module", ["pipelines", "pipelines.cli"])
def test_python_runs_the_modules_as_the_command(module):
    command = [sys.executable, "-m", module]
    done = subprocess.run([*command, "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and f"Usage: python -m {module}" in done.stdout
    wrong = subprocess.run([*command, "status", "nowhere"], capture_output=True, text=True)
    assert wrong.returncode == 2 and wrong.stderr.startswith("error:")


def test_status_of_a_finished_job(run, job):
    code, out, _ = run("status", job)
    assert code == 0 and "next: animatic models  (to get a keypoint network: without one skeletons are black" in out
    assert f"{job}: 1 video\n" in out and "clips: 2 kept\n" in out
    code, out, _ = run("status", job, "--json")
    stages = {stage["stage"]: stage for stage in json.loads(out)["stages"]}
    assert stages["cut"]["done"] == 1 and stages["render"]["done"] == 2 and not stages["pack"]["failed"]


def test_a_backbone_that_needs_no_weights_is_named_where_those_of_the_first_are_not_there(job, tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    command, reason = next_training(job)
    assert command == f"animatic cache {job} --backbone ltx-2b" and reason.startswith("2 clips packed, which `animatic")
    assert "`--backbone tiny` tries all steps without any" in reason
    weights = tmp_path / "models--Lightricks--LTX-Video" / "snapshots" / "0" / "model_index.json"
    weights.parent.mkdir(parents=True)
    weights.touch()
    assert "`--backbone tiny`" not in next_training(job)[1]


def test_commands_to_type_next_can_be_typed_whatever_the_folder_is_called(run, job, tmp_path):
    root = shutil.copytree(job, tmp_path / "my job [old]")
    out = run("inspect", root)[1]
    line = next(line for line in out.splitlines() if line.startswith("one clip: "))
    assert shlex.split(line.removeprefix("one clip: "))[:3] == ["animatic", "inspect", str(root)]
    assert f"{root}: 1 video\n" in run("status", root)[1]
    assert shlex.split(next_training(root)[0])[2:3] == [str(root)]
    for name in ("latents/mine/cache.json", "latents/mine/clips/street/street_0.safetensors"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    command, reason = next_training(root)
    assert shlex.split(command) == ["animatic", "cache", str(root), "--backbone", "BACKBONE.yaml"]
    assert reason == "1 of 2 clips have no latents of mine, whose file BACKBONE.yaml stands for"
    shutil.rmtree(root / "shards")
    again = json.loads(run("status", root, "--json")[1])["next_command"]
    assert shlex.split(again) == ["animatic", "label", "--out", str(root)]


def test_status_goes_on_to_training(run, job, tmp_path):
    """Latents of every clip, the motion adapter, the appearance adapter, a sample; the furthest backbone leads."""
    root = shutil.copytree(job, tmp_path / "J")

    def there(name):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()

    def trained(name, step, steps):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        about = {"step": step, "config": {"optimiser": {"steps": steps}}}
        save_file({"a": np.zeros(1)}, root / name, metadata={OUR_METADATA: json.dumps(about)})

    def following():
        code, out, _ = run("status", root, "--json")
        return code, json.loads(out)["next_command"]

    there("latents/ltx-2b/cache.json")
    there("latents/ltx-2b/clips/street/street_0.safetensors")
    assert following() == (0, f"animatic cache {root} --backbone ltx-2b")
    assert "(1 of 2 clips have no latents)" in run("status", root)[1]
    there("latents/ltx-2b/clips/street/street_8.safetensors")
    assert following() == (0, f"animatic train motion --data {root} --config motion_ltx_2b")
    there("adapters/motion_ltx_2b_motion/adapter.safetensors")
    assert following() == (0, f"animatic train motion --data {root} --config motion_ltx_2b"), "an empty file"
    trained("adapters/motion_ltx_2b_motion/adapter.safetensors", 37, 40)
    assert following() == (0, f"animatic train motion --data {root} --config motion_ltx_2b")
    assert "has done 37 of 40 steps" in run("status", root)[1]
    trained("adapters/motion_ltx_2b_motion/adapter.safetensors", 40, 40)
    assert following() == (0, f"animatic train appearance --data {root} --config appearance_ltx_2b")
    there("latents/mine/cache.json")
    assert following() == (0, f"animatic train appearance --data {root} --config appearance_ltx_2b")
    trained("adapters/appearance_ltx_2b_appearance/adapter.safetensors", 7, 7)
    adapters = "--motion {0}/motion_ltx_2b_motion --appearance {0}/appearance_ltx_2b_appearance"
    assert following() == (
        0, f"animatic generate --data {root} {adapters.format(root / 'adapters')} --out {root / 'samples'}"
    )  # fmt: skip


def test_black_skeletons_are_told_of_wherever_they_would_be_used(run, job, tmp_path):
    """The job's only network gives boxes."""
    for command in (["status", job], ["inspect", job], ["export", "coco", job, "--out", tmp_path / "coco"]):
        code, out, _ = run(*command)
        assert code == 0 and "skeletons are black" in " ".join(out.split()), command


def test_ctrl_c_says_how_to_go_on(tmp_path):
    video = write_street(tmp_path / "street.mp4", frames=150)
    command = [sys.executable, "-m", "pipelines", "label", video, "-o", tmp_path / "J", "--keep-share", "1"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        # A suite that a shell runs in the background is deaf to Ctrl-C, and so is what it starts.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert process.stdout is not None
    process.stdout.readline()  # The first line: the job has begun.
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err.endswith("stopped; run the same command again to go on\n")


def test_a_finished_job_is_labelled_again_at_once(run, job):
    code, out, _ = run("label", "--out", job, "--workers", "0")
    assert code == 0 and not re.search(r"[1-9]\d* done", out)


def test_what_changes_in_a_job_is_said_before_work_starts(run, video, job, tmp_path):
    root = shutil.copytree(job, tmp_path / "J")
    more = write_street(tmp_path / "more.mp4", frames=24, seed=3)
    code, out, _ = run("index", more, "--out", root, "--keep-share", "0.9", "--extractors", "street", "--workers", "0")
    words = (
        f"{root}: adds 1 video to 1; select.keep_share 1.0 -> 0.9, keypoints.extractors none -> street: what depends "
    )
    assert code == 0 and words in out.splitlines()[0]
    stale = "note shards are older than the job's settings, videos or models"
    assert stale in run("inspect", root)[1] and stale not in run("inspect", job)[1]
    assert stale in run("cache", root, "--backbone", "nope")[1]
    assert stale in run("train", "motion", "--data", root, "--config", "motion_ltx_2b", "--dry-run")[1]
    assert (
        "effort balanced -> fast: what depends on it" in run("index", "-o", root, "--config", fast(tmp_path, root))[1]
    )
    assert "adds" not in run("index", "-o", root)[1]


def fast(folder, job):
    """The settings of a job with another effort."""
    config = yaml.safe_load((job / "job.yaml").read_text())["config"]
    changed = {"keypoints": {**config["keypoints"], "effort": "fast"}, "count": {"looks_per_clip": 1}}
    return bad_yaml(folder, yaml.safe_dump(config | changed))


def test_inspect_gives_a_summary_a_record_and_a_sheet(run, job, tmp_path):
    code, out, _ = run("inspect", job)
    assert code == 0 and "2, kept 2 (no threshold), packed 2" in out and "1 video, " in out
    code, out, _ = run("inspect", job, "street_8", "--json", "--sheet", tmp_path / "s.png")
    record = json.loads(out)
    assert (code, record["key"], record["start"]) == (0, "street_8", 8)
    assert record["caption"] and record["members"]["rgb.mp4"] > 0
    sheet = cv2.imread(str(tmp_path / "s.png"))
    assert sheet is not None and sheet.shape[1] > 2000
    code, out, _ = run("inspect", job, "street_8", "--trajectory", tmp_path / "t.png")
    assert code == 0 and "trajectory:" in out and (tmp_path / "t.png").is_file()
    assert run("inspect", job, "--keys") == (0, "street_0\ttrain\nstreet_8\ttrain\n", "")
    assert json.loads(run("inspect", job, "--keys", "--json")[1]) == {"train": ["street_0", "street_8"], "val": []}
    assert run("inspect", job, "street_8", "--keys")[0] == 2
    assert json.loads(run("inspect", job, "--json")[1])["packed"] == {"train": 2, "val": 0}


def test_a_clip_that_is_not_there_is_named(run, job, tmp_path):
    code, _, err = run("inspect", job, "street_9")
    assert code == 2 and "has no clip 'street_9'" in err and err.count("\n") == 1
    assert run("inspect", job, "--sheet", tmp_path / "s.png")[0] == 2
    assert run("inspect", job, "--trajectory", tmp_path / "t.png")[0] == 2
    assert run("inspect", job, "street_0", "--sheet", tmp_path / "none" / "s.png")[0] == 2


def test_the_released_trainer_s_manifest(run, job, tmp_path):
    code, _, _ = run("export", "released", job, "--out", tmp_path / "x" / "..")
    lines = [json.loads(line) for line in (tmp_path / "train.jsonl").read_text().splitlines()]
    assert code == 0 and [line["id"] for line in lines] == ["street_0", "street_8"]
    assert [line["rgb_path"] for line in lines] == [str(tmp_path / f"rgb/{line['id']}.mp4") for line in lines]
    from labeling.video import frame_count

    assert all(set(line) == {"id", "caption", "rgb_path", "pose_path"} for line in lines)
    assert {frame_count(line[name]) for line in lines for name in ("rgb_path", "pose_path")} == {9}
    assert run("export", "released", job, "--out", tmp_path, "--split", "val")[0] == 2
    for form in ("released", "coco"):
        code, _, err = run("export", form, job, "--out", job / "videos" / "..")
        assert code == 2 and "is the job's own folder; give another" in err
    assert not list(job.glob("*.json*")) and not (job / "rgb").exists()


def test_keypoints_as_coco(run, job, tmp_path):
    code, out, _ = run("export", "coco", job, "--out", tmp_path)
    found = json.loads((tmp_path / "train.coco.json").read_text())
    assert code == 0 and "17 images of 1 run in" in out and len(found["images"]) == 17
    assert "without their pictures: --images writes them too" in out and not (tmp_path / "images").exists()
    code, out, _ = run("export", "coco", job, "--out", tmp_path, "--images")
    assert code == 0 and f"their pictures in {tmp_path / 'images'}" in out
    assert all((tmp_path / image["file_name"]).is_file() for image in found["images"])
    assert run("export", "coco", job, "--out", tmp_path, "--split", "val")[0] == 2


def test_the_report_stands_alone(run, job):
    code, out, _ = run("report", job)
    page = (job / "report.html").read_text()
    assert code == 0 and out.strip() == str(job / "report.html")
    assert "data:video/mp4;base64," in page and "data:image/" in page
    assert not re.search(r'(src|href)="(?!data:)', page)


def test_models_are_listed_with_how_to_get_them(run, tmp_path):
    write_detector(tmp_path / "m")
    code, out, _ = run("models", "--models", tmp_path / "m")
    assert code == 0 and "counter" in out and "yolox_l" in out and "absent" in out
    cards = json.loads(run("models", "--models", tmp_path / "m", "--json")[1])["cards"]
    assert cards["counter"]["state"] == "present" and cards["yolox_nano"]["state"] == "absent"


def test_a_folder_without_weights_is_said(run, monkeypatch, tmp_path):
    code, out, _ = run("models", "--models", tmp_path)
    assert code == 0 and f"weights are looked for in {tmp_path} (holds no .onnx file), then " in out
    assert "holds no" not in run("models", "--models", write_detector(tmp_path / "m"))[1]
    for command in (["models"], ["models", "check", "yolox_nano"], ["plan", tmp_path]):
        code, _, err = run(*command, "--models", tmp_path / "none")
        assert code == 2 and f"--models {tmp_path / 'none'}: is no folder" in err
    monkeypatch.setenv("ANIMATIC_MODELS", str(tmp_path / "none"))
    assert f"{tmp_path / 'none'} (there is no such folder)" in run("models")[1]


def test_stages_are_commands_of_their_own(run, video, config, tmp_path):
    root = tmp_path / "J"
    code, _, err = run("cut", "--out", root)
    assert code == 2 and "holds no job.yaml" in err
    code, _, _ = run("index", video, "--out", root, "--config", config, "--keep-share", "1", "--workers", "0")
    assert code == 0
    code, _, err = run("cut", "--out", root, "--workers", "0")
    assert code == 2 and "animatic select" in err
    for stage in ("count", "select", "cut", "keypoints", "ego", "render", "pack"):
        options = () if stage == "select" else ("--workers", "0")
        assert run(stage, "--out", root, *options)[0] == 0, stage
    assert (root / "shards" / "index.parquet").is_file()
    assert run("select", "--out", root, "--extend")[0] == 0
    assert run("select", "--out", root, "--refreeze")[0] == 0
    assert run("select", "--out", root, "--refreeze", "--extend")[0] == 2


def test_slice_is_index_and_cut(run, video, config, tmp_path):
    code, _, _ = run("slice", video, "--out", tmp_path / "J", "--config", config, "--workers", "0")
    assert code == 0
    assert sorted(path.name for path in (tmp_path / "J/videos/street").iterdir()) == [
        "index.parquet", "run_0_17.frames.parquet", "run_0_17.mp4"
    ]  # fmt: skip
    code, out, _ = run("status", tmp_path / "J")
    assert code == 0 and "next: animatic label --out" in out


def test_one_bad_video_ends_with_exit_code_1_and_its_reason(run, video, config, tmp_path):
    (tmp_path / "v").mkdir()
    (tmp_path / "v" / "good.mp4").write_bytes(video.read_bytes())
    (tmp_path / "v" / "bad.mp4").write_text("no video at all")
    root = tmp_path / "J"
    code, out, _ = run(
        "label", tmp_path / "v", "--out", root, "--config", config, "--keep-share", "1", "--workers", "0"
    )
    assert code == 1 and "bad.mp4" in out and "pack 1 done" in out
    code, out, _ = run("status", root)
    assert code == 1 and "1 video" in out and "bad.mp4" in out
    assert "2 videos, 1 of them indexed" in run("inspect", root)[1]
    # It stays bad until it changes, and says so again.
    code, out, _ = run("label", "--out", root, "--workers", "0")
    assert code == 1 and "bad.mp4" in out


def test_a_job_of_which_nothing_is_left_says_why(run, config, tmp_path):
    short = write_street(tmp_path / "short.mp4", frames=5)
    code, out, _ = run(
        "label", short, "--out", tmp_path / "J", "--config", config, "--keep-share", "1", "--workers", "0"
    )
    why = "no clip is left of 1: 1 too_short (short_0: too_short: frames=5 < clip_frames=9); give longer videos"
    assert code == 1 and why in out and "select 0 kept, 1 dropped (too_short)" in out
    code, out, _ = run("status", tmp_path / "J")
    assert code == 1 and why in out and "everything is packed" not in out
    assert json.loads(run("status", tmp_path / "J", "--json")[1])["nothing_left"].startswith(why)
    code, out, _ = run("inspect", tmp_path / "J")
    assert code == 0 and why in out and "none kept" in out and "--sheet" not in out


def test_a_job_whose_kept_clips_are_all_dropped_later_says_why(run, job, tmp_path):
    root = shutil.copytree(job, tmp_path / "J")
    trajectory = tmp_path / "street.tum"
    trajectory.write_text("0 0 0 0 0 0 0 1\n0.1 0 0 1 0 0 0 1\n")
    assert run("ego", root, "--import", trajectory, "--workers", "0")[0] == 0
    why = "no clip is left of 2: 2 no_trajectory (street_0: no_trajectory="
    for command in (["label", "--out", root, "--workers", "0"], ["status", root], ["pack", "-o", root]):
        code, out, _ = run(*command)
        assert code == 1 and why in out and "import trajectories that cover the videos" in out, command
    inspected = run("inspect", root)[1]
    assert why in inspected and "2, none kept" in inspected
    assert "clips: 0 kept, 2 dropped (no_trajectory)" in run("status", root)[1]


def bad_yaml(tmp_path, text):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda t, v: ["none.mp4", "-o", t / "J"], "no such file; check the path"),
        (lambda t, v: [t, "-o", t / "J"], "holds no videos"),
        (lambda t, v: ["-o", t / "J"], "no videos were given"),
        (lambda t, v: [copied(v, t / "a.b.mp4"), "-o", t / "J"], "'a.b' is no video id"),
        (lambda t, v: [v, copied(v, t / "street.mp4"), "-o", t / "J"], "two videos would be called 'street'"),
        (lambda t, v: [v, "-o", t / "J", "--config", bad_yaml(t, "clip: {frames: 3}")], "clip.frames is not a setting"),
        (lambda t, v: [v, "-o", t / "J", "--config", bad_yaml(t, "clip: [")], "is no YAML"),
        (lambda t, v: [v, "-o", t / "J", "--config", bad_yaml(t, "- 1")], "needs a mapping"),
        (lambda t, v: [v, "-o", t / "J", "--config", bad_yaml(t, "encoder: {gop: 7}")], "must divide"),
        (lambda t, v: [v, "-o", t / "J", "--keep-share", "0"], "select.keep_share"),
        (lambda t, v: [v, "-o", t / "J", "--effort", "huge"], "choose one of fast, balanced, exact"),
        (lambda t, v: [v, "-o", t / "J", "--keep-share", "1", "--part", "3/2"], "give i/n"),
        (lambda t, v: [v, "-o", t / "J"], "--models DIR"),
        (lambda t, v: [v, "-o", t / "J", "--models", t / "none"], "is no folder"),
        (lambda t, v: [v, "-o", t / "J", "--extractors", "nope"], "no model card is called 'nope'"),
        (lambda t, v: [v, "-o", t / "J", "--extractors", "yolox_l"], "its weights yolox_l.onnx are not there"),
        (lambda t, v: [v, "-o", t / "J", "--models", spoilt(t, b"<html>not found</html>")], "counter.onnx"),
        (lambda t, v: [v, "-o", t / "J", "--models", spoilt(t, None)], "sha256"),
        (lambda t, v: [v, "-o", in_the_way(t) / "J", "--keep-share", "1"], "give a folder that can be written to"),
        (lambda t, v: [v, "-o", t / "J", "--config", bad_yaml(t, "count: {detector: nope}")], "card is called 'nope'"),
        (
            lambda t, v: [v, "-o", t / "J", "--config", bad_yaml(t, "count: {detector: street_fields}")],
            "count.detector: 'street_fields' is no detector",
        ),
        (lambda t, v: [v, "-o", t / "J", "--keep-share", "1", "--captions", t / "none.csv"], "as a caption table"),
        (lambda t, v: [v, "-o", t / "J", "--split", bad_yaml(t, "video_id,split\nx,val")], "no split for video"),
        (lambda t, v: [v, "-o", t / "J", "--leave-out", bad_yaml(t, "video_id,start_s\nx,1")], "has no column"),
        (lambda t, v: [v, "-o", t / "J", "--leave-out", bad_yaml(t, "video_id,start_s,end_s\nx,1,1")], "names 'x'"),
    ],
    ids=[
        "missing", "empty folder", "nothing", "dot", "same id", "unknown key", "broken YAML", "list", "GOP", "share",
        "effort", "part", "no detector", "no models", "no card", "no weights", "HTML", "hash", "unwritable",
        "no counter", "counter of another kind", "captions", "split", "column", "unknown video",
    ],
)  # fmt: skip
def test_what_can_be_mended_is_one_line_and_exit_code_2(run, video, tmp_path, make, message):
    code, out, err = run("label", *make(tmp_path, video), "--workers", "0")
    assert code == 2
    assert message in err and "Traceback" not in out + err
    assert err.count("\n") == 1
    assert not (tmp_path / "J").exists(), "what cannot be used leaves no job behind"


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "motion", "--data", "J", "--config", "a" * 300], ["cache", "J", "--backbone", "a" * 300],
        ["label", "a" * 300, "-o", "J"],
    ],
    ids=["config", "backbone", "video"],
)  # fmt: skip
def test_an_argument_that_is_too_long_for_a_file_is_one_line(run, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(*arguments)
    assert code == 2 and "Traceback" not in out + err
    assert err.count("\n") == 1 and f"{'a' * 40}" in err and "a" * 60 not in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("changes", [["--part", "3/2"], ["--extractors", "nope"]], ids=["part", "card"])
def test_a_command_that_is_refused_leaves_a_job_as_it_was(run, job, tmp_path, changes):
    root = shutil.copytree(job, tmp_path / "J")
    before = (root / "job.yaml").read_bytes()
    for command in ("label", "index"):
        assert run(command, "--out", root, "--workers", "0", *changes)[0] == 2
        assert (root / "job.yaml").read_bytes() == before
    assert run("label", "--out", root, "--workers", "0")[0] == 0


def copied(video, path):
    path.write_bytes(video.read_bytes())
    return path


def spoilt(folder, content):
    """A models folder whose card's file holds something else; None: other bytes of the same kind."""
    models = write_detector(folder / "m")
    path = models / "counter.onnx"
    if content is None:
        path.write_bytes(path.read_bytes() + b"\x00")
    else:
        path.write_bytes(content)
    return models


def in_the_way(folder):
    (folder / "file").write_text("a file, not a folder")
    return folder / "file"


@pytest.mark.parametrize("below", ["", "J/K"], ids=["itself", "above"])
def test_a_file_in_the_folder_s_place_is_said_before_models_are_opened(run, video, tmp_path, below):
    models = spoilt(tmp_path, None)
    code, out, err = run("label", video, "-o", in_the_way(tmp_path) / below, "--models", models)
    assert code == 2 and f"{tmp_path / 'file'} is a file; give a folder" in err and not out


def test_a_list_of_paths_with_ids(run, video, config, tmp_path):
    listed = tmp_path / "videos.txt"
    listed.write_text(f"# two of them\nmine\t{video}\n\n{video}\n")
    table = tmp_path / "leave.csv"
    table.write_text("video_id,start_s,end_s\nmine,0.2,\n")
    code, out, _ = run(
        "label", listed, "-o", tmp_path / "J", "--config", config, "--keep-share", "1", "--workers", "0",
        "--leave-out", table,
    )  # fmt: skip
    assert code == 0 and "note street is mine again, byte for byte: its clips are dropped (same_as)" in out
    summary = json.loads(run("inspect", tmp_path / "J", "--json")[1])
    assert (summary["videos"], summary["kept"], summary["dropped"]) == (2, 1, {"left_out": 1, "same_as": 2})


def test_lists_with_commas_are_read_as_they_are_typed() -> None:
    assert listed("street, mine ,") == ("street", "mine") and listed(" ,") == ()
