"""The training and the sampling chart: every setting is a recipe that loads, and errors have hand-computed answers."""

import numpy as np
import pytest
import torch

from pipelines import charts_generate, charts_train


@pytest.mark.parametrize("setup", [charts_train._cpu_setup(), charts_train._gpu_setup()], ids=["cpu", "gpu"])
def test_every_setting_is_a_recipe_of_its_own(setup) -> None:
    configs = [setup.config(method) for method in setup.methods]
    assert len({config.model_dump_json() for config in configs}) == len(configs)
    assert len({method.name for method in setup.methods}) == len(configs)
    assert sum(method.reference for method in setup.methods) == 1
    for method, config in zip(setup.methods, configs, strict=True):
        assert (config.adapter.rank, config.compile) == (method.rank, method.compiled)
        assert config.backbone.picture.control_width == method.width


def test_drafts_are_judged_by_the_nearest_and_by_their_own_future() -> None:
    def video(level: float) -> torch.Tensor:
        frames = torch.full((1, 2, 1, 1), level)
        # The first latent frame is given and must not count.
        frames[:, 0] = 100 * level
        return frames

    futures = torch.stack([video(0.0), video(4.0)])
    nearest, own = charts_generate._errors(torch.stack([video(1.0)]), futures)
    assert nearest.tolist() == [0.25, 0.75]
    assert own.tolist() == [0.25]
    nearest, own = charts_generate._errors(futures, futures)
    assert np.all(nearest == 0) and np.all(own == 0)


def test_methods_have_distinct_names_and_the_yardstick_is_among_them() -> None:
    names = [method.name for method in charts_generate._METHODS]
    assert len(set(names)) == len(names)
    assert charts_generate._REFERENCE in charts_generate._METHODS


def test_clips_are_timed_on_the_one_thread_that_the_chart_names(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def interrupted(*_: object, **__: object) -> None:
        seen.append(torch.get_num_threads())
        raise KeyboardInterrupt

    monkeypatch.setattr(charts_generate, "_taught", interrupted)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(KeyboardInterrupt):
            charts_generate.chart("generate")
        assert seen == [1] and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
