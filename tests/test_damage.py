"""Videos that are less than they claim are named wherever a person looks."""

import json
import sys

import pytest
import yaml
from pipeline_fixtures import SMALL
from video_fixtures import SourceSpec, cut_off, regular_times, with_garbage, write_source

from pipelines.cli import main
from pipelines.damage import damage_lines

CUT = "damaged cut: 60 packets broken or gone, 1.5 s there of the 4.0 s that it promises; get the file again"


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    """A whole video, one whose end is gone, and one whose middle is noise."""
    folder = tmp_path_factory.mktemp("videos")
    spec = SourceSpec(faststart=True, gop=12)
    whole = write_source(folder / "whole.mp4", regular_times(24, 96), spec)
    cut_off(whole, folder / "cut.mp4")
    with_garbage(whole, folder / "noise.mp4", first=30, last=34)
    return folder


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    path = tmp_path_factory.mktemp("settings") / "small.yaml"
    path.write_text(yaml.safe_dump(SMALL))
    return ["--config", str(path), "--keep-share", "1", "--workers", "0"]


@pytest.fixture
def run(monkeypatch, capsys):
    def command(*arguments):
        monkeypatch.setattr(sys, "argv", ["animatic", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        assert not end.value.code
        return capsys.readouterr().out

    return command


def test_damaged_videos_are_named_at_the_end_and_in_status_and_inspect(run, videos, settings, tmp_path):
    root = tmp_path / "J"
    for out in (run("label", videos, "--out", root, *settings), run("status", root), run("inspect", root)):
        assert CUT in out and "damaged noise: " in out and "damaged whole" not in out
    assert "lost in decoding" in out
    assert [line.split(":")[0] for line in json.loads(run("status", root, "--json"))["damaged"]] == ["cut", "noise"]


def test_a_job_that_cannot_go_on_still_tells_of_its_packets(run, videos, settings, monkeypatch, tmp_path):
    """No detector is there to rank its clips with."""
    monkeypatch.setenv("ANIMATIC_MODELS", str(tmp_path))
    arguments = [*settings[:2], "--keep-share", "0.5", *settings[4:]]
    for out in (run("index", videos, "--out", tmp_path / "J", *arguments), run("status", tmp_path / "J")):
        assert CUT in out and "damaged noise" not in out, "nothing is decoded yet"


def test_the_plan_counts_what_is_there_of_a_video_that_is_cut_off(run, videos, settings):
    assert CUT in run("plan", videos / "cut.mp4", *settings)
    plan = json.loads(run("plan", videos / "cut.mp4", *settings, "--json"))
    whole = json.loads(run("plan", videos / "whole.mp4", *settings, "--json"))
    assert 0 < plan["clips"] < 0.7 * whole["clips"] and plan["source_hours"] < 0.7 * whole["source_hours"]
    assert plan["damaged"] and not whole["damaged"]


def test_a_header_that_rounds_or_counts_sound_makes_no_video_damaged():
    facts = {"seconds": 59.9, "broken_packets": 0}
    assert damage_lines({"v": {**facts, "promised_s": 62.0}}, ()) == []
    assert damage_lines({"v": {"seconds": 59.9}}, ()) == [], "an index of before such facts"
    (line,) = damage_lines({"v": {**facts, "broken_packets": 1, "promised_s": 90.0}}, ())
    assert line == "v: 1 packet broken or gone, 59.9 s there of the 90.0 s that it promises; get the file again"
