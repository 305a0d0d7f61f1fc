"""The compiled renderer against its twin in torch, and against laws of its own."""

from dataclasses import replace

import pytest
import torch
from cgwm.pipeline.rendering import raster_host, raster_reference
from cgwm.pipeline.rendering.tiles import TiledScene, Tiles, tile_pairs
from cgwm.pipeline.runtime import kernel_build

pytestmark = pytest.mark.skipif(kernel_build.host_unavailable() is not None, reason="needs a C++ compiler")

EXACT = {"min_alpha": 0.0, "min_transmittance": 0.0}


def scene(dtype=torch.float64, count=300, size=8, by_camera=False, **thresholds) -> TiledScene:
    """A crowd of spheres of all sizes and opacities, some of them behind or beside one of two cameras of two kinds."""
    generator = torch.Generator().manual_seed(0)
    local = torch.randn(2, count, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.5, 0.4, 0.4])
    local[..., 2] += 1.2
    K = torch.tensor([[[70.0, 0, 38.0], [0, 72.0, 25.5], [0, 0, 1]]], dtype=torch.float64).repeat(2, 1, 1)
    K[1, 0, 2] += 1.5
    shape = (2, count, 4) if by_camera else (count, 4)
    values = {"min_alpha": 1 / 255, "min_transmittance": 1e-4, "group_transmittance": 0.0} | thresholds
    return TiledScene(
        local=local.to(dtype),
        scales=(0.01 + 0.1 * torch.rand(count, generator=generator, dtype=torch.float64) ** 4).to(dtype),
        opacities=(1.2 * torch.rand(count, generator=generator, dtype=torch.float64)).clamp_max(1).to(dtype),
        features=torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype),
        tiles=Tiles.make(K.to(dtype), None, 75, 51, size),
        groups=(slice(0, 100), slice(40, count)),
        median=True,
        **values,
    )


def results_and_gradients(draw, given: TiledScene) -> list[torch.Tensor]:
    leaves = {key: getattr(given, key).clone().requires_grad_() for key in ("local", "scales", "opacities", "features")}
    drawn = draw(replace(given, **leaves))
    weights = torch.randn(drawn.values.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    loss = (drawn.values * weights.to(drawn.values)).sum() + (drawn.alpha * weights[..., 0].to(drawn.alpha)).sum()
    slopes = torch.autograd.grad(loss, list(leaves.values()))
    return [drawn.values.detach(), drawn.alpha.detach(), drawn.median, drawn.alone, *slopes]


@pytest.mark.parametrize(
    "given",
    [
        pytest.param({}, id="thresholds"),
        pytest.param(EXACT | {"by_camera": True}, id="features by camera"),
        pytest.param({"size": 6}, id="fewer pixels than a block"),
        pytest.param({"size": 20, "min_transmittance": 0.0}, id="several blocks a tile"),
    ],
)
def test_results_and_gradients_equal_the_twin(given):
    mine, other = (results_and_gradients(one.draw, scene(**given)) for one in (raster_host, raster_reference))
    assert other[1].amax() > 1 - 1e-4, "some pixels are full, so that the threshold acts"
    torch.testing.assert_close(mine, other, atol=1e-10, rtol=1e-9)


def test_single_precision_equals_double():
    mine = results_and_gradients(raster_host.draw, scene(torch.float32, **EXACT))
    other = results_and_gradients(raster_reference.draw, scene(**EXACT))
    for a, b in zip(mine[:2] + mine[4:], other[:2] + other[4:], strict=True):
        torch.testing.assert_close(a.double(), b, atol=1e-4 * float(b.abs().amax()), rtol=0)


def test_lists_of_tiles_equal_the_twin():
    given = scene(count=2000)
    tile, camera, sphere = tile_pairs(given.local, given.scales, given.opacities, given.tiles, given.min_alpha)
    lists = raster_host._Lists.of(given)
    order = torch.argsort(tile, stable=True)
    assert torch.equal(lists.counts, torch.bincount(tile, minlength=len(lists.counts)))
    assert torch.equal(lists.places, (camera * 2000 + sphere)[order])
    assert 2 * 2000 < len(tile) < 0.2 * len(lists.counts) * 2000, "some spheres meet some tiles"


def test_threads_change_nothing(monkeypatch):
    monkeypatch.setattr(raster_host, "PAIRS_PER_THREAD", 1)
    monkeypatch.setattr(raster_host, "SPHERES_PER_THREAD", 1)
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(raster_host, "kernel_threads", lambda count=threads: count)
        found.append(results_and_gradients(raster_host.draw, scene()))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_nothing_is_drawn_without_spheres():
    given = scene(count=0)
    drawn = raster_host.draw(replace(given, groups=()))
    assert float(drawn.values.abs().sum() + drawn.alpha.abs().sum()) == 0


def test_a_program_that_does_not_load_is_said_once_and_torch_renders(monkeypatch, caplog):
    def broken(single):
        raise OSError("undefined symbol: __cpu_model")

    monkeypatch.setattr(raster_host, "_library", broken)
    raster_host.unavailable.cache_clear()
    like = torch.zeros(1)
    assert not raster_host.supported(like)
    assert not raster_host.supported(like)
    raster_host.unavailable.cache_clear()
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "undefined symbol: __cpu_model. PyTorch renders instead" in caplog.text
