from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from enerf_ns.evaluation import scores
from enerf_ns.evaluation.metrics import correlation, depth_rmse, image_metrics
from enerf_ns.evaluation.runs import Run
from enerf_ns.evaluation.scores import mean_scores, summary_scores, view_scores
from enerf_ns.evaluation.views import HeldOutView


def views(number: int = 3) -> list[HeldOutView]:
    """Random pictures, of which each is aligned to half the brightness; depth is known but at one pixel."""
    generator = torch.Generator().manual_seed(0)
    made = []
    for time in range(number):
        recorded, rendered = (torch.rand(16, 20, 3, generator=generator) for _ in range(2))
        depth, recorded_depth = (1 + torch.rand(16, 20, 1, generator=generator) for _ in range(2))
        recorded_depth[0, 0] = 0.0
        made.append(HeldOutView(recorded, 0.5 * rendered, rendered**2, depth, recorded_depth, time))
    return made


def test_scores_of_a_view_are_of_the_aligned_render_but_the_correlation_of_the_render_as_it_is():
    view = views(1)[0]
    assert view.recorded is not None and view.recorded_depth is not None
    expected = image_metrics(view.rendered, view.recorded)
    expected["correlation"] = correlation(view.unaligned, view.recorded)
    expected["depth_rmse"] = depth_rmse(view.depth, view.recorded_depth)
    assert view_scores(view) == expected


def test_what_is_unknown_is_left_out(monkeypatch: pytest.MonkeyPatch):
    view = views(1)[0]
    assert view_scores(replace(view, recorded=None)) == {}
    assert set(view_scores(replace(view, recorded_depth=None))) == {"psnr", "ssim", "correlation"}
    monkeypatch.setattr(scores, "lpips", lambda *_: 0.25)
    assert view_scores(view)["lpips"] == 0.25


def test_means_and_deviations_are_those_of_numpy():
    of_each = [view_scores(view) for view in views()]
    means = mean_scores(views(), with_std=True)
    assert mean_scores(views()) == {name: means[name] for name in of_each[0]}
    assert set(means) == {*of_each[0], *(f"{name}_std" for name in of_each[0])}
    for name in of_each[0]:
        values = np.array([one[name] for one in of_each])
        assert means[name] == pytest.approx(values.mean()) and means[f"{name}_std"] == pytest.approx(values.std())


def test_a_summary_has_a_place_for_what_is_missing():
    table = summary_scores(views(), {"fps": 2.0})
    assert table["lpips"] is None and table["fps"] == 2.0
    depths = [view.recorded_depth for view in views() if view.recorded_depth is not None]
    assert table["mean_depth"] == pytest.approx(np.mean([depth[depth > 0].mean().item() for depth in depths]))
    assert {name: table[name] for name in mean_scores(views())} == mean_scores(views())

    nothing = [replace(view, recorded=None, recorded_depth=None) for view in views()]
    table = summary_scores(nothing, {"event_correlation": 0.5})
    assert table == {"psnr": None, "ssim": None, "lpips": None, "event_correlation": 0.5}


def test_nerfstudio_gets_the_same_means(run: Run, tmp_path: Path):
    metrics = run.pipeline.get_average_eval_image_metrics(output_path=tmp_path / "pictures", get_std=True)
    assert len(list((tmp_path / "pictures").iterdir())) == 3
    assert {"psnr", "psnr_std", "ssim", "depth_rmse", "fps", "brightness_scale"} <= set(metrics)
    assert "psnr_std" not in run.pipeline.get_average_eval_image_metrics()
