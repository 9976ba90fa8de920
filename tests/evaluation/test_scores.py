from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from enerf_ns.evaluation import scores
from enerf_ns.evaluation.metrics import correlation, depth_rmse, image_metrics
from enerf_ns.evaluation.runs import Run
from enerf_ns.evaluation.scores import mean_scores, summary_scores, view_scores
from enerf_ns.evaluation.views import HeldOutView, held_out_views

NO_LPIPS = "the frame is smaller than 31 x 31 pixels"


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
    expected["lpips"] = NO_LPIPS
    assert view_scores(view) == expected


def test_what_has_no_score_has_a_reason(monkeypatch: pytest.MonkeyPatch):
    view = views(1)[0]
    nothing = view_scores(replace(view, recorded=None))
    assert nothing == dict.fromkeys(("psnr", "ssim", "correlation", "lpips"), "there is no frame")
    assert set(view_scores(replace(view, recorded_depth=None))) == {"psnr", "ssim", "correlation", "lpips"}
    monkeypatch.setattr(scores, "lpips", lambda *_: 0.25)
    assert view_scores(view)["lpips"] == 0.25
    reason = "the render is a negative of the frame"
    unaligned = view_scores(replace(view, not_aligned=reason))
    assert [unaligned[name] for name in ("psnr", "ssim", "lpips")] == [reason] * 3
    assert all(unaligned[name] == view_scores(view)[name] for name in ("correlation", "depth_rmse"))


def test_means_and_deviations_are_those_of_numpy():
    of_each = [view_scores(view) for view in views()]
    means, not_scored = mean_scores(views(), with_std=True)
    names = ("psnr", "ssim", "correlation", "depth_rmse")
    assert mean_scores(views())[0] == {name: means[name] for name in names}
    assert set(means) == {*names, *(f"{name}_std" for name in names)}
    assert not_scored == {"lpips": {NO_LPIPS: [0, 1, 2]}}
    for name in names:
        values = np.array([one[name] for one in of_each])
        assert means[name] == pytest.approx(values.mean()) and means[f"{name}_std"] == pytest.approx(values.std())


def test_means_are_over_the_frames_that_have_a_score_and_the_others_are_named():
    faulty = views(5)
    assert faulty[1].recorded_depth is not None and faulty[4].recorded_depth is not None
    faulty[1].recorded_depth[:] = 0.0
    faulty[4].recorded_depth[:] = torch.nan
    faulty[2].rendered[0, 0] = faulty[2].unaligned[0, 0] = torch.nan
    faulty[3].unaligned[:] = 0.3
    faulty[3].depth[5, 5] = torch.inf
    table = summary_scores(faulty, {"fps": 2.0})
    assert table.pop("not_scored") == {
        "psnr": {"the render is not finite": [2]},
        "ssim": {"the render is not finite": [2]},
        "correlation": {"the render is not finite": [2], "what is rendered is flat": [3]},
        "lpips": {NO_LPIPS: [0, 1, 3, 4], "the render is not finite": [2]},
        "depth_rmse": {"no depth is known": [1, 4], "the rendered depth is not finite": [3]},
    }
    sound = views(5)
    left = {"psnr": [0, 1, 3, 4], "ssim": [0, 1, 3, 4], "correlation": [0, 1, 4], "depth_rmse": [0, 2]}
    for name, frames in left.items():
        values: list[Any] = [view_scores(sound[frame])[name] for frame in frames]
        assert table[name] == pytest.approx(np.mean(values))
    depths = [sound[frame].recorded_depth for frame in (0, 2, 3)]
    assert table["mean_depth"] == pytest.approx(np.mean([d[d > 0].mean().item() for d in depths if d is not None]))
    assert json.loads(json.dumps(table, allow_nan=False)) == table


def test_a_summary_has_a_place_for_what_is_missing():
    table = summary_scores(views(), {"fps": 2.0})
    assert table["lpips"] is None and table["fps"] == 2.0
    depths = [view.recorded_depth for view in views() if view.recorded_depth is not None]
    assert table["mean_depth"] == pytest.approx(np.mean([depth[depth > 0].mean().item() for depth in depths]))
    means = mean_scores(views())[0]
    assert {name: table[name] for name in means} == means

    nothing = [replace(view, recorded=None, recorded_depth=None) for view in views()]
    reasons = {name: {"there is no frame": [0, 1, 2]} for name in ("psnr", "ssim", "correlation", "lpips")}
    empty = {"psnr": None, "ssim": None, "lpips": None}
    table = summary_scores(nothing, {"event_correlation": 0.5})
    assert table == {**empty, "event_correlation": 0.5, "not_scored": reasons}
    flat = "what is rendered is flat"
    table = summary_scores(nothing, {"event_correlation": flat})
    assert table == {**empty, "not_scored": {**reasons, "event_correlation": {flat: []}}}


def test_nerfstudio_gets_what_is_a_number_and_prints_why_the_rest_is_not(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture
):
    metrics = run.pipeline.get_average_eval_image_metrics(output_path=tmp_path / "pictures", get_std=True)
    printed = capsys.readouterr().out
    assert len(list((tmp_path / "pictures").iterdir())) == 3
    table = summary_scores(*held_out_views(run.pipeline), with_std=True)
    not_scored = table.pop("not_scored")
    assert {"depth_rmse", "depth_rmse_std", "correlation", "fps", "brightness_scale"} <= set(metrics)
    speed = ("fps", "num_rays_per_sec")
    expected = {name: value for name, value in table.items() if value is not None and name not in speed}
    assert {name: value for name, value in metrics.items() if name not in speed} == expected
    assert isinstance(not_scored, dict) and "lpips" in not_scored
    for name, reasons in not_scored.items():
        for reason in reasons:
            assert f"No {name} of 3 of 3 frames (0, 1, 2): {reason}." in printed
    assert "depth_rmse_std" not in run.pipeline.get_average_eval_image_metrics()


def test_pictures_that_cannot_be_written_are_one_sentence(run: Run, tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit, match=r"^enerf: The folder of pictures .*file/pictures could not be written to \("):
        run.pipeline.get_average_eval_image_metrics(output_path=tmp_path / "file" / "pictures")
