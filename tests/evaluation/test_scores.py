from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio

from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.evaluation import scores
from enerf_ns.evaluation.metrics import correlation, depth_rmse, psnr, ssim
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, PROTOCOLS, align, described
from enerf_ns.evaluation.scores import mean_scores, summary_scores, view_scores
from enerf_ns.evaluation.views import HeldOutView, aligned_views
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.runs import Run

NO_LPIPS = "the frame is smaller than 31 x 31 pixels"


def views(number: int = 3) -> list[HeldOutView]:
    """Random pictures, renders that are like them but darker and noisy; depth is known but at one pixel."""
    generator = torch.Generator().manual_seed(0)
    made = []
    for time in range(number):
        recorded, noise = (torch.rand(16, 20, 3, generator=generator) for _ in range(2))
        depth, recorded_depth = (1 + torch.rand(16, 20, 1, generator=generator) for _ in range(2))
        recorded_depth[0, 0] = 0.0
        made.append(HeldOutView(recorded, 0.6 * recorded * (0.5 + noise), depth, recorded_depth, time))
    return made


def scored(made: list[HeldOutView], protocol: str = DEFAULT_PROTOCOL) -> list[dict[str, Any]]:
    """Scores of each view."""
    return [view_scores(*both, protocol) for both in zip(made, aligned_views(made, protocol)[0], strict=True)]


def test_scores_of_a_view_are_of_the_aligned_render_but_the_correlation_of_the_render_as_it_is():
    made = views()
    recorded: Any = [view.recorded for view in made]
    aligned = align([view.rendered for view in made], recorded, DEFAULT_PROTOCOL)
    for scores_, view, picture, truth in zip(scored(made), made, aligned.rendered, recorded, strict=True):
        clipped, recorded_depth = picture.clamp(0.0, 1.0), view.recorded_depth
        assert view.depth is not None and recorded_depth is not None and (clipped != picture).any()
        assert scores_ == {
            "psnr": psnr(clipped, truth),
            "ssim": ssim(clipped, truth),
            "lpips": NO_LPIPS,
            "correlation": correlation(view.rendered, truth),
            "depth_rmse": depth_rmse(view.depth, recorded_depth),
        }


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_psnr_of_a_protocol_is_that_of_scikit_image(protocol: str):
    """Clipped or not, of each picture or of all pixels together, as each of the sources has it."""
    made = views()
    aligned, parameters = aligned_views(made, protocol)
    table = summary_scores(made, {}, protocol=protocol)
    pairs = [(view.rendered.numpy(), view.recorded.numpy()) for view in aligned if view.recorded is not None]
    unclipped = protocol in ("eventnerf", "gamma-affine")
    clipped = [(a if unclipped else a.clip(0, 1), b) for a, b in pairs]
    if protocol != "raw":
        assert any((a < 0).any() or (a > 1).any() for a, _ in pairs), "clipping makes a difference"
    if protocol == "eventnerf":
        expected = peak_signal_noise_ratio(*(np.stack(images) for images in zip(*clipped, strict=True)), data_range=1.0)
    else:
        expected = np.mean([peak_signal_noise_ratio(b, a, data_range=1.0) for a, b in clipped])
    assert table["psnr"] == pytest.approx(expected, abs=1e-4)
    similar = [ssim(torch.from_numpy(a).clamp(0, 1), torch.from_numpy(b)) for a, b in pairs]
    assert table["ssim"] == pytest.approx(np.mean(similar))  # type: ignore[arg-type]
    assert table["protocol"] == protocol and {name: table[name] for name in parameters} == parameters


def test_what_has_no_score_has_a_reason(monkeypatch: pytest.MonkeyPatch):
    view = views(1)[0]
    (nothing,) = scored([replace(view, recorded=None)])
    assert nothing == dict.fromkeys(("psnr", "ssim", "correlation", "lpips"), "there is no frame")
    assert set(scored([replace(view, recorded_depth=None)])[0]) == {"psnr", "ssim", "correlation", "lpips"}
    monkeypatch.setattr(scores, "lpips", lambda a, b, net: {"alex": 0.25, "vgg": 0.5}[net])
    assert scored([view])[0]["lpips"] == 0.25
    both = mean_scores([view], lpips_nets=("alex", "vgg"))[0]
    assert both["lpips"] == 0.25 and both["lpips_vgg"] == 0.5
    assert "lpips" not in mean_scores([view], lpips_nets=("vgg",))[0]
    (negative,) = scored([replace(view, rendered=0.7 - view.rendered)])
    assert all(str(negative[name]).startswith("the render is a negative") for name in ("psnr", "ssim", "lpips"))
    assert all(isinstance(negative[name], float) for name in ("correlation", "depth_rmse"))
    (untouched,) = scored([replace(view, rendered=0.7 - view.rendered)], "raw")
    assert isinstance(untouched["psnr"], float)


def test_a_crop_alone_is_fitted_and_scored():
    made = views()
    cut = [
        replace(view, **{name: getattr(view, name)[2:14, 3:17] for name in fields})
        for view in made
        for fields in [("recorded", "rendered", "depth", "recorded_depth")]
    ]
    spoilt = views()
    for view in spoilt:
        view.rendered[:2], view.rendered[:, :3] = 0.0, torch.nan
    expected = summary_scores(cut, {})
    assert summary_scores(made, {}, crop=(12, 14)) == summary_scores(spoilt, {}, crop=(12, 14)) == expected
    assert mean_scores(made, crop=(12, 14)) == mean_scores(cut)
    assert summary_scores(made, {}, crop=(16, 20)) == summary_scores(made, {})
    for crop in ((17, 20), (16, 21), (0, 20)):
        with pytest.raises(FlagError, match=r"pixels \(height, width\) does not lie in held-out frames of 16 x 20;"):
            summary_scores(made, {}, crop=crop)


def test_means_and_deviations_are_those_of_numpy():
    of_each = scored(views())
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
    faulty[2].rendered[0, 0] = torch.nan
    assert faulty[3].depth is not None
    faulty[3].depth[5, 5] = torch.inf
    table = summary_scores(faulty, {"fps": 2.0})
    assert table.pop("not_scored") == {
        "psnr": {"the render is not finite": [2]},
        "ssim": {"the render is not finite": [2]},
        "correlation": {"the render is not finite": [2]},
        "lpips": {NO_LPIPS: [0, 1, 3, 4], "the render is not finite": [2]},
        "depth_rmse": {"no depth is known": [1, 4], "the rendered depth is not finite": [3]},
    }
    sound = [view for number, view in enumerate(views(5)) if number != 2]
    for name in ("psnr", "ssim", "correlation"):
        assert table[name] == pytest.approx(mean_scores(sound)[0][name])
    known = [scored(views(5))[frame]["depth_rmse"] for frame in (0, 2)]
    assert table["depth_rmse"] == pytest.approx(np.mean(known))
    sound = views(5)
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
    empty: dict[str, Any] = {"psnr": None, "ssim": None, "lpips": None}
    table = summary_scores(nothing, {"event_correlation": 0.5})
    empty["protocol"] = "events"
    assert table == {**empty, "event_correlation": 0.5, "not_scored": reasons}
    flat = "the rendered values are all equal"
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
    assert {"depth_rmse", "depth_rmse_std", "correlation", "fps", "held_out_on_path"} <= set(metrics)
    assert metrics["protocol"] == DEFAULT_PROTOCOL and described(DEFAULT_PROTOCOL) in printed
    speed = ("fps", "num_rays_per_sec")
    expected = {name: value for name, value in table.items() if value is not None and name not in speed}
    assert {name: value for name, value in metrics.items() if name not in speed} == expected
    assert isinstance(not_scored, dict) and "lpips" in not_scored
    for name, reasons in not_scored.items():
        for reason in reasons:
            assert f"No {name} of 3 of 3 frames (0, 1, 2): {reason}." in printed
    while_training = run.pipeline.get_average_eval_image_metrics(step=1)
    assert "depth_rmse_std" not in while_training, "as asked"
    assert all(isinstance(value, (int, float)) for value in while_training.values()), "as Nerfstudio logs them"


def test_pictures_that_cannot_be_written_are_one_sentence(run: Run, tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit, match=r"^enerf: The folder of pictures .*file/pictures could not be written to \("):
        run.pipeline.get_average_eval_image_metrics(output_path=tmp_path / "file" / "pictures")
