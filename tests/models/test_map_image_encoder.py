# SPDX-License-Identifier: Apache-2.0
"""The encoder of pictures: sizes, alignment of its levels, and that looks do not know of each other."""

import dataclasses

import pytest
import torch
import torch.nn.functional as F

from manyeyes.datatypes import ConfigError
from manyeyes.models.maps.image_encoder import ImageEncoder, ImageEncoderConfig, ResidualBlock, upsample

TINY = ImageEncoderConfig((1, 1, 1), 8, channels=16)


@pytest.mark.parametrize("size", [(64, 112), (75, 101)])
@pytest.mark.parametrize(
    "config", [TINY, ImageEncoderConfig((1, 1), 8, True, 16), ImageEncoderConfig((1, 1), 8, channels=16, stride=4)]
)
def test_features_are_an_eighth_or_a_quarter_rounded_up(config, size):
    rgb = torch.randint(0, 256, (2, 3, *size), dtype=torch.uint8)
    out = ImageEncoder(config)(rgb)
    assert out.shape == (2, 16, -(-size[0] // config.stride), -(-size[1] // config.stride))
    assert bool((out >= 0).all()) and float(out.detach().std()) > 0


def test_image_is_independent_of_the_rest_of_its_batch():
    net = ImageEncoder(TINY).eval()
    rgb = torch.rand(3, 3, 40, 56) * 255
    assert torch.allclose(net(rgb)[1:2], net(rgb[1:2]), atol=1e-5)


@pytest.mark.parametrize("size", [(8, 10), (7, 9)])
def test_a_finer_map_keeps_every_cell_where_the_stride_took_it(size):
    ramp = torch.arange(float(size[1])).expand(1, 1, *size) + 10 * torch.arange(float(size[0]))[:, None]
    coarse = ramp[..., ::2, ::2]
    fine = upsample(coarse, size)
    assert fine.shape == ramp.shape
    # A ramp comes back exactly, but for a last cell beyond the last that was taken.
    assert torch.allclose(fine[..., : size[0] - 1, : size[1] - 1], ramp[..., : size[0] - 1, : size[1] - 1], atol=1e-5)
    if size[1] % 2:
        assert torch.allclose(fine, ramp, atol=1e-5)


@pytest.mark.parametrize("memory", [torch.contiguous_format, torch.channels_last])
def test_a_strided_block_takes_every_second_place_however_memory_lies(memory):
    # 12 channels innermost in memory, and a strided 1x1 convolution of them: its gradient overran its buffer in torch 2.13.
    x = torch.randn(2, 12, 9, 10).contiguous(memory_format=memory).requires_grad_()
    block = ResidualBlock(12, 12, 2)
    shortcut, norm = block.shortcut
    expected = torch.relu(norm(F.conv2d(x, shortcut.weight, stride=2)) + block.inner(x))
    assert torch.allclose(block(x), expected, atol=1e-5) and expected.shape == (2, 12, 5, 5)
    (mine,) = torch.autograd.grad(block(x).square().sum(), x)
    (plain,) = torch.autograd.grad(block(x.contiguous()).square().sum(), x)
    assert torch.allclose(mine, plain, atol=1e-4)


def test_fifty_layers_have_their_published_width():
    net = ImageEncoder(ImageEncoderConfig((3, 4, 6, 3), 64, True, 256))
    body = sum(p.numel() for part in (net.stem, net.stages) for p in part.parameters())
    # ResNet-50 without its classifier has 23,508,032 parameters (He et al. 2016).
    assert body == 23_508_032


def test_one_stage_is_refused():
    with pytest.raises(ConfigError, match="two or more stages"):
        ImageEncoderConfig((2,))


@pytest.mark.slow
def test_recomputation_is_bitwise_equal_and_updates_running_statistics_once():
    config = ImageEncoderConfig((2, 1), 8, True, 16)
    kept, again = ImageEncoder(config), ImageEncoder(dataclasses.replace(config, gradient_checkpointing=True))
    again.load_state_dict(kept.state_dict())
    rgb = torch.randint(0, 256, (3, 3, 40, 56), dtype=torch.uint8)
    outs = [net.train()(rgb) for net in (kept, again)]
    for net, out in zip((kept, again), outs):
        out.square().sum().backward()
        assert all(bool((p.grad != 0).any()) for name, p in net.named_parameters() if "weight" in name)
    assert torch.equal(*outs)
    assert all(torch.equal(p.grad, q.grad) for p, q in zip(kept.parameters(), again.parameters(), strict=True))
    assert all(torch.equal(p, q) for p, q in zip(kept.state_dict().values(), again.state_dict().values(), strict=True))
    assert all(module.momentum for module in again.modules() if isinstance(module, torch.nn.BatchNorm2d))
    with torch.no_grad():
        assert torch.equal(kept.eval()(rgb), again.eval()(rgb))


def test_fewer_activations_are_kept_where_they_are_computed_again():
    def kept_bytes(recompute):
        sizes = []

        def pack(x):
            sizes.append(x.nbytes)
            return x

        net = ImageEncoder(ImageEncoderConfig((2, 2), 8, True, 16, gradient_checkpointing=recompute)).train()
        own = {p.data_ptr() for p in net.parameters()}
        with torch.autograd.graph.saved_tensors_hooks(lambda x: pack(x) if x.data_ptr() not in own else x, lambda x: x):
            net(torch.zeros(2, 3, 64, 64))
        return sum(sizes)

    assert kept_bytes(True) < kept_bytes(False) / 2
