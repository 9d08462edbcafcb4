"""The GPU benchmark's command, at tiny size on a CPU: it is real code that a machine with a GPU runs as it is."""

import json
import sys
from pathlib import Path

import pytest
import torch
from training_fixtures import one_thread  # noqa: F401

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))

import bench_gpu  # type: ignore[import-not-found]


def test_without_a_gpu_it_says_so(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert bench_gpu.main([]) == 2
    assert "no GPU here" in capsys.readouterr().err


def test_the_tiny_network_goes_through_every_row(tmp_path: Path) -> None:
    assert bench_gpu.main(["--tiny", "--steps", "1", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "gpu-tiny.json").read_text())
    assert [(row["stage"], row["gradient_checkpointing"]) for row in found["rows"]] == [
        ("motion", True), ("motion", False), ("appearance", True), ("appearance", False),
    ]  # fmt: skip
    for row in found["rows"]:
        assert not row["failed"] and row["ms_per_sample"] > 0 and row["tflops"] > 0
        steps = {"motion": 9000, "appearance": 5000}[row["stage"]]
        assert row["gpu_hours"] == pytest.approx(row["ms_per_sample"] * steps * 32 / 3.6e6)
    assert set(found["gpu_hours_at_the_fastest"]) == {"motion", "appearance", "both"}


def test_the_papers_recipe_is_what_a_gpu_runs() -> None:
    config = bench_gpu.config_for("appearance", small=False, checkpointing=True, compiled=False)
    assert (config.optimiser.steps, config.optimiser.global_batch, config.adapter.rank) == (5000, 32, 512)
    assert config.backbone.dtype == "bfloat16"


@pytest.mark.parametrize(
    ("name", "peak"),
    [("NVIDIA H200", 989.0), ("NVIDIA H100 PCIe", 756.0), ("NVIDIA A100-SXM4-80GB", 312.0), ("Riva TNT2", None)],
)
def test_peaks_are_found_by_the_chips_name(name: str, peak: float | None) -> None:
    assert bench_gpu.peak_tflops(name) == peak


def test_out_of_memory_is_a_row_and_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(bench_gpu, "measure_steps", full)
    row = bench_gpu.measure("motion", small=True, steps=1, checkpointing=False, compiled=False)
    assert row.ms_per_sample is None and "out of memory" in row.failed
    assert bench_gpu.best_hours([row]) == {}
