from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
import torchmetrics
import torchvision
from torch.nn.functional import conv2d, max_pool2d, relu
from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

from enerf_ns.evaluation.lpips import NETWORKS, Net, load_lpips, lpips, torchvision_file
from enerf_ns.scripts import cli

WEIGHTS_VARIABLE, SMALLEST_SIDE = NETWORKS["alex"].weights_variable, NETWORKS["alex"].smallest_side


@pytest.fixture(autouse=True)
def load_anew():
    load_lpips.cache_clear()
    yield
    load_lpips.cache_clear()


@pytest.fixture
def weights(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, torch.Tensor]:
    path = shared_data / "lpips" / "alexnet_features.pth"
    if not path.is_file():
        pytest.skip(f"no AlexNet weights at {path}")
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(path))
    return torch.load(path, weights_only=True)


def noisy(image: torch.Tensor, amount: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return (image + amount * torch.randn(image.shape, generator=generator)).clamp(0, 1)


IMAGE = torch.rand(64, 80, 3, generator=torch.Generator().manual_seed(0))


def test_distance_grows_with_noise_from_zero(weights):
    distances = [lpips(noisy(IMAGE, amount), IMAGE) for amount in (0.0, 0.1, 0.3)]
    assert distances[0] == 0.0
    assert 0.0 < distances[1] < distances[2]  # type: ignore[operator]


def test_distance_equals_the_definition_written_out(weights):
    """Zhang et al., CVPR 2018, equation 1, with AlexNet's five layers and the linear heads that torchmetrics brings."""
    folder = Path(torchmetrics.__file__).parent / "functional" / "image" / "lpips_models"
    heads = torch.load(folder / "alex.pth", map_location="cpu", weights_only=True)
    shift = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)

    def features(image: torch.Tensor) -> list[torch.Tensor]:
        x = ((2 * image.movedim(-1, 0)[None] - 1) - shift) / scale
        layers = []
        for number, stride, padding, pool in ((0, 4, 2, 0), (3, 1, 2, 1), (6, 1, 1, 1), (8, 1, 1, 0), (10, 1, 1, 0)):
            x = max_pool2d(x, 3, 2) if pool else x
            x = relu(conv2d(x, weights[f"{number}.weight"], weights[f"{number}.bias"], stride, padding))
            layers.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + 1e-8))
        return layers

    distorted = noisy(IMAGE, 0.2)
    expected = 0.0
    with torch.no_grad():
        for i, (one, other) in enumerate(zip(features(distorted), features(IMAGE), strict=True)):
            expected += conv2d((one - other) ** 2, heads[f"lin{i}.model.1.weight"]).mean().item()
    assert expected > 0.01
    assert lpips(distorted, IMAGE) == pytest.approx(expected, rel=1e-4)


def test_weights_from_a_file_download_nothing_and_leave_the_folder_of_downloads_as_it_is(
    weights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    before = torch.hub.get_dir()
    torch.hub.set_dir(tmp_path)
    monkeypatch.setattr("urllib.request.urlopen", lambda *_, **__: pytest.fail("a download"))
    try:
        assert lpips(IMAGE, IMAGE) == 0.0
        assert torch.hub.get_dir() == str(tmp_path) and not list(tmp_path.iterdir())
    finally:
        torch.hub.set_dir(before)


def test_distances_do_not_depend_on_those_before(weights):
    first = lpips(noisy(IMAGE, 0.1), IMAGE)
    lpips(noisy(IMAGE, 0.5), IMAGE)
    assert lpips(noisy(IMAGE, 0.1), IMAGE) == first


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_render_that_is_not_finite_has_no_distance(weights, value: float):
    rendered = IMAGE.clone()
    rendered[3, 4, 1] = value
    assert lpips(rendered, IMAGE) == "the render is not finite"
    assert lpips(IMAGE + 1e-6, IMAGE + 1e-6) == 0.0, "a rounding error beyond 1 is none"


def test_pictures_have_a_distance_from_the_size_on_that_alexnet_takes(weights):
    small = IMAGE[:SMALLEST_SIDE, :SMALLEST_SIDE]
    assert isinstance(lpips(noisy(small, 0.1), small), float)
    for smaller in (small[:-1], small[:, :-1]):
        assert lpips(smaller, smaller) == "the frame is smaller than 31 x 31 pixels"
        with pytest.raises(RuntimeError, match="too small"):
            load_lpips("alex")(*[smaller.movedim(-1, 0)[None]] * 2)  # type: ignore[misc]


@pytest.fixture
def random_vgg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> torch.nn.Module:
    """VGG-16 with random features, which the variable names."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = torchvision.models.vgg16(weights=None)
    torch.save(model.features.state_dict(), tmp_path / "vgg.pth")
    monkeypatch.setenv(NETWORKS["vgg"].weights_variable, str(tmp_path / "vgg.pth"))
    return model


def test_vgg_is_torchmetrics_with_the_weights_of_the_file(random_vgg: torch.nn.Module, monkeypatch: pytest.MonkeyPatch):
    """Torchmetrics' own class, whose network is given the same weights in memory."""
    found = lpips(noisy(IMAGE, 0.2), IMAGE, "vgg")
    monkeypatch.setattr(torchvision.models, "vgg16", lambda weights: random_vgg)
    own = LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=True)
    pictures = [image.movedim(-1, 0)[None] for image in (noisy(IMAGE, 0.2), IMAGE)]
    assert found == pytest.approx(float(own(*pictures)), rel=1e-6) and float(own(*pictures)) > 0.0
    assert lpips(IMAGE, IMAGE, "vgg") == 0.0


def test_pictures_have_a_distance_from_the_size_on_that_vgg_takes(random_vgg: torch.nn.Module):
    side = NETWORKS["vgg"].smallest_side
    small = IMAGE[:side, :side]
    assert isinstance(lpips(noisy(small, 0.1), small, "vgg"), float)
    for smaller in (small[:-1], small[:, :-1]):
        assert lpips(smaller, smaller, "vgg") == f"the frame is smaller than {side} x {side} pixels"
        with pytest.raises(RuntimeError, match="too small"):
            load_lpips("vgg")(*[smaller.movedim(-1, 0)[None]] * 2)  # type: ignore[misc]


def test_one_network_without_weights_leaves_the_other_as_it_is(
    random_vgg: torch.nn.Module, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "nothing"))
    assert str(lpips(IMAGE, IMAGE)).endswith("nothing, is missing") and lpips(IMAGE, IMAGE, "vgg") == 0.0


@pytest.mark.parametrize("net", NETWORKS)
@pytest.mark.parametrize("content", [None, b"", b"no weights"])
def test_without_weights_the_reason_is_told_and_nothing_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, content: bytes | None, net: Net
):
    path, found = tmp_path / "weights.pth", "is missing" if content is None else "does not hold its weights"
    if content is not None:
        path.write_bytes(content)
    variable = NETWORKS[net].weights_variable
    monkeypatch.setenv(variable, str(path))
    assert lpips(IMAGE, IMAGE, net) == f"the file of {variable}, {path}, {found}"
    assert "".join(capsys.readouterr()) == ""


@pytest.fixture
def published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Random weights of AlexNet at the address from which torchvision downloads them: that of a file. Nothing is in
    torchvision's folder of downloads yet."""
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)
    torch.save(torchvision.models.alexnet(weights=None).state_dict(), tmp_path / "weights")
    digest = hashlib.sha256((tmp_path / "weights").read_bytes()).hexdigest()[:8]
    file = (tmp_path / "weights").rename(tmp_path / f"alexnet-{digest}.pth")
    monkeypatch.setattr(torchvision.models.AlexNet_Weights.DEFAULT.value, "url", file.as_uri())
    before = torch.hub.get_dir()
    torch.hub.set_dir(tmp_path / "hub")
    yield file
    torch.hub.set_dir(before)


def fetch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["enerf", "fetch-lpips"])
    cli.entrypoint()


def test_weights_are_fetched_by_a_command_alone(
    published: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    assert lpips(IMAGE, IMAGE) == "its weights are not here; get them by enerf fetch-lpips alex"
    stored = torchvision_file(NETWORKS["alex"])
    for broken in (None, b"", published.read_bytes()[:1000]):
        if broken is not None:
            stored.write_bytes(broken)
            load_lpips.cache_clear()
            assert lpips(IMAGE, IMAGE) == "its weights cannot be read; get them by enerf fetch-lpips alex"
        fetch(monkeypatch)
        assert capsys.readouterr().out.splitlines()[-1] == f"The weights of LPIPS with alex are in {stored}"
        assert stored.read_bytes() == published.read_bytes()
    published.unlink()
    fetch(monkeypatch)  # nothing is downloaded any more
    load_lpips.cache_clear()
    own = LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)  # with the same, by its own way
    pictures = [image.movedim(-1, 0)[None] for image in (noisy(IMAGE, 0.2), IMAGE)]
    assert lpips(noisy(IMAGE, 0.2), IMAGE) == pytest.approx(float(own(*pictures)), rel=1e-6)


def test_weights_that_cannot_be_fetched_are_one_sentence(published: Path, monkeypatch: pytest.MonkeyPatch):
    published.unlink()
    with pytest.raises(SystemExit, match=r"could not be downloaded to .*; download it where there is a network, and"):
        fetch(monkeypatch)


def test_weights_that_do_not_fit_are_no_distance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    torch.save({"0.weight": torch.zeros(3)}, tmp_path / "weights.pth")
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "weights.pth"))
    assert str(lpips(IMAGE, IMAGE)).endswith("weights.pth, does not hold its weights")
