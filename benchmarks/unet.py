"""A small U-Net that takes the noise out of renders, and its training."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.renders import CHANNELS, Picture
from torch_vdm.model.display import decode_srgb, encode_srgb

Loss = Callable[[Tensor, Tensor], Tensor]

# Channels of the levels, the finest first; each is half the size of the one before. Status: choice.
WIDTHS = (16, 32, 64)

# Of the activation below 0. Status: choice.
SLOPE = 0.1

# Steps of Adam, its highest rate, crops a step, side of a crop in pixels. Status: choice: what
# nine runs can take in ten minutes of one core; more steps, and all denoise better.
STEPS, RATE, BATCH, CROP = 500, 2e-3, 6, 64


class UNet(nn.Module):
    """From a noisy render and its guides to a clean one, of any size.

    It sees light as the logarithm of 1 + sRGB-coded values: differences are then about as large as
    they look, and a firefly or a lamp a thousand times as bright as white is 3 units and not
    thousands. It answers with what is to be added to the noisy picture.
    """

    def __init__(self, widths: Sequence[int] = WIDTHS) -> None:
        super().__init__()
        before = (CHANNELS, *widths[:-1])
        self.down = nn.ModuleList(_block(a, b) for a, b in zip(before, widths, strict=True))
        self.up = nn.ModuleList(
            _block(coarse + fine, fine)
            for fine, coarse in zip(widths[-2::-1], widths[:0:-1], strict=True)
        )
        self.out = nn.Conv2d(widths[0], 3, 1)
        # Variance is kept from level to level, and the first answer is the noisy picture: in 60
        # steps ten times as much is learned as from torch's own first weights.
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, SLOPE)
                nn.init.zeros_(cast("Tensor", module.bias))
        nn.init.zeros_(self.out.weight)

    def forward(self, noisy: Tensor) -> Tensor:
        """Return sRGB-coded values (B, 3, H, W), over 1 for light over white.

        ``noisy`` is (B, 10, H, W), as in `Picture`.
        """
        height, width = noisy.shape[-2:]
        colour = torch.log1p(encode_srgb(noisy[:, :3]))
        inputs = torch.cat((colour, noisy[:, 3:]), 1)
        # To the next multiple of the coarsest level's pixel, by repeating the border.
        step = 2 ** (len(self.down) - 1)
        plane = functional.pad(inputs, (0, -width % step, 0, -height % step), mode="replicate")
        kept = []
        for level, block in enumerate(self.down):
            plane = block(functional.avg_pool2d(plane, 2) if level else plane)
            kept.append(plane)
        for block, fine in zip(self.up, kept[-2::-1], strict=True):
            wide = functional.interpolate(plane, scale_factor=2.0, mode="nearest")
            plane = block(torch.cat((wide, fine), 1))
        added: Tensor = self.out(plane)[..., :height, :width]
        return torch.expm1(colour + added)


def _block(channels: int, width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, width, 3, padding=1),
        nn.LeakyReLU(SLOPE),
        nn.Conv2d(width, width, 3, padding=1),
        nn.LeakyReLU(SLOPE),
    )


def train(
    loss: Loss,
    pictures: Sequence[Picture],
    seed: int,
    steps: int = STEPS,
    crop: int = CROP,
    batch: int = BATCH,
) -> UNet:
    """Return a network trained to bring ``loss(denoised, reference)`` down.

    The loss is given sRGB-coded values, (B, 3, crop, crop). The seed fixes the first weights and
    the crops, so that losses are compared on the same ones.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = UNet()
    optimizer = torch.optim.Adam(network.parameters(), lr=RATE)
    for step, (noisy, reference) in enumerate(crops(pictures, seed, steps, crop, batch)):
        # Up to the highest rate in the first twentieth, then down to 0 by a cosine.
        rise, fall = 20.0 * (step + 1) / steps, 0.5 * (1.0 + math.cos(math.pi * step / steps))
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1.0, rise) * fall
        optimizer.zero_grad()
        loss(network(noisy), reference).backward()
        optimizer.step()
    return network.eval()


def crops(
    pictures: Sequence[Picture], seed: int, steps: int, crop: int, batch: int
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield ``steps`` batches of noisy crops and their sRGB-coded references.

    Anywhere in any take of any picture, mirrored and turned at random.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(high: int) -> int:
        return int(torch.randint(high, (), generator=generator))

    for _ in range(steps):
        noisy: list[Tensor] = []
        references: list[Tensor] = []
        for _ in range(batch):
            picture = pictures[draw(len(pictures))]
            height, width = picture.reference.shape[-2:]
            top, left = draw(height - crop + 1), draw(width - crop + 1)
            window = (..., slice(top, top + crop), slice(left, left + crop))
            turn, mirror = draw(4), draw(2)
            for image, into in (
                (picture.noisy[draw(len(picture.noisy))], noisy),
                (picture.reference, references),
            ):
                piece = torch.rot90(image[window], turn, (-2, -1))
                into.append(piece.flip(-1) if mirror else piece)
        yield torch.stack(noisy), encode_srgb(torch.stack(references))


def denoise(network: UNet, noisy: Tensor) -> Tensor:
    """Return the light of a denoised picture, (B, 3, H, W), not negative."""
    with torch.no_grad():
        return decode_srgb(network(noisy)).clamp_min(0.0)
