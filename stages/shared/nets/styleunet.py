"""Dual-decoder StyleUNet: posed positional map in, front and back maps of Gaussian attributes out.

The structure is that of the published avatars (StyleAvatar's StyleUNet with two decoders that share the
encoder and the fuse convolutions), at any input size and width. At the published size (512² in, 1024² out,
width 1, style 512) it has 74,479,016 parameters for 3 output channels and 74,558,616 for 8.

Level ℓ is the resolution input / 2^ℓ and has `channels(ℓ)` = min(512, 64·2^ℓ) · width feature channels. The
encoder goes down to level `depth` (6 at 512²: 8²), the decoders come back to level 0, and a last inverse Haar
transform doubles that.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from stages.shared.nets.layers import EncoderConv, EqualLinear, StyledConv, ToBands, halve, inverse_haar


def level_channels(level: int, width: float) -> int:
    """Feature channels at resolution input / 2^level; at least 4."""
    return max(4, round(min(512, 64 * 2**level) * width))


class Encoder(nn.Module):
    """Features e_1 … e_depth at levels 1 … depth; every level also sees the blurred, halved input image."""

    def __init__(self, inputs: int, depth: int, width: float) -> None:
        super().__init__()
        channels = [level_channels(level, width) for level in range(depth + 1)]
        self.first = EncoderConv(inputs, channels[1], 3, down=True)
        self.from_image = nn.ModuleList(EncoderConv(inputs, channels[i], 1) for i in range(1, depth))
        self.same = nn.ModuleList(EncoderConv(channels[i], channels[i], 3) for i in range(1, depth))
        self.down = nn.ModuleList(EncoderConv(channels[i], channels[i + 1], 3, True) for i in range(1, depth))

    def forward(self, image: Tensor) -> list[Tensor]:
        features = [self.first(image)]
        for from_image, same, down in zip(self.from_image, self.same, self.down, strict=True):
            image = halve(image)
            features.append(down(same(features[-1] + from_image(image))))
        return features


class MapDecoder(nn.Module):
    """Styled convolutions from level depth−1 up to 0, with Haar bands added from level to level."""

    def __init__(self, outputs: int, depth: int, width: float, style: int) -> None:
        super().__init__()
        channels = [level_channels(level, width) for level in range(depth + 1)]
        levels = range(depth - 1, -1, -1)
        self.up = nn.ModuleList(StyledConv(channels[i + 1], channels[i], style, up=True) for i in levels)
        self.same = nn.ModuleList(StyledConv(channels[i], channels[i], style) for i in levels)
        self.to_bands = nn.ModuleList(ToBands(channels[i], outputs, style) for i in levels)


class StyleUNet(nn.Module):
    """The dual-decoder network.

    Arguments:
        inputs: input channels (3 front only, 6 front and back).
        outputs: output channels of each decoder.
        size: (height, width) of the input in pixels, each a multiple of 2^depth. Output is twice that.
        depth: levels of the encoder, at least 2.
        width: multiplier of all feature widths; 1 is the published network.
        style: length of the style vector; 512 in the published network.
    """

    style_input: Tensor  # (1, style)
    recompute = False
    """Compute activations again in the backward pass instead of keeping them: the same gradients for a third
    more work, and memory for one network at a time."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        size: tuple[int, int],
        depth: int = 6,
        width: float = 1.0,
        style: int = 512,
    ) -> None:
        super().__init__()
        if depth < 2 or any(side <= 0 or side % 2**depth for side in size):
            raise ValueError(
                f"input size {size} must be a positive multiple of 2^depth, depth {depth} at least 2"
            )
        self.depth, self.outputs = depth, outputs
        channels = [level_channels(level, width) for level in range(depth + 1)]
        self.mapping = nn.ModuleList(
            EqualLinear(style, style, lr_multiplier=0.01, activate=True) for _ in range(2)
        )
        self.encoder = Encoder(inputs, depth, width)
        # fuse[0] works on the deepest features alone; the others join decoder and encoder features.
        self.fuse = nn.ModuleList([EncoderConv(channels[depth], channels[depth], 3)])
        self.fuse.extend(EncoderConv(2 * channels[i], channels[i], 3) for i in range(depth - 1, 0, -1))
        self.decoders = nn.ModuleList(MapDecoder(outputs, depth, width, style) for _ in range(2))
        for level in range(depth):
            height, span = size[0] // 2**level, size[1] // 2**level
            self.register_buffer(f"noise_{level}", torch.randn(1, 1, height, span))
        self.register_buffer("style_input", torch.full((1, style), style**-0.5), persistent=False)

    def forward(self, image: Tensor, view_features: tuple[Tensor, Tensor] | None = None) -> Tensor:
        """(B, inputs, H, W) -> (B, 2, outputs, 2H, 2W), view 0 front, 1 back.

        `view_features`: per decoder, features added after level 1 (`ViewNet`).
        """
        if self.recompute and torch.is_grad_enabled():
            return checkpoint(
                self._pictures, image, view_features, use_reentrant=False, preserve_rng_state=False
            )
        return self._pictures(image, view_features)

    def _pictures(self, image: Tensor, view_features: tuple[Tensor, Tensor] | None) -> Tensor:
        style = self._style()
        features = self.encoder(image)
        deepest = self.fuse[0](features[-1])
        pictures = []
        for view in range(2):
            decoder: MapDecoder = self.decoders[view]  # type: ignore[assignment]
            added = None if view_features is None else view_features[view]
            pictures.append(self._decode(decoder, deepest, features, style, added))
        return torch.stack(pictures, dim=1)

    def _style(self) -> Tensor:
        style = self.style_input
        style = style * torch.rsqrt(style.square().mean(dim=1, keepdim=True) + 1e-8)
        for layer in self.mapping:
            style = layer(style)
        return style

    def _decode(
        self,
        decoder: MapDecoder,
        deepest: Tensor,
        features: list[Tensor],
        style: Tensor,
        view_features: Tensor | None,
    ) -> Tensor:
        current, bands = deepest, None
        for step, level in enumerate(range(self.depth - 1, -1, -1)):
            if step > 0:
                current = self.fuse[step](torch.cat((current, features[level]), dim=1))
            noise = getattr(self, f"noise_{level}")
            current = decoder.up[step](current, style, noise)
            current = decoder.same[step](current, style, noise)
            bands = decoder.to_bands[step](current, style, bands)
            if level == 1 and view_features is not None:
                current = current + view_features
        assert bands is not None
        return inverse_haar(bands)


class ViewNet(nn.Module):
    """Features of the viewing angle for the colour network: cosine map (B, 1, H, W) -> (B, C, H/2, W/2)."""

    def __init__(self, width: float = 1.0) -> None:
        super().__init__()
        self.first = nn.Conv2d(1, level_channels(0, width), 4, stride=2, padding=1)
        self.second = nn.Conv2d(level_channels(0, width), level_channels(1, width), 4, stride=2, padding=1)

    def forward(self, cosine: Tensor) -> Tensor:
        features = self.second(functional.leaky_relu(self.first(cosine), 0.2))
        size = (cosine.shape[2] // 2, cosine.shape[3] // 2)
        return functional.interpolate(features, size=size, mode="bilinear", align_corners=False)
