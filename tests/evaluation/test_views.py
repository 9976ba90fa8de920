from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from enerf_ns.dataparsers.recording.errors import OutputError
from enerf_ns.evaluation.views import HeldOutView, aligned_views, save_pictures
from enerf_ns.sensor.response import inverse_linlog, linlog


@pytest.fixture
def views() -> list[HeldOutView]:
    """Three, of renders that are darker to the right, and frames with less contrast, some noise and another level."""
    generator, depth = torch.Generator().manual_seed(0), torch.ones(24, 32, 1)
    renders = [torch.linspace(0.5, 0.1, 32).expand(24, 32)[..., None].repeat(1, 1, 3) + 0.1 * n for n in (1, 2, 3)]
    frames = [0.2 + 0.6 * render + 0.1 * torch.rand(render.shape, generator=generator) for render in renders]
    return [
        HeldOutView(frame, render, depth, None, time)
        for time, (frame, render) in enumerate(zip(frames, renders, strict=True))
    ]


def test_renders_are_aligned_once_over_all_views(views: list[HeldOutView]):
    aligned, parameters = aligned_views(views)
    x, y = (
        linlog(torch.stack([getattr(view, name) for view in views]).double()).flatten().numpy()
        for name in ("rendered", "recorded")
    )
    scale, offset = np.polyfit(x, y, 1)
    assert parameters == pytest.approx({"brightness_scale": scale, "brightness_offset": offset}, rel=1e-6)
    for view, shown_view in zip(views, aligned, strict=True):
        expected = inverse_linlog(scale * linlog(view.rendered.double()) + offset).float()
        torch.testing.assert_close(shown_view.rendered, expected, rtol=0, atol=1e-6)
        assert shown_view.not_aligned is None and shown_view.time == view.time


def test_one_render_that_is_not_finite_is_left_as_it_is_and_the_others_are_aligned_as_without(
    views: list[HeldOutView],
):
    without, parameters = aligned_views([views[0], views[2]])
    views[1].rendered = views[1].rendered.clone()
    views[1].rendered[5, 6] = torch.nan
    aligned, found = aligned_views(views)
    assert found == parameters
    for view, expected in zip((aligned[0], aligned[2]), without, strict=True):
        torch.testing.assert_close(view.rendered, expected.rendered, rtol=0, atol=0)
    assert aligned[1].rendered.isnan().sum() == 3 and all(view.not_aligned is None for view in aligned)


def test_a_negative_and_what_is_flat_is_shown_as_it_is_and_why(views: list[HeldOutView]):
    for change, reason in (
        (lambda rgb: 1.2 - rgb, "the render is a negative of the frame (brightness scale -"),
        (lambda rgb: 0.0 * rgb, "no correction of brightness can be fitted, since the render or the frame is flat"),
    ):
        changed = [replace(view, rendered=change(view.rendered)) for view in views]
        aligned, parameters = aligned_views(changed)
        assert parameters == {}
        for view, shown_view in zip(changed, aligned, strict=True):
            assert shown_view.not_aligned is not None and shown_view.not_aligned.startswith(reason)
            torch.testing.assert_close(shown_view.rendered, view.rendered, rtol=0, atol=0)


def test_the_median_depth_is_of_what_is_known():
    rendered = torch.tensor([[1.0, 2.0], [5.0, torch.inf]])[..., None]
    recorded = torch.tensor([[0.0, 7.0], [7.0, 9.0]])[..., None]
    picture = torch.zeros(2, 2, 3)
    assert HeldOutView(picture, picture, rendered, recorded, 0).median_depth == 7.0
    assert HeldOutView(picture, picture, rendered, 0.0 * recorded, 0).median_depth == 2.0
    assert HeldOutView(picture, picture, torch.nan * rendered, None, 0).median_depth == 1.0


def test_pictures_show_the_frame_beside_the_render(tmp_path: Path):
    generator = torch.Generator().manual_seed(0)
    recorded, rendered = (torch.rand(4, 5, 3, generator=generator) for _ in range(2))
    depth = torch.ones(4, 5, 1)
    views = [
        HeldOutView(recorded, 2 * rendered - 0.5, depth, None, 0),
        HeldOutView(None, rendered, depth, None, 1),
    ]
    save_pictures(views, tmp_path / "new" / "pictures")
    pictures = [np.asarray(Image.open(file)) for file in sorted((tmp_path / "new" / "pictures").iterdir())]
    np.testing.assert_array_equal(pictures[0][:, :5], np.rint(255 * recorded.numpy()))
    np.testing.assert_array_equal(pictures[0][:, 5:], np.rint(255 * (2 * rendered.numpy() - 0.5).clip(0, 1)))
    np.testing.assert_array_equal(pictures[1], np.rint(255 * rendered.numpy()))
    assert (tmp_path / "new" / "pictures" / "eval_img_0001.png").is_file()


def test_a_full_disk_leaves_no_half_of_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(path: Path, content: bytes) -> int:
        with open(path, "wb") as file:
            file.write(content[:10])
        raise OSError(errno.ENOSPC, "No space left on device")

    picture = torch.full((4, 5, 3), torch.nan)
    view = HeldOutView(None, picture, torch.ones(4, 5, 1), None, 0)
    save_pictures([view], tmp_path)
    assert not np.asarray(Image.open(tmp_path / "eval_img_0000.png")).any(), "what is not finite is black"
    before = (tmp_path / "eval_img_0000.png").read_bytes()
    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(
        OutputError, match=r"^The folder of pictures .* \(No space left on device\); give another one\.$"
    ):
        save_pictures([view, view], tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["eval_img_0000.png"]
    assert (tmp_path / "eval_img_0000.png").read_bytes() == before
