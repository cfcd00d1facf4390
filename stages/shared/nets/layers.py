"""Building blocks of the StyleGAN2 family: equalised and modulated convolutions, blur, Haar wavelets.

Every block is written in plain torch operations, so it runs on any device and in any float type. Parameters
are kept at unit variance and scaled at run time ("equalised learning rate", Karras et al. 2018, sec. 4.1).
Images are (B, C, H, W).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

_BINOMIAL = (1.0, 3.0, 3.0, 1.0)


def leaky(features: Tensor, bias: Tensor | None = None) -> Tensor:
    """√2 · leaky_relu(x + b, 0.2): keeps the variance of a unit-variance input. Shapes (B, C, ...), (C,)."""
    if bias is not None:
        features = features + bias.view(1, -1, *([1] * (features.ndim - 2)))
    return functional.leaky_relu(features, 0.2) * math.sqrt(2.0)


def blur(image: Tensor, pad: tuple[int, int], gain: float = 1.0, stride: int = 1) -> Tensor:
    """Separable [1 3 3 1] binomial filter of unit sum times `gain`; `pad` (before, after) on both axes.

    Output side is (side + pad[0] + pad[1] − 3), divided by `stride`.
    """
    channels = image.shape[1]
    taps = torch.tensor(_BINOMIAL, dtype=image.dtype, device=image.device)
    taps = taps * (math.sqrt(gain) / taps.sum())
    if pad[0] == pad[1]:
        before = (pad[0], pad[1])
    else:
        image = functional.pad(image, (pad[0], pad[1], pad[0], pad[1]))
        before = (0, 0)
    column = taps.view(1, 1, 4, 1).expand(channels, 1, 4, 1)
    row = taps.view(1, 1, 1, 4).expand(channels, 1, 1, 4)
    image = functional.conv2d(image, column, stride=(stride, 1), padding=(before[0], 0), groups=channels)
    return functional.conv2d(image, row, stride=(1, stride), padding=(0, before[0]), groups=channels)


def halve(image: Tensor) -> Tensor:
    """Blur and keep every second pixel: (B, C, H, W) -> (B, C, H/2, W/2)."""
    return blur(image, (1, 1), stride=2)


def double(image: Tensor) -> Tensor:
    """Insert zeros and blur: (B, C, H, W) -> (B, C, 2H, 2W); keeps a constant image constant inside."""
    batch, channels, height, width = image.shape
    spread = image.new_zeros(batch, channels, height, 2, width, 2)
    spread[:, :, :, 0, :, 0] = image
    return blur(spread.view(batch, channels, 2 * height, 2 * width), (2, 1), gain=4.0)


def haar(image: Tensor) -> Tensor:
    """Orthonormal 2×2 Haar bands: (B, C, 2H, 2W) -> (B, 4C, H, W), bands LL, LH, HL, HH along channels."""
    a, b = image[:, :, 0::2, 0::2], image[:, :, 0::2, 1::2]
    c, d = image[:, :, 1::2, 0::2], image[:, :, 1::2, 1::2]
    bands = (a + b + c + d, a - b + c - d, a + b - c - d, a - b - c + d)
    return torch.cat(bands, dim=1) * 0.5


def inverse_haar(bands: Tensor) -> Tensor:
    """Inverse of `haar`: (B, 4C, H, W) -> (B, C, 2H, 2W)."""
    batch, channels, height, width = bands.shape
    low, horizontal, vertical, diagonal = bands.chunk(4, dim=1)
    pixels = torch.stack(
        (
            low + horizontal + vertical + diagonal,
            low - horizontal + vertical - diagonal,
            low + horizontal - vertical - diagonal,
            low - horizontal - vertical + diagonal,
        ),
        dim=2,
    )  # (B, C, 4, H, W), the order pixel_shuffle expects
    pixels = (pixels * 0.5).reshape(batch, channels, height, width)
    return functional.pixel_shuffle(pixels, 2)


class EqualLinear(nn.Module):
    """Linear layer with equalised learning rate; `lr_multiplier` slows it down (mapping network)."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        bias_init: float = 0.0,
        lr_multiplier: float = 1.0,
        activate: bool = False,
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs) / lr_multiplier)
        self.bias = nn.Parameter(torch.full((outputs,), float(bias_init)))
        self.weight_scale = lr_multiplier / math.sqrt(inputs)
        self.bias_scale = lr_multiplier
        self.activate = activate

    def forward(self, values: Tensor) -> Tensor:
        result = functional.linear(values, self.weight * self.weight_scale, self.bias * self.bias_scale)
        return leaky(result) if self.activate else result


class EncoderConv(nn.Module):
    """[blur, stride 2 if `down`] equalised convolution without bias, then biased leaky ReLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int, down: bool = False) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, kernel, kernel))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.scale = 1.0 / math.sqrt(inputs * kernel * kernel)
        self.down = down
        self.padding = 0 if down else kernel // 2

    def forward(self, image: Tensor) -> Tensor:
        stride = 1
        if self.down:
            image, stride = blur(image, (2, 2)), 2
        image = functional.conv2d(image, self.weight * self.scale, stride=stride, padding=self.padding)
        return leaky(image, self.bias)


class ModulatedConv(nn.Module):
    """Convolution whose input channels are scaled by a style; `demodulate` renormalises each output filter.

    The style is one vector for the whole batch (it is a learned constant here), so the weights are modulated
    once and an ordinary convolution does the work.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int, style: int, demodulate: bool = True, up: bool = False
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, kernel, kernel))
        self.modulation = EqualLinear(style, inputs, bias_init=1.0)
        self.scale = 1.0 / math.sqrt(inputs * kernel * kernel)
        self.demodulate = demodulate
        self.up = up
        self.padding = kernel // 2

    def forward(self, image: Tensor, style: Tensor) -> Tensor:
        weight = self.weight * (self.scale * self.modulation(style)).view(1, -1, 1, 1)
        if self.demodulate:
            norm = torch.rsqrt(weight.square().sum(dim=(1, 2, 3), keepdim=True) + 1e-8)
            weight = weight * norm
        if not self.up:
            return functional.conv2d(image, weight, padding=self.padding)
        image = functional.conv_transpose2d(image, weight.transpose(0, 1), stride=2)
        return blur(image, (1, 1), gain=4.0)


class StyledConv(nn.Module):
    """Modulated 3×3 convolution, a fixed noise image times a learned weight, biased leaky ReLU."""

    def __init__(self, inputs: int, outputs: int, style: int, up: bool = False) -> None:
        super().__init__()
        self.conv = ModulatedConv(inputs, outputs, 3, style, up=up)
        self.noise_weight = nn.Parameter(torch.zeros(1))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, image: Tensor, style: Tensor, noise: Tensor) -> Tensor:
        return leaky(self.conv(image, style) + self.noise_weight * noise, self.bias)


class ToBands(nn.Module):
    """1×1 modulated convolution (no demodulation) to Haar bands, added to the upsampled bands so far.

    The weights start at zero, so a fresh network answers 0 and training starts at the base attributes.
    """

    def __init__(self, inputs: int, outputs: int, style: int) -> None:
        super().__init__()
        self.conv = ModulatedConv(inputs, 4 * outputs, 1, style, demodulate=False)
        self.bias = nn.Parameter(torch.zeros(4 * outputs))
        nn.init.zeros_(self.conv.weight)

    def forward(self, image: Tensor, style: Tensor, skip: Tensor | None) -> Tensor:
        bands = self.conv(image, style) + self.bias.view(1, -1, 1, 1)
        if skip is None:
            return bands
        return bands + haar(double(inverse_haar(skip)))
