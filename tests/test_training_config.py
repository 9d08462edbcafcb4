"""Recipes: the paper's numbers, unknown keys refused, the dry run's counts."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from training_fixtures import one_thread  # noqa: F401

from labeling.errors import ConfigError
from labeling.settings_files import laid_over
from training.config import TrainConfig, backbone_config, config_names, load_config
from training.dry_run import plan_run
from training.trainer import train

PAPER = ["motion", "appearance", "end_to_end"]


@pytest.mark.parametrize("name", config_names())
def test_every_shipped_recipe_loads(name: str) -> None:
    config = load_config(name, stage="motion" if name == "tiny" else None)
    assert config.name == name
    assert config.stage == ("motion" if name == "tiny" else name.rsplit("_", 2 if "ltx" in name else 1)[0])


def test_the_papers_recipe() -> None:
    motion, appearance = load_config("motion_ltx_2b"), load_config("appearance_ltx_2b")
    for config in (motion, appearance):
        assert (config.optimiser.learning_rate, config.optimiser.betas) == (2e-4, (0.9, 0.95))
        assert (config.optimiser.global_batch, config.adapter.rank) == (32, 512)
        assert config.conditions.caption_dropout == 0.1
    assert (motion.optimiser.steps, motion.optimiser.schedule, motion.optimiser.warmup_steps) == (9000, "cosine", 1500)
    assert (appearance.optimiser.steps, appearance.optimiser.final_factor) == (5000, 0.1)
    assert (appearance.targeted_noise.omega_max, appearance.targeted_noise.formula) == (0.3, "variance")
    end_to_end = load_config("end_to_end_ltx_2b")
    assert end_to_end.optimiser.steps == motion.optimiser.steps + appearance.optimiser.steps


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "backbone: tiny\noptimiser: {steps: 3, lerning_rate: 1}",
            r"optimiser.lerning_rate is not a setting; did you mean learning_rate\? choose one of learning_rate",
        ),
        ("backbone: tiny\noptimizer: {steps: 3}", r"optimizer is not a setting; did you mean optimiser\? choose"),
        ("backbone: tiny\nzebra: 1\noptimiser: {steps: 3}", "zebra is not a setting; choose one of"),
        ("backbone: tiny\noptimiser: {steps: 3, learning_rate: .nan}", "learning_rate is nan, but must be a number$"),
        ("backbone: tinny\noptimiser: {steps: 3}", "backbone: not a preset; choose one of tiny, .*'tinny'"),
        ("backbone: tiny\noptimiser: {steps: 0}", "c.yaml: optimiser.steps is 0, but must be 1 or more$"),
        ("backbone: tiny\noptimiser: {steps: three}", "optimiser.steps is 'three', but must be a whole number"),
        (
            "backbone: tiny\noptimiser: {steps: 3, schedule: cosin}",
            "schedule is 'cosin', but must be 'cosine', 'linear",
        ),
        ("backbone: tiny\noptimiser: {steps: 3}\nconditions: {ego_probability: 2}", "is 2, but must be 1 or less"),
        ("backbone: tiny\noptimiser: 3", "optimiser is 3, but must hold settings by name"),
        ("backbone: tiny\noptimiser: {steps: 0}\nseed: x", "steps is 0, .*; seed is 'x', but must be a whole number$"),
        ("backbone: tiny", "optimiser is missing"),
        ("stage: appearance\nbackbone: tiny\noptimiser: {steps: 3}", "trains stage 'appearance'"),
        ("backbone: tiny\noptimiser: {steps: 3}\nconditions: {coordinates: released}", "for sampling only"),
        ("a: [", "c.yaml: is no YAML"),
        ("- 1", "needs a mapping of settings, holds list"),
    ],
    ids=[
        "unknown key",
        "misspelt",
        "unknown and far",
        "nan",
        "unknown backbone",
        "no steps",
        "not whole",
        "no choice",
        "too much",
        "no settings",
        "two",
        "missing",
        "other stage",
        "released",
        "no yaml",
        "list",
    ],
)
def test_files_that_cannot_be_used_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_config(path, stage="motion")


def test_unknown_names_are_refused_with_what_there_is() -> None:
    with pytest.raises(ConfigError, match="motion_ltx_2b"):
        load_config("motion_ltx_3b")
    with pytest.raises(ConfigError, match="ltx-13b"):
        backbone_config("ltx")
    with pytest.raises(ConfigError, match="stage is missing"):
        load_config("tiny")


def test_presets_take_overrides_without_losing_the_rest(tmp_path: Path) -> None:
    config = backbone_config("ltx-2b", picture={"frames": 49}, weights="/models/ltx")
    assert (config.picture.frames, config.picture.rgb_width, config.dtype) == (49, 1056, "bfloat16")
    assert config.weights == "/models/ltx"
    path = tmp_path / "b.yaml"
    path.write_text("backbone: {name: ltx-2b, weights: here}\nstage: motion\noptimiser: {steps: 1}")
    assert backbone_config(path).weights == load_config(path).backbone.weights == "here"


def test_control_fps_follows_the_frame_step() -> None:
    assert backbone_config("svd").picture.fps == 12


@pytest.mark.parametrize(
    ("name", "base", "trainable", "target", "most"),
    [
        ("motion_ltx_2b", 1.923e9, 763.4e6, 6144, 3 * 6144 + 384),
        ("appearance_ltx_2b", 1.923e9, 763.4e6, 11616, 11616 + 6144),
        ("motion_ltx_13b", 13.04e9, 2617e6, 6144, 3 * 6144 + 384),
        ("appearance_ltx_13b", 13.04e9, 2617e6, 11616, 11616 + 6144),
    ],
)
def test_dry_run_counts_parameters_and_tokens(name, base, trainable, target, most) -> None:
    plan = plan_run(load_config(name))
    assert plan.base_parameters == pytest.approx(base, rel=1e-3)
    assert plan.trainable_parameters == pytest.approx(trainable, rel=1e-3)
    assert (plan.target_tokens, plan.most_tokens) == (target, most)
    assert plan.weights_gib == pytest.approx(base * 2 / 2**30, rel=1e-3)
    assert plan.adapter_gib == pytest.approx(trainable * 16 / 2**30, rel=1e-3)
    assert plan.memory_gib < 141


def test_dry_run_needs_neither_data_nor_weights_and_says_all(tmp_path: Path) -> None:
    plan = train(
        load_config("motion_ltx_2b"), data=tmp_path / "none", out=tmp_path / "out", dry_run=True, steps_per_second=0.5
    )
    text = "\n".join(f"{name}: {value}" for name, value in plan.rows())  # type: ignore[union-attr]
    for part in ("763.4 M", "6,144", "1.92 B", "GiB", "1,800 steps per hour, 5.0 h", "288,000 samples"):
        assert part in text
    assert not (tmp_path / "out").exists()


def test_dry_run_of_a_tiny_network_says_no_zeros() -> None:
    plan = plan_run(load_config("tiny", stage="motion"), steps_per_second=2)
    values = dict(plan.rows())
    assert (values["frozen parameters"], values["trained parameters"]) == ("202.6 k", "26.62 k")
    assert "MiB: " in values["memory per GPU (estimate)"] and values["work per step"].endswith(" GFLOP")
    assert values["at the given rate"] == "7,200 steps per hour, 20.0 s in all"
    assert not {"0.0", "0.00"} & set(" ".join(values.values()).split())
    slow = dict(plan_run(load_config("tiny", stage="motion"), steps_per_second=1e-4).rows())
    assert slow["at the given rate"].startswith("0.36 steps per hour, ")


def test_a_plan_of_own_weights_needs_their_size() -> None:
    own = {"backbone": {"name": "mine", "kind": "ltx", "weights": "/w/ltx"}, "optimiser": {"steps": 10}}
    with pytest.raises(ConfigError, match="does not say how large /w/ltx is.*backbone.size to 2b or 13b"):
        plan_run(TrainConfig.model_validate({"stage": "motion", **own}))
    own["backbone"]["size"] = "2b"
    assert plan_run(TrainConfig.model_validate({"stage": "motion", **own})).base_parameters > 1e9


def test_dry_run_memory_follows_the_knobs() -> None:
    plain = plan_run(load_config("motion_ltx_2b"))
    for overrides in (
        {"optimiser": {"micro_batch": 2}}, {"gradient_checkpointing": False}, {"adapter": {"rank": 1024}},
    ):  # fmt: skip
        assert plan_run(load_config("motion_ltx_2b", overrides=overrides)).memory_gib > plain.memory_gib


@pytest.mark.parametrize("rate", [-1, 0, math.nan, math.inf])
def test_a_rate_that_is_none_is_refused(rate: float) -> None:
    with pytest.raises(ConfigError, match=f"--steps-per-second {rate:g} is no rate of steps"):
        plan_run(load_config("tiny", stage="motion"), steps_per_second=rate)


@pytest.mark.parametrize("load", [load_config, backbone_config], ids=["recipe", "backbone"])
def test_a_file_that_cannot_be_read_is_one_line(
    load: Callable[..., object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: Path, **_: object) -> str:
        raise PermissionError(13, "Permission denied", str(self))

    path = tmp_path / "mine.yaml"
    path.write_text("name: tiny")
    monkeypatch.setattr(Path, "read_text", refuse)
    with pytest.raises(ConfigError, match=r"mine.yaml: cannot be read \(.*Permission denied.*\); check the path"):
        load(path)


def test_changes_are_laid_over_settings_at_every_depth() -> None:
    base = {"a": {"b": 1, "c": {"d": 2}}, "e": [1, 2]}
    assert laid_over(base, {"a": {"c": {"d": 3}}, "e": [4], "f": 5}) == {"a": {"b": 1, "c": {"d": 3}}, "e": [4], "f": 5}
    assert base == {"a": {"b": 1, "c": {"d": 2}}, "e": [1, 2]}, "the base is left as it is"
